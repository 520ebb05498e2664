#pragma once

#include <cstring>
#include <string>

#include "common/backend.h"
#include "laws/registry.h"

// A law and its arguments in the form of ops.
namespace mpm {

using Tensors = std::vector<Tensor>;

inline LawEntry& law_of(const std::string& name) {
  LawEntry* law = find_law(name);
  STD_TORCH_CHECK(law, "law must be one of ", law_names(), ", got ", name);
  return *law;
}

template <class T, int D>
const LawKernels<T, D>& kernels_of(LawEntry& law) {
  STD_TORCH_CHECK(D == 3 || law.info.in_2d, "the law ", law.info.name, " is for 3-D alone");
  return law.kernels<T, D>();
}

// Number of scenes for parameters: B if the call has it; otherwise any number above the largest scene of the particles.
// On CUDA this number is unknown without waiting for the device (see `load_parameter`).
class ParameterScenes {
 public:
  ParameterScenes(const OptionalTensor& scene, int64_t scenes) : scene_(scene), scenes_(scenes) {}

  bool fit(int64_t entries) {
    if (!has(scene_)) return false;
    if (scenes_ >= 0 || !scene_->is_cpu()) return scenes_ >= 0 ? entries == scenes_ : entries > 0;
    if (least_ < 0) least_ = std::max<int64_t>(largest() + 1, 1);
    return entries >= least_;
  }

  std::string text() const {
    if (!has(scene_)) return "[B] (with scene)";
    if (scenes_ >= 0) return "[B] = [" + std::to_string(scenes_) + "]";
    return least_ < 0 ? "[B]" : "[B], B at least " + std::to_string(least_) + ",";
  }

 private:
  int largest() const {
    const int* const id = static_cast<const int*>(scene_->data_ptr());
    const int64_t count = scene_->size(0), stride = scene_->stride(0);
    int most = -1;
    for (int64_t p = 0; p < count; p++) most = std::max(most, id[p * stride]);
    return most;
  }

  const OptionalTensor& scene_;
  int64_t scenes_;      // negative where unknown
  int64_t least_ = -1;  // scenes of the particles, where known
};

template <class T>
Parameter<T> parameter(const Tensor& t, const std::string& name, const Tensor& state, int64_t particles,
                       ParameterScenes& scenes) {
  check_like(t, name.c_str(), state);
  const bool uniform = t.dim() <= 1 && t.numel() == 1, per_particle = t.dim() == 1 && t.size(0) == particles;
  STD_TORCH_CHECK(uniform || per_particle || (t.dim() == 1 && scenes.fit(t.size(0))), name,
                  " must be a scalar or have shape [1], ", scenes.text(), " or [P] = [", particles, "], got ",
                  shape_of(t));
  const T* pointer = static_cast<const T*>(t.data_ptr());
  if (uniform) return {pointer, 0, 0};
  return {pointer, t.stride(0), per_particle ? 0 : t.size(0)};
}

inline std::string element(const std::string& list, int k) { return list + "[" + std::to_string(k) + "]"; }

inline Shape shape_of_state(const LawInfo& law, int64_t particles, int64_t dim) {
  return law.field == Deformation::gradient ? Shape{particles, dim, dim} : Shape{particles};
}

inline void check_state(const LawInfo& law, const Tensor& state, int64_t dim) {
  STD_TORCH_CHECK(dim == 2 || dim == 3, "dim must be 2 or 3, got ", dim);
  STD_TORCH_CHECK(state.defined(), "the state must be a tensor, got None");
  const bool gradient = law.field == Deformation::gradient;
  STD_TORCH_CHECK(state.dim() == (gradient ? 3 : 1), "the state must have shape ", gradient ? "[P, D, D]" : "[P]",
                  ", got ", shape_of(state));
  check_shape(state, "the state", shape_of_state(law, state.size(0), dim));
  check_count(state.size(0), "the state", "particles");
}

inline void check_parameter_count(const Tensors& given, const LawInfo& law) {
  STD_TORCH_CHECK(given.size() == law.parameters.size(), "parameters must be ", law.parameters.size(),
                  " tensors for the law ", law.name, ", got ", given.size());
}

// The history that a law has with the given options, in its order.
inline std::vector<Quantity> history_with(const LawInfo& law, int64_t options) {
  std::vector<Quantity> variables;
  for (const Quantity& q : law.history) {
    bool present = q.option == nullptr;
    for (size_t k = 0; k < law.options.size() && !present; k++)
      present = (options >> k & 1) && std::strcmp(law.options[k], q.option) == 0;
    if (present) variables.push_back(q);
  }
  return variables;
}

// A law with optional history works with the first variables alone. Negative options are those of an op without any.
inline void check_history_count(const Tensors& given, const LawInfo& law, int64_t options) {
  const size_t most = options < 0 ? law.history.size() : history_with(law, options).size();
  STD_TORCH_CHECK(law.optional_history ? given.size() <= most : given.size() == most, "history must be ",
                  law.optional_history ? "at most " : "", most, " tensors for the law ", law.name,
                  options < 0 ? "" : " with these options", ", got ", given.size());
}

// Entries of all given history variables of a particle.
inline int64_t history_size(const LawInfo& law, const Tensors& history, int64_t dim) {
  int64_t size = 0;
  for (size_t k = 0; k < history.size() && k < law.history.size(); k++) size += law.history[k].matrix ? dim * dim : 1;
  return size;
}

// Where the number of scenes is unknown, the shortest parameter limits the entries of the elastic moduli, which come
// first: a particle without a modulus is invalid, while one without only a yield stress would be elastic.
template <class T, int D>
void limit_scenes(LawArguments<T, D>& a, size_t count) {
  int64_t entries = 0;
  for (size_t k = 0; k < count; k++)
    if (const int64_t own = a.parameters[k].scenes) entries = entries ? std::min(entries, own) : own;
  for (size_t k = 0; k < std::min<size_t>(count, 2); k++)
    if (Parameter<T>& modulus = a.parameters[k]; modulus.stride == 0 || modulus.scenes) modulus.scenes = entries;
}

// `options` and `scenes`, the number of scenes of the batch, are -1 if the call does not have them.
template <class T, int D>
LawArguments<T, D> arguments(const LawInfo& law, const Tensor& state, const OptionalTensor& C,
                             const Tensors& parameters, const Tensors& history, const OptionalTensor& scene,
                             int64_t options = -1, int64_t scenes = -1) {
  const int64_t P = state.size(0);
  LawArguments<T, D> a;
  a.particles = P;
  a.state = input<T>(state, "the state", state, shape_of_state(law, P, D));
  STD_TORCH_CHECK(law.viscous || !has(C), "a law without viscosity takes no C");
  a.C = input<T>(C, "C", state, {P, D, D});
  set_scene(a, scene, state);
  STD_TORCH_CHECK(options >= -1 && options < int64_t(1) << law.options.size(), "options must be bits of the ",
                  law.options.size(), " options of the law ", law.name, ", got ", options);
  a.options = options < 0 ? 0 : int(options);
  check_parameter_count(parameters, law);
  check_history_count(history, law, options);
  ParameterScenes of_parameters(scene, scenes);
  for (size_t k = 0; k < parameters.size(); k++)
    a.parameters[k] = parameter<T>(parameters[k], element("parameters", int(k)), state, P, of_parameters);
  if (scenes < 0 && !state.is_cpu()) limit_scenes(a, parameters.size());
  for (size_t k = 0; k < history.size(); k++)
    a.history[k] = input<T>(history[k], element("history", int(k)).c_str(), state,
                            law.history[k].matrix ? Shape{P, D, D} : Shape{P});
  return a;
}

}  // namespace mpm
