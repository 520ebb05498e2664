#include <string>

#include "common/backend.h"
#include "laws/registry.h"

// Update, energy and moduli of every law, by name.
namespace mpm {
namespace {

using Tensors = std::vector<Tensor>;

LawEntry& law_of(const std::string& name) {
  LawEntry* law = find_law(name);
  STD_TORCH_CHECK(law, "law must be one of ", law_names(), ", got ", name);
  return *law;
}

template <class T, int D>
const LawKernels<T, D>& kernels_of(LawEntry& law) {
  STD_TORCH_CHECK(D == 3 || law.info.in_2d, "the law ", law.info.name, " is for 3-D alone");
  return law.kernels<T, D>();
}

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

std::string element(const std::string& list, int k) { return list + "[" + std::to_string(k) + "]"; }

Shape shape_of_state(const LawInfo& law, int64_t particles, int64_t dim) {
  return law.field == Deformation::gradient ? Shape{particles, dim, dim} : Shape{particles};
}

void check_state(const LawInfo& law, const Tensor& state, int64_t dim) {
  STD_TORCH_CHECK(dim == 2 || dim == 3, "dim must be 2 or 3, got ", dim);
  STD_TORCH_CHECK(state.defined(), "the state must be a tensor, got None");
  const bool gradient = law.field == Deformation::gradient;
  STD_TORCH_CHECK(state.dim() == (gradient ? 3 : 1), "the state must have shape ", gradient ? "[P, D, D]" : "[P]",
                  ", got ", shape_of(state));
  check_shape(state, "the state", shape_of_state(law, state.size(0), dim));
  check_count(state.size(0), "the state", "particles");
}

void check_number(const Tensors& given, const char* name, size_t expected, const LawInfo& law, bool optional = false) {
  STD_TORCH_CHECK(given.size() == expected || (optional && given.empty()), name, " must be ", expected,
                  " tensors for the law ", law.name, ", got ", given.size());
}

// Entries of all history variables of a particle, of those that are given.
int64_t history_size(const LawInfo& law, const Tensors& history, int64_t dim) {
  int64_t size = 0;
  for (size_t k = 0; k < history.size() && k < law.history.size(); k++) size += law.history[k].matrix ? dim * dim : 1;
  return size;
}

template <class T, int D>
LawArguments<T, D> arguments(const LawInfo& law, const Tensor& state, const OptionalTensor& C,
                             const Tensors& parameters, const Tensors& history, const OptionalTensor& scene,
                             int64_t options = 0) {
  const int64_t P = state.size(0);
  LawArguments<T, D> a;
  a.particles = P;
  a.state = input<T>(state, "the state", state, shape_of_state(law, P, D));
  STD_TORCH_CHECK(law.viscous || !has(C), "a law without viscosity takes no C");
  a.C = input<T>(C, "C", state, {P, D, D});
  set_scene(a, scene, state);
  STD_TORCH_CHECK(options >= 0 && options < int64_t(1) << law.options.size(), "options must be bits of the ",
                  law.options.size(), " options of the law ", law.name, ", got ", options);
  a.options = int(options);
  check_number(parameters, "parameters", law.parameters.size(), law);
  check_number(history, "history", law.history.size(), law, law.optional_history);
  for (size_t k = 0; k < parameters.size(); k++)
    a.parameters[k] = parameter<T>(parameters[k], element("parameters", int(k)), state, P, has(scene));
  for (size_t k = 0; k < history.size(); k++)
    a.history[k] = input<T>(history[k], element("history", int(k)).c_str(), state,
                            law.history[k].matrix ? Shape{P, D, D} : Shape{P});
  return a;
}

// A result per particle; where it is not wanted it stays undefined, None in Python.
template <class T>
Field<T> result(const Tensor& like, bool wanted, const Shape& shape, Tensor& out) {
  if (!wanted) return {};
  out = empty_particles(like, shape);
  return field<T>(out);
}

// Bits of `details` and of `needs`, as torch_mpm/ops/law.py has them.
enum Detail : int64_t { kDissipated = 1, kMultiplier = 2, kBranch = 4 };
enum Need : int64_t { kState = 1, kVelocityGradient = 2, kParameters_ = 4, kHistory_ = 8 };

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> law_update(const Tensor& state, const OptionalTensor& C,
                                                                      const Tensors& parameters, const Tensors& history,
                                                                      const OptionalTensor& scene, std::string name,
                                                                      int64_t dim, int64_t options, int64_t details) {
  LawEntry& law = law_of(name);
  check_state(law.info, state, dim);
  const int64_t P = state.size(0);
  Tensor moved, stress, kept, dissipated, multiplier, branch;
  if (details & kBranch) branch = empty_int(state, {P});
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    LawUpdateArguments<T, D> a;
    a.law = arguments<T, D>(law.info, state, C, parameters, history, scene, options);
    a.state = result<T>(state, law.info.plastic, {P, D, D}, moved);
    a.stress = result<T>(state, true, {P, D, D}, stress);
    a.history = result<T>(state, !history.empty(), {P, history_size(law.info, history, dim)}, kept);
    a.dissipated = result<T>(state, details & kDissipated, {P}, dissipated);
    a.multiplier = result<T>(state, details & kMultiplier, {P}, multiplier);
    if (details & kBranch) a.branch = static_cast<int*>(branch.data_ptr());
    kernels_of<T, D>(law).update(a, device.stream());
  });
  return {moved, stress, kept, dissipated, multiplier, branch};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> law_update_backward(
    const OptionalTensor& grad_state, const OptionalTensor& grad_stress, const OptionalTensor& grad_history,
    const OptionalTensor& grad_dissipated, const OptionalTensor& grad_multiplier, const Tensor& state,
    const OptionalTensor& C, const Tensors& parameters, const Tensors& history, const OptionalTensor& scene,
    std::string name, int64_t dim, int64_t options, int64_t needs) {
  LawEntry& law = law_of(name);
  check_state(law.info, state, dim);
  const int64_t P = state.size(0), n = int64_t(parameters.size()), m = history_size(law.info, history, dim);
  Tensor by_state, by_C, by_parameters, by_history;
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    LawBackwardArguments<T, D> a;
    a.law = arguments<T, D>(law.info, state, C, parameters, history, scene, options);
    if (law.info.plastic) a.grad_state = input<T>(grad_state, "grad_state", state, {P, D, D});
    a.grad_stress = input<T>(grad_stress, "grad_stress", state, {P, D, D});
    if (m > 0) a.grad_history = input<T>(grad_history, "grad_history", state, {P, m});
    a.grad_dissipated = input<T>(grad_dissipated, "grad_dissipated", state, {P});
    a.grad_multiplier = input<T>(grad_multiplier, "grad_multiplier", state, {P});
    a.state = result<T>(state, needs & kState, shape_of_state(law.info, P, D), by_state);
    a.C = result<T>(state, (needs & kVelocityGradient) && has(C), {P, D, D}, by_C);
    a.parameters = result<T>(state, needs & kParameters_, {P, n}, by_parameters);
    a.history = result<T>(state, (needs & kHistory_) && m > 0, {P, m}, by_history);
    kernels_of<T, D>(law).update_backward(a, device.stream());
  });
  return {by_state, by_C, by_parameters, by_history};
}

void check_twice(bool differentiable, const char* what, const LawInfo& law) {
  STD_TORCH_CHECK(differentiable, what, " of the law ", law.name, " has no second derivatives");
}

std::tuple<Tensor, Tensor, Tensor, Tensor> law_update_double_backward(
    const OptionalTensor& along_state, const OptionalTensor& along_C, const OptionalTensor& along_parameters,
    const Tensor& grad_stress, const Tensor& state, const OptionalTensor& C, const Tensors& parameters,
    const OptionalTensor& scene, std::string name, int64_t dim, int64_t needs) {
  LawEntry& law = law_of(name);
  check_twice(law.info.twice_differentiable, "the stress", law.info);
  check_state(law.info, state, dim);
  const int64_t P = state.size(0), n = int64_t(parameters.size());
  Tensor by_grad, by_state, by_C, by_parameters;
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    LawDoubleBackwardArguments<T, D> a;
    a.law = arguments<T, D>(law.info, state, C, parameters, {}, scene);
    a.grad_stress = input<T>(grad_stress, "grad_stress", state, {P, D, D});
    a.along_state = input<T>(along_state, "along_state", state, shape_of_state(law.info, P, D));
    a.along_C = input<T>(along_C, "along_C", state, {P, D, D});
    a.along_parameters = input<T>(along_parameters, "along_parameters", state, {P, n});
    a.stress = result<T>(state, true, {P, D, D}, by_grad);
    a.state = result<T>(state, needs & kState, shape_of_state(law.info, P, D), by_state);
    a.C = result<T>(state, (needs & kVelocityGradient) && has(C), {P, D, D}, by_C);
    a.parameters = result<T>(state, needs & kParameters_, {P, n}, by_parameters);
    kernels_of<T, D>(law).double_backward(a, device.stream());
  });
  return {by_grad, by_state, by_C, by_parameters};
}

Tensor law_scalar(LawScalar which, const Tensor& state, const Tensors& parameters, const Tensors& history,
                  const OptionalTensor& scene, const std::string& name, int64_t dim) {
  LawEntry& law = law_of(name);
  check_state(law.info, state, dim);
  Tensor value = empty(state, {state.size(0)});
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    const LawScalarArguments<T, D> a{arguments<T, D>(law.info, state, {}, parameters, history, scene), which,
                                     field<T>(value)};
    kernels_of<T, D>(law).scalar(a, device.stream());
  });
  return value;
}

Tensor law_energy(const Tensor& state, const Tensors& parameters, const Tensors& history, const OptionalTensor& scene,
                  std::string name, int64_t dim) {
  return law_scalar(LawScalar::energy, state, parameters, history, scene, name, dim);
}

Tensor law_stiffness(const Tensor& state, const Tensors& parameters, const Tensors& history,
                     const OptionalTensor& scene, std::string name, int64_t dim) {
  return law_scalar(LawScalar::stiffness, state, parameters, history, scene, name, dim);
}

Tensor law_wave_modulus(const Tensor& state, const Tensors& parameters, const Tensors& history,
                        const OptionalTensor& scene, std::string name, int64_t dim) {
  return law_scalar(LawScalar::wave_modulus, state, parameters, history, scene, name, dim);
}

std::tuple<Tensor, Tensor, Tensor> law_energy_backward(const Tensor& grad_energy, const Tensor& state,
                                                       const Tensors& parameters, const Tensors& history,
                                                       const OptionalTensor& scene, std::string name, int64_t dim,
                                                       int64_t needs) {
  LawEntry& law = law_of(name);
  check_state(law.info, state, dim);
  const int64_t P = state.size(0), n = int64_t(parameters.size()), m = history_size(law.info, history, dim);
  Tensor by_state, by_parameters, by_history;
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    LawEnergyBackwardArguments<T, D> a;
    a.law = arguments<T, D>(law.info, state, {}, parameters, history, scene);
    a.grad_energy = input<T>(grad_energy, "grad_energy", state, {P});
    a.state = result<T>(state, needs & kState, shape_of_state(law.info, P, D), by_state);
    a.parameters = result<T>(state, needs & kParameters_, {P, n}, by_parameters);
    a.history = result<T>(state, (needs & kHistory_) && m > 0, {P, m}, by_history);
    kernels_of<T, D>(law).energy_backward(a, device.stream());
  });
  return {by_state, by_parameters, by_history};
}

std::tuple<Tensor, Tensor, Tensor> law_energy_double_backward(const OptionalTensor& along_state,
                                                              const OptionalTensor& along_parameters,
                                                              const Tensor& grad_energy, const Tensor& state,
                                                              const Tensors& parameters, const OptionalTensor& scene,
                                                              std::string name, int64_t dim, int64_t needs) {
  LawEntry& law = law_of(name);
  check_twice(law.info.twice_differentiable_energy, "the energy", law.info);
  check_state(law.info, state, dim);
  const int64_t P = state.size(0), n = int64_t(parameters.size());
  Tensor by_grad, by_state, by_parameters;
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    LawEnergyDoubleBackwardArguments<T, D> a;
    a.law = arguments<T, D>(law.info, state, {}, parameters, {}, scene);
    a.grad_energy = input<T>(grad_energy, "grad_energy", state, {P});
    a.along_state = input<T>(along_state, "along_state", state, shape_of_state(law.info, P, D));
    a.along_parameters = input<T>(along_parameters, "along_parameters", state, {P, n});
    a.energy = result<T>(state, true, {P}, by_grad);
    a.state = result<T>(state, needs & kState, shape_of_state(law.info, P, D), by_state);
    a.parameters = result<T>(state, needs & kParameters_, {P, n}, by_parameters);
    kernels_of<T, D>(law).energy_double_backward(a, device.stream());
  });
  return {by_grad, by_state, by_parameters};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "law_update(Tensor state, Tensor? C, Tensor[] parameters, Tensor[] history, Tensor? scene, str law, int dim, "
      "int options, int details) -> (Tensor state, Tensor stress, Tensor history, Tensor dissipated, "
      "Tensor multiplier, Tensor branch)");
  m.def(
      "law_update_backward(Tensor? grad_state, Tensor? grad_stress, Tensor? grad_history, Tensor? grad_dissipated, "
      "Tensor? grad_multiplier, Tensor state, Tensor? C, Tensor[] parameters, Tensor[] history, Tensor? scene, "
      "str law, int dim, int options, int needs) -> (Tensor state, Tensor C, Tensor parameters, Tensor history)");
  m.def(
      "law_update_double_backward(Tensor? along_state, Tensor? along_C, Tensor? along_parameters, Tensor grad_stress, "
      "Tensor state, Tensor? C, Tensor[] parameters, Tensor? scene, str law, int dim, int needs) -> "
      "(Tensor grad_stress, Tensor state, Tensor C, Tensor parameters)");
  m.def("law_energy(Tensor state, Tensor[] parameters, Tensor[] history, Tensor? scene, str law, int dim) -> Tensor");
  m.def(
      "law_energy_backward(Tensor grad_energy, Tensor state, Tensor[] parameters, Tensor[] history, Tensor? scene, "
      "str law, int dim, int needs) -> (Tensor state, Tensor parameters, Tensor history)");
  m.def(
      "law_energy_double_backward(Tensor? along_state, Tensor? along_parameters, Tensor grad_energy, Tensor state, "
      "Tensor[] parameters, Tensor? scene, str law, int dim, int needs) -> (Tensor grad_energy, Tensor state, "
      "Tensor parameters)");
  m.def(
      "law_stiffness(Tensor state, Tensor[] parameters, Tensor[] history, Tensor? scene, str law, int dim) -> Tensor");
  m.def(
      "law_wave_modulus(Tensor state, Tensor[] parameters, Tensor[] history, Tensor? scene, str law, int dim) -> "
      "Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("law_update", TORCH_BOX(&mpm::law_update));
  m.impl("law_update_backward", TORCH_BOX(&mpm::law_update_backward));
  m.impl("law_update_double_backward", TORCH_BOX(&mpm::law_update_double_backward));
  m.impl("law_energy", TORCH_BOX(&mpm::law_energy));
  m.impl("law_energy_backward", TORCH_BOX(&mpm::law_energy_backward));
  m.impl("law_energy_double_backward", TORCH_BOX(&mpm::law_energy_double_backward));
  m.impl("law_stiffness", TORCH_BOX(&mpm::law_stiffness));
  m.impl("law_wave_modulus", TORCH_BOX(&mpm::law_wave_modulus));
}
