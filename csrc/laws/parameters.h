#pragma once

#include "common/tensors.h"
#include "laws/arguments.h"

// What the ops of constitutive laws share: laws by name, parameters, optional results.
namespace mpm {

template <class T>
Parameter<T> parameter(const Tensor& t, const std::string& name, const Tensor& state, int64_t particles,
                       bool has_scene) {
  check_like(t, name.c_str(), state);
  const bool uniform = t.dim() <= 1 && t.numel() == 1, per_particle = t.dim() == 1 && t.size(0) == particles;
  STD_TORCH_CHECK(uniform || per_particle || (t.dim() == 1 && has_scene && t.size(0) > 0), name,
                  " must be a scalar or have shape [1], [B] (with scene) or [P] = [", particles, "], got ",
                  shape_of(t));
  const T* pointer = static_cast<const T*>(t.data_ptr());
  if (uniform) return {pointer, 0, 0};
  return {pointer, t.stride(0), per_particle ? 0 : t.size(0)};
}

// Of a law in the order of its parameters, or of its history.
inline void check_number(const std::vector<Tensor>& given, const char* name, int expected, const std::string& law) {
  STD_TORCH_CHECK(int64_t(given.size()) == expected, name, " must be ", expected, " tensors for the law ", law,
                  ", got ", given.size());
}

inline std::string element(const std::string& list, int k) { return list + "[" + std::to_string(k) + "]"; }

// Names in a list of laws, for messages.
template <class List>
std::string names_of() {
  std::string names;
  for (int i = 0; i < List::size; i++)
    List::visit(i, [&]<class Entry>() {
      if (names.find(Entry::name) == std::string::npos) names += (names.empty() ? "" : ", ") + std::string(Entry::name);
    });
  return names;
}

// Calls found.operator()<Law>(index) for the law of a name.
template <class Laws, class F>
void find_law(const std::string& name, F&& found) {
  bool known = false;
  for (int i = 0; i < Laws::size; i++)
    Laws::visit(i, [&]<class Law>() {
      if (name != Law::name) return;
      known = true;
      found.template operator()<Law>(i);
    });
  STD_TORCH_CHECK(known, "law must be one of ", names_of<Laws>(), ", got ", name);
}

// A result per particle, or an empty tensor where it is not wanted.
template <class T>
Field<T> optional_result(const Tensor& like, bool wanted, const Shape& shape, Tensor& out) {
  out = wanted ? empty_particles(like, shape) : empty(like, {0});
  return wanted ? field<T>(out) : Field<T>{};
}

}  // namespace mpm
