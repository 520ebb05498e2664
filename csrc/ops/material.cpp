#include <string>

#include "ops/backend.h"
#include "ops/parameters.h"

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "cpu/material_launchers.h"
#else
#include "cuda/material_launchers.h"
#endif

// Stress, energy and moduli of the laws of csrc/materials.
namespace mpm {
namespace {

struct LawInfo {
  int index = -1, parameters = 0;
  bool shear = false, viscous = false;
};

LawInfo find_law(const std::string& name) {
  LawInfo info;
  for (int i = 0; i < AllLaws::size; i++)
    AllLaws::visit(i, [&]<class Law>() {
      if (name == Law::name) info = {i, Law::parameters, Law::shear, Law::viscous};
    });
  STD_TORCH_CHECK(info.index >= 0, "there is no law named ", name);
  return info;
}

// Calls f.operator()<T, D>().
template <class F>
void dispatch_law(const Tensor& state, int64_t dim, F&& f) {
  STD_TORCH_CHECK(dim == 2 || dim == 3, "dim must be 2 or 3");
  const auto by_dimension = [&]<class T>() {
    dim == 2 ? f.template operator()<T, 2>() : f.template operator()<T, 3>();
  };
  if (state.scalar_type() == ScalarType::Float)
    by_dimension.template operator()<float>();
  else if (state.scalar_type() == ScalarType::Double)
    by_dimension.template operator()<double>();
  else
    STD_TORCH_CHECK(false, "the state must be float32 or float64");
}

template <class T, int D>
LawArguments<T, D> law_arguments(const LawInfo& law, const Tensor& state, const OptionalTensor& C,
                                 const OptionalTensor& scene, const std::vector<Tensor>& parameters) {
  STD_TORCH_CHECK(state.dim() >= 1, "the state must have shape [P] or [P, D, D]");
  const int64_t P = state.size(0);
  LawArguments<T, D> a;
  a.law = law.index;
  a.particles = P;
  a.state = input<T>(state, "the state", state, law.shear ? Shape{P, D, D} : Shape{P});
  STD_TORCH_CHECK(law.viscous || !has(C), "a law without viscosity takes no C");
  a.C = input<T>(C, "C", state, {P, D, D});
  set_scene(a, scene, state);
  STD_TORCH_CHECK(int(parameters.size()) == law.parameters, "the law has another number of parameters");
  for (int k = 0; k < law.parameters; k++) a.parameters[k] = parameter<T>(parameters[k], state, P, has(scene));
  return a;
}

Tensor material_stress(const Tensor& state, const OptionalTensor& C, const OptionalTensor& scene,
                       const std::vector<Tensor>& parameters, std::string law, int64_t dim) {
  const LawInfo info = find_law(law);
  Tensor stress = empty_particles(state, {state.size(0), dim, dim});
  const DeviceScope device(state);
  dispatch_law(state, dim, [&]<class T, int D>() {
    const StressArguments<T, D> a{law_arguments<T, D>(info, state, C, scene, parameters), field<T>(stress)};
    backend::material_stress(a, device.stream());
  });
  return stress;
}

std::tuple<Tensor, Tensor, Tensor> material_stress_backward(const Tensor& grad_stress, const Tensor& state,
                                                            const OptionalTensor& C, const OptionalTensor& scene,
                                                            const std::vector<Tensor>& parameters, std::string law,
                                                            int64_t dim, int64_t needs) {
  const LawInfo info = find_law(law);
  const int64_t P = state.size(0);
  Tensor grad_state, grad_C, grad_parameters;
  const DeviceScope device(state);
  dispatch_law(state, dim, [&]<class T, int D>() {
    StressBackwardArguments<T, D> a;
    a.law = law_arguments<T, D>(info, state, C, scene, parameters);
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
  const LawInfo info = find_law(law);
  Tensor value = empty(state, {state.size(0)});
  const DeviceScope device(state);
  dispatch_law(state, dim, [&]<class T, int D>() {
    const ScalarArguments<T, D> a{law_arguments<T, D>(info, state, {}, scene, parameters), which, field<T>(value)};
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
  const LawInfo info = find_law(law);
  const int64_t P = state.size(0);
  Tensor grad_state, grad_parameters;
  const DeviceScope device(state);
  dispatch_law(state, dim, [&]<class T, int D>() {
    EnergyBackwardArguments<T, D> a;
    a.law = law_arguments<T, D>(info, state, {}, scene, parameters);
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
