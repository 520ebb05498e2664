#include "laws/registry.h"

#include <cmath>
#include <sstream>
#include <vector>

#include "common/backend.h"

namespace mpm {
namespace {

// In a function, since a global would not yet be constructed when the first law is registered.
std::vector<LawEntry*>& entered() {
  static std::vector<LawEntry*> laws;
  return laws;
}

int level_in_use() {
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
  return int(cpu::isa_level());
#else
  return 0;
#endif
}

std::string number(double value) {
  if (std::isinf(value)) return "null";
  std::ostringstream text;
  text << value;
  return text.str();
}

std::string flag(bool value) { return value ? "true" : "false"; }

template <class List, class F>
std::string json_list(const List& list, F&& element) {
  std::string text;
  for (const auto& entry : list) text += (text.empty() ? "" : ", ") + element(entry);
  return "[" + text + "]";
}

std::string quantity_as_json(const Quantity& q) {
  return std::string("{\"name\": \"") + q.name + "\", \"unit\": \"" + q.unit + "\", \"low\": " + number(q.low) +
         ", \"high\": " + number(q.high) + ", \"with_low\": " + flag(q.with_low) +
         ", \"with_high\": " + flag(q.with_high) + ", \"matrix\": " + flag(q.matrix) +
         ", \"option\": " + (q.option ? std::string("\"") + q.option + "\"" : "null") + "}";
}

std::string law_as_json(const LawInfo& info) {
  return std::string("{\"name\": \"") + info.name +
         "\", \"field\": " + (info.field == Deformation::gradient ? "\"F\"" : "\"J\"") +
         ", \"viscous\": " + flag(info.viscous) + ", \"plastic\": " + flag(info.plastic) +
         ", \"optional_history\": " + flag(info.optional_history) +
         ", \"twice_differentiable\": " + flag(info.twice_differentiable) +
         ", \"twice_differentiable_energy\": " + flag(info.twice_differentiable_energy) +
         ", \"has_tangent\": " + flag(info.has_tangent) + ", \"in_2d\": " + flag(info.in_2d) +
         ", \"additive\": " + flag(info.additive) +
         ", \"parameters\": " + json_list(info.parameters, quantity_as_json) +
         ", \"history\": " + json_list(info.history, quantity_as_json) +
         ", \"options\": " + json_list(info.options, [](const char* o) { return std::string("\"") + o + "\""; }) + "}";
}

}  // namespace

bool enter_law(LawEntry& law) {
  entered().push_back(&law);
  return true;
}

LawEntry* find_law(const std::string& name) {
  for (LawEntry* law : entered())
    if (law->level == level_in_use() && name == law->info.name) return law;
  return nullptr;
}

std::string law_names() {
  std::string names;
  for (const LawEntry* law : entered())
    if (law->level == level_in_use()) names += (names.empty() ? "" : ", ") + std::string(law->info.name);
  return names;
}

std::string laws_as_json() {
  std::vector<LawInfo> infos;
  for (const LawEntry* law : entered())
    if (law->level == level_in_use()) infos.push_back(law->info);
  return json_list(infos, law_as_json);
}

}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
extern "C" __attribute__((visibility("default"))) const char* torch_mpm_laws() {
  static const std::string text = mpm::laws_as_json();
  return text.c_str();
}
#endif
