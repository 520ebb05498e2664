#include <string>

#include "laws/backend_kernels.h"
#include "laws/parameters.h"

// Laws in principal strains: return map with stress, energy and moduli.
namespace mpm {
namespace {

struct PrincipalLawInfo {
  int index = -1, parameters = 0, history = 0;
  bool plastic = false;
};

PrincipalLawInfo find(const std::string& name) {
  PrincipalLawInfo info;
  find_law<PrincipalLaws>(name, [&]<class Law>(int i) { info = {i, Law::parameters, Law::history, Law::plastic}; });
  return info;
}

template <class T, int D>
PrincipalArguments<T, D> principal_arguments(const PrincipalLawInfo& law, const std::string& name, const Tensor& F,
                                             const std::vector<Tensor>& parameters, const std::vector<Tensor>& history,
                                             const OptionalTensor& scene) {
  PrincipalArguments<T, D> a;
  a.law = law.index;
  a.particles = F.size(0);
  a.F = input<T>(F, "F", F, {F.size(0), D, D});
  set_scene(a, scene, F);
  check_number(parameters, "parameters", law.parameters, name);
  check_number(history, "history", law.history, name);
  for (int k = 0; k < law.parameters; k++)
    a.parameters[k] = parameter<T>(parameters[k], element("parameters", k), F, a.particles, has(scene));
  for (int k = 0; k < law.history; k++)
    a.history[k] = input<T>(history[k], element("history", k).c_str(), F, {a.particles});
  return a;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> principal_update(const Tensor& F,
                                                                    const std::vector<Tensor>& parameters,
                                                                    const std::vector<Tensor>& history,
                                                                    const OptionalTensor& scene, std::string law,
                                                                    bool details) {
  const PrincipalLawInfo info = find(law);
  check_matrices(F, "F");
  const int64_t P = F.size(0);
  Tensor mapped, stress, moved, dissipated, branch = empty_int(F, {details ? P : 0});
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    PrincipalUpdateArguments<T, D> a;
    a.law = principal_arguments<T, D>(info, law, F, parameters, history, scene);
    a.F = optional_result<T>(F, info.plastic, {P, D, D}, mapped);
    a.stress = optional_result<T>(F, true, {P, D, D}, stress);
    a.history = optional_result<T>(F, true, {P, info.history}, moved);
    a.dissipated = optional_result<T>(F, details, {P}, dissipated);
    if (details) a.branch = static_cast<int*>(branch.data_ptr());
    backend::principal_update(a, device.stream());
  });
  return {mapped, stress, moved, dissipated, branch};
}

std::tuple<Tensor, Tensor, Tensor> principal_update_backward(
    const OptionalTensor& grad_F, const OptionalTensor& grad_stress, const OptionalTensor& grad_history,
    const OptionalTensor& grad_dissipated, const Tensor& F, const std::vector<Tensor>& parameters,
    const std::vector<Tensor>& history, const OptionalTensor& scene, std::string law, int64_t needs) {
  const PrincipalLawInfo info = find(law);
  check_matrices(F, "F");
  const int64_t P = F.size(0);
  Tensor adjoint_F, adjoint_parameters, adjoint_history;
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    PrincipalBackwardArguments<T, D> a;
    a.law = principal_arguments<T, D>(info, law, F, parameters, history, scene);
    a.grad_F = input<T>(grad_F, "grad_F", F, {P, D, D});
    a.grad_stress = input<T>(grad_stress, "grad_stress", F, {P, D, D});
    a.grad_history = input<T>(grad_history, "grad_history", F, {P, info.history});
    a.grad_dissipated = input<T>(grad_dissipated, "grad_dissipated", F, {P});
    a.F = optional_result<T>(F, needs & 1, {P, D, D}, adjoint_F);
    a.parameters = optional_result<T>(F, needs & 2, {P, info.parameters}, adjoint_parameters);
    a.history = optional_result<T>(F, needs & 4, {P, info.history}, adjoint_history);
    backend::principal_backward(a, device.stream());
  });
  return {adjoint_F, adjoint_parameters, adjoint_history};
}

Tensor principal_scalar(PrincipalScalar which, const Tensor& F, const std::vector<Tensor>& parameters,
                        const std::vector<Tensor>& history, const OptionalTensor& scene, const std::string& law) {
  const PrincipalLawInfo info = find(law);
  check_matrices(F, "F");
  Tensor value = empty(F, {F.size(0)});
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    const PrincipalScalarArguments<T, D> a{principal_arguments<T, D>(info, law, F, parameters, history, scene), which,
                                           field<T>(value)};
    backend::principal_scalar(a, device.stream());
  });
  return value;
}

Tensor principal_energy(const Tensor& F, const std::vector<Tensor>& parameters, const std::vector<Tensor>& history,
                        const OptionalTensor& scene, std::string law) {
  return principal_scalar(PrincipalScalar::energy, F, parameters, history, scene, law);
}

Tensor principal_stiffness(const Tensor& F, const std::vector<Tensor>& parameters, const std::vector<Tensor>& history,
                           const OptionalTensor& scene, std::string law) {
  return principal_scalar(PrincipalScalar::stiffness, F, parameters, history, scene, law);
}

Tensor principal_wave_modulus(const Tensor& F, const std::vector<Tensor>& parameters,
                              const std::vector<Tensor>& history, const OptionalTensor& scene, std::string law) {
  return principal_scalar(PrincipalScalar::wave_modulus, F, parameters, history, scene, law);
}

std::tuple<Tensor, Tensor, Tensor> principal_energy_backward(const Tensor& grad_energy, const Tensor& F,
                                                             const std::vector<Tensor>& parameters,
                                                             const std::vector<Tensor>& history,
                                                             const OptionalTensor& scene, std::string law,
                                                             int64_t needs) {
  const PrincipalLawInfo info = find(law);
  check_matrices(F, "F");
  const int64_t P = F.size(0);
  Tensor adjoint_F, adjoint_parameters, adjoint_history;
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    PrincipalEnergyBackwardArguments<T, D> a;
    a.law = principal_arguments<T, D>(info, law, F, parameters, history, scene);
    a.grad_energy = input<T>(grad_energy, "grad_energy", F, {P});
    a.F = optional_result<T>(F, needs & 1, {P, D, D}, adjoint_F);
    a.parameters = optional_result<T>(F, needs & 2, {P, info.parameters}, adjoint_parameters);
    a.history = optional_result<T>(F, needs & 4, {P, info.history}, adjoint_history);
    backend::principal_energy_backward(a, device.stream());
  });
  return {adjoint_F, adjoint_parameters, adjoint_history};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "principal_update(Tensor F, Tensor[] parameters, Tensor[] history, Tensor? scene, str law, bool details) -> "
      "(Tensor F, Tensor stress, Tensor history, Tensor dissipated, Tensor branch)");
  m.def(
      "principal_update_backward(Tensor? grad_F, Tensor? grad_stress, Tensor? grad_history, Tensor? grad_dissipated, "
      "Tensor F, Tensor[] parameters, Tensor[] history, Tensor? scene, str law, int needs) -> (Tensor F, Tensor "
      "parameters, Tensor history)");
  m.def("principal_energy(Tensor F, Tensor[] parameters, Tensor[] history, Tensor? scene, str law) -> Tensor");
  m.def(
      "principal_energy_backward(Tensor grad_energy, Tensor F, Tensor[] parameters, Tensor[] history, Tensor? scene, "
      "str law, int needs) -> (Tensor F, Tensor parameters, Tensor history)");
  m.def("principal_stiffness(Tensor F, Tensor[] parameters, Tensor[] history, Tensor? scene, str law) -> Tensor");
  m.def("principal_wave_modulus(Tensor F, Tensor[] parameters, Tensor[] history, Tensor? scene, str law) -> Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("principal_update", TORCH_BOX(&mpm::principal_update));
  m.impl("principal_update_backward", TORCH_BOX(&mpm::principal_update_backward));
  m.impl("principal_energy", TORCH_BOX(&mpm::principal_energy));
  m.impl("principal_energy_backward", TORCH_BOX(&mpm::principal_energy_backward));
  m.impl("principal_stiffness", TORCH_BOX(&mpm::principal_stiffness));
  m.impl("principal_wave_modulus", TORCH_BOX(&mpm::principal_wave_modulus));
}
