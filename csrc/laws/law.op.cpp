#include <string>

#include "laws/law.op.h"
#include "laws/tangent.h"

// Update, energy and moduli of every law, by name.
namespace mpm {
namespace {

template <class T>
Field<T> result(const Tensor& like, bool wanted, const Shape& shape, Tensor& out) {
  out = mpm::result(like, wanted, shape);
  return field<T>(out);
}

// Bits of `details` and of `needs`, as in torch_mpm/ops/law.py.
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

Tensor law_tangent(const Tensor& state, const Tensor& before, const Tensor& weight, const Tensors& parameters,
                   const Tensors& history, const OptionalTensor& scene, std::string name, int64_t dim, bool projected) {
  LawEntry& law = law_of(name);
  STD_TORCH_CHECK(law.info.has_tangent, "the law ", law.info.name, " has no tangent");
  check_state(law.info, state, dim);
  const int64_t P = state.size(0);
  Tensor tangent;
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    LawTangentArguments<T, D> a;
    a.law = arguments<T, D>(law.info, state, {}, parameters, history, scene);
    a.before = input<T>(before, "before", state, shape_of_state(law.info, P, D));
    a.weight = input<T>(weight, "weight", state, {P});
    a.projected = projected;
    a.tangent = result<T>(state, true, {P, kTangentEntries<D>}, tangent);
    kernels_of<T, D>(law).tangent(a, device.stream());
  });
  return tangent;
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
      "law_tangent(Tensor state, Tensor before, Tensor weight, Tensor[] parameters, Tensor[] history, Tensor? scene, "
      "str law, int dim, bool projected) -> Tensor");
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
  m.impl("law_tangent", TORCH_BOX(&mpm::law_tangent));
  m.impl("law_stiffness", TORCH_BOX(&mpm::law_stiffness));
  m.impl("law_wave_modulus", TORCH_BOX(&mpm::law_wave_modulus));
}
