#include <string>

#include "laws/backend_kernels.h"
#include "laws/parameters.h"

// Stress, energy and moduli of the laws of csrc/laws.
namespace mpm {
namespace {

struct LawInfo {
  int index = -1, parameters = 0;
  bool shear = false, viscous = false;
};

LawInfo find(const std::string& name) {
  LawInfo info;
  find_law<AllLaws>(name, [&]<class Law>(int i) { info = {i, Law::parameters, Law::shear, Law::viscous}; });
  return info;
}

// F [P, D, D], or J [P] of a law without shear.
void check_state(const LawInfo& law, const Tensor& state, int64_t dim) {
  STD_TORCH_CHECK(dim == 2 || dim == 3, "dim must be 2 or 3, got ", dim);
  STD_TORCH_CHECK(state.defined(), "the state must be a tensor, got None");
  STD_TORCH_CHECK(state.dim() == (law.shear ? 3 : 1), "the state must have shape ", law.shear ? "[P, D, D]" : "[P]",
                  ", got ", shape_of(state));
  check_shape(state, "the state", law.shear ? Shape{state.size(0), dim, dim} : Shape{state.size(0)});
  check_count(state.size(0), "the state", "particles");
}

template <class T, int D>
LawArguments<T, D> law_arguments(const LawInfo& law, const std::string& name, const Tensor& state,
                                 const OptionalTensor& C, const OptionalTensor& scene,
                                 const std::vector<Tensor>& parameters) {
  const int64_t P = state.size(0);
  LawArguments<T, D> a;
  a.law = law.index;
  a.particles = P;
  a.state = input<T>(state, "the state", state, law.shear ? Shape{P, D, D} : Shape{P});
  STD_TORCH_CHECK(law.viscous || !has(C), "a law without viscosity takes no C");
  a.C = input<T>(C, "C", state, {P, D, D});
  set_scene(a, scene, state);
  check_number(parameters, "parameters", law.parameters, name);
  for (int k = 0; k < law.parameters; k++)
    a.parameters[k] = parameter<T>(parameters[k], element("parameters", k), state, P, has(scene));
  return a;
}

Tensor material_stress(const Tensor& state, const OptionalTensor& C, const OptionalTensor& scene,
                       const std::vector<Tensor>& parameters, std::string law, int64_t dim) {
  const LawInfo info = find(law);
  check_state(info, state, dim);
  Tensor stress = empty_particles(state, {state.size(0), dim, dim});
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    const StressArguments<T, D> a{law_arguments<T, D>(info, law, state, C, scene, parameters), field<T>(stress)};
    backend::material_stress(a, device.stream());
  });
  return stress;
}

std::tuple<Tensor, Tensor, Tensor> material_stress_backward(const Tensor& grad_stress, const Tensor& state,
                                                            const OptionalTensor& C, const OptionalTensor& scene,
                                                            const std::vector<Tensor>& parameters, std::string law,
                                                            int64_t dim, int64_t needs) {
  const LawInfo info = find(law);
  check_state(info, state, dim);
  const int64_t P = state.size(0);
  Tensor grad_state, grad_C, grad_parameters;
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    StressBackwardArguments<T, D> a;
    a.law = law_arguments<T, D>(info, law, state, C, scene, parameters);
    a.grad_stress = input<T>(grad_stress, "grad_stress", state, {P, D, D});
    a.state = optional_result<T>(state, needs & kState, info.shear ? Shape{P, D, D} : Shape{P}, grad_state);
    a.C = optional_result<T>(state, (needs & kVelocityGradient) && has(C), {P, D, D}, grad_C);
    a.parameters = optional_result<T>(state, needs & kParameters, {P, info.parameters}, grad_parameters);
    backend::material_stress_backward(a, device.stream());
  });
  return {grad_state, grad_C, grad_parameters};
}

Tensor material_scalar(Scalar which, const Tensor& state, const OptionalTensor& scene,
                       const std::vector<Tensor>& parameters, const std::string& law, int64_t dim) {
  const LawInfo info = find(law);
  check_state(info, state, dim);
  Tensor value = empty(state, {state.size(0)});
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    const ScalarArguments<T, D> a{law_arguments<T, D>(info, law, state, {}, scene, parameters), which, field<T>(value)};
    backend::material_scalar(a, device.stream());
  });
  return value;
}

Tensor material_energy(const Tensor& state, const OptionalTensor& scene, const std::vector<Tensor>& parameters,
                       std::string law, int64_t dim) {
  return material_scalar(Scalar::energy, state, scene, parameters, law, dim);
}

Tensor material_wave_modulus(const Tensor& state, const OptionalTensor& scene, const std::vector<Tensor>& parameters,
                             std::string law, int64_t dim) {
  return material_scalar(Scalar::wave_modulus, state, scene, parameters, law, dim);
}

Tensor material_stiffness(const Tensor& state, const OptionalTensor& scene, const std::vector<Tensor>& parameters,
                          std::string law, int64_t dim) {
  return material_scalar(Scalar::stiffness, state, scene, parameters, law, dim);
}

std::tuple<Tensor, Tensor> material_energy_backward(const Tensor& grad_energy, const Tensor& state,
                                                    const OptionalTensor& scene, const std::vector<Tensor>& parameters,
                                                    std::string law, int64_t dim, int64_t needs) {
  const LawInfo info = find(law);
  check_state(info, state, dim);
  const int64_t P = state.size(0);
  Tensor grad_state, grad_parameters;
  const DeviceScope device(state);
  dispatch(state, "the state", dim, [&]<class T, int D>() {
    EnergyBackwardArguments<T, D> a;
    a.law = law_arguments<T, D>(info, law, state, {}, scene, parameters);
    a.grad_energy = input<T>(grad_energy, "grad_energy", state, {P});
    a.state = optional_result<T>(state, needs & kState, info.shear ? Shape{P, D, D} : Shape{P}, grad_state);
    a.parameters = optional_result<T>(state, needs & kParameters, {P, info.parameters}, grad_parameters);
    backend::material_energy_backward(a, device.stream());
  });
  return {grad_state, grad_parameters};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("material_stress(Tensor state, Tensor? C, Tensor? scene, Tensor[] parameters, str law, int dim) -> Tensor");
  m.def(
      "material_stress_backward(Tensor grad_stress, Tensor state, Tensor? C, Tensor? scene, Tensor[] parameters, "
      "str law, int dim, int needs) -> (Tensor state, Tensor C, Tensor parameters)");
  m.def("material_energy(Tensor state, Tensor? scene, Tensor[] parameters, str law, int dim) -> Tensor");
  m.def(
      "material_energy_backward(Tensor grad_energy, Tensor state, Tensor? scene, Tensor[] parameters, str law, int "
      "dim, "
      "int needs) -> (Tensor state, Tensor parameters)");
  m.def("material_wave_modulus(Tensor state, Tensor? scene, Tensor[] parameters, str law, int dim) -> Tensor");
  m.def("material_stiffness(Tensor state, Tensor? scene, Tensor[] parameters, str law, int dim) -> Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("material_stress", TORCH_BOX(&mpm::material_stress));
  m.impl("material_stress_backward", TORCH_BOX(&mpm::material_stress_backward));
  m.impl("material_energy", TORCH_BOX(&mpm::material_energy));
  m.impl("material_energy_backward", TORCH_BOX(&mpm::material_energy_backward));
  m.impl("material_wave_modulus", TORCH_BOX(&mpm::material_wave_modulus));
  m.impl("material_stiffness", TORCH_BOX(&mpm::material_stiffness));
}
