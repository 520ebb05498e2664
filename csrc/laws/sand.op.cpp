#include <string>

#include "laws/backend_kernels.h"
#include "laws/parameters.h"

// Return map, stress, energy and stiffness of sand.
namespace mpm {
namespace {

template <class Energies>
int energy_index(const std::string& name, const std::string& flow) {
  STD_TORCH_CHECK(flow == "radial" || flow == "exact", "flow must be radial or exact, got ", flow);
  const int index = find_energy<Energies>(name, flow == "exact");
  STD_TORCH_CHECK(index >= 0, "energy must be one of ", names_of<Energies>(), ", got ", name);
  return index;
}

template <class T, int D>
SandArguments<T, D> sand_arguments(const Tensor& F, const Tensor& mu, const Tensor& lam, const OptionalTensor& scene) {
  SandArguments<T, D> a;
  a.particles = F.size(0);
  a.F = input<T>(F, "F", F, {F.size(0), D, D});
  set_scene(a, scene, F);
  a.mu = parameter<T>(mu, "mu", F, a.particles, has(scene));
  a.lam = parameter<T>(lam, "lam", F, a.particles, has(scene));
  return a;
}

// The apex rule is "none" (without plasticity), "zero" or "keep".
template <class T, int D>
SandArguments<T, D> plastic_arguments(const Tensor& F, const Tensor& mu, const Tensor& lam, const Tensor& alpha,
                                      const OptionalTensor& cohesion, const OptionalTensor& volume,
                                      const OptionalTensor& scene, const std::string& energy, const std::string& flow,
                                      const std::string& apex) {
  STD_TORCH_CHECK(apex == "none" || apex == "zero" || apex == "keep", "apex must be none, zero or keep, got ", apex);
  SandArguments<T, D> a = sand_arguments<T, D>(F, mu, lam, scene);
  a.energy = energy_index<ReturnMaps<D>>(energy, flow);
  a.alpha = parameter<T>(alpha, "alpha", F, a.particles, has(scene));
  if (has(cohesion)) a.cohesion = parameter<T>(*cohesion, "cohesion", F, a.particles, has(scene));
  a.volume = input<T>(volume, "volume", F, {F.size(0)});
  a.plastic = apex != "none";
  a.keep_apex = apex == "keep";
  return a;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> quartic_return_map(
    const Tensor& F, const Tensor& mu, const Tensor& lam, const Tensor& alpha, const OptionalTensor& cohesion,
    const OptionalTensor& volume, const OptionalTensor& scene, std::string energy, std::string flow, std::string apex,
    bool details) {
  check_matrices(F, "F");
  const int64_t P = F.size(0);
  Tensor mapped, stress, branch = empty_int(F, {P}), multiplier, dissipated, corrected;
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    ReturnMapArguments<T, D> a;
    a.sand = plastic_arguments<T, D>(F, mu, lam, alpha, cohesion, volume, scene, energy, flow, apex);
    a.F = optional_result<T>(F, true, {P, D, D}, mapped);
    a.stress = optional_result<T>(F, true, {P, D, D}, stress);
    a.branch = static_cast<int*>(branch.data_ptr());
    a.multiplier = optional_result<T>(F, details, {P}, multiplier);
    a.dissipated = optional_result<T>(F, details, {P}, dissipated);
    a.volume = optional_result<T>(F, has(volume), {P}, corrected);
    backend::return_map(a, device.stream());
  });
  return {mapped, stress, branch, multiplier, dissipated, corrected};
}

std::tuple<Tensor, Tensor, Tensor> quartic_return_map_backward(
    const OptionalTensor& grad_F, const OptionalTensor& grad_stress, const OptionalTensor& grad_multiplier,
    const OptionalTensor& grad_dissipated, const OptionalTensor& grad_volume, const Tensor& F, const Tensor& mu,
    const Tensor& lam, const Tensor& alpha, const OptionalTensor& cohesion, const OptionalTensor& volume,
    const OptionalTensor& scene, std::string energy, std::string flow, std::string apex, bool needs_F,
    bool needs_parameters) {
  check_matrices(F, "F");
  const int64_t P = F.size(0);
  Tensor adjoint_F, adjoint_parameters, adjoint_volume;
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    ReturnMapBackwardArguments<T, D> a;
    a.sand = plastic_arguments<T, D>(F, mu, lam, alpha, cohesion, volume, scene, energy, flow, apex);
    a.grad_F = input<T>(grad_F, "grad_F", F, {P, D, D});
    a.grad_stress = input<T>(grad_stress, "grad_stress", F, {P, D, D});
    a.grad_multiplier = input<T>(grad_multiplier, "grad_multiplier", F, {P});
    a.grad_dissipated = input<T>(grad_dissipated, "grad_dissipated", F, {P});
    a.grad_volume = input<T>(grad_volume, "grad_volume", F, {P});
    a.F = optional_result<T>(F, needs_F, {P, D, D}, adjoint_F);
    a.parameters = optional_result<T>(F, needs_parameters, {P, 4}, adjoint_parameters);
    a.volume = optional_result<T>(F, has(volume), {P}, adjoint_volume);
    backend::return_map_backward(a, device.stream());
  });
  return {adjoint_F, adjoint_parameters, adjoint_volume};
}

Tensor sand_scalar(const Tensor& F, const Tensor& mu, const Tensor& lam, const OptionalTensor& scene,
                   const std::string& energy, bool stiffness, double floor) {
  check_matrices(F, "F");
  Tensor value = empty(F, {F.size(0)});
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    SandScalarArguments<T, D> a{sand_arguments<T, D>(F, mu, lam, scene), stiffness, T(floor), field<T>(value)};
    a.sand.energy = energy_index<SandEnergies>(energy, "radial");
    backend::sand_scalar(a, device.stream());
  });
  return value;
}

Tensor quartic_energy(const Tensor& F, const Tensor& mu, const Tensor& lam, const OptionalTensor& scene,
                      std::string energy) {
  return sand_scalar(F, mu, lam, scene, energy, false, 0);
}

Tensor quartic_stiffness(const Tensor& F, const Tensor& mu, const Tensor& lam, const OptionalTensor& scene,
                         std::string energy, double floor) {
  return sand_scalar(F, mu, lam, scene, energy, true, floor);
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "quartic_return_map(Tensor F, Tensor mu, Tensor lam, Tensor alpha, Tensor? cohesion, Tensor? volume, "
      "Tensor? scene, str energy, str flow, str apex, bool details) -> "
      "(Tensor F, Tensor stress, Tensor branch, Tensor multiplier, Tensor dissipated, Tensor volume)");
  m.def(
      "quartic_return_map_backward(Tensor? grad_F, Tensor? grad_stress, Tensor? grad_multiplier, "
      "Tensor? grad_dissipated, Tensor? grad_volume, Tensor F, Tensor mu, Tensor lam, Tensor alpha, Tensor? cohesion, "
      "Tensor? volume, Tensor? scene, str energy, str flow, str apex, bool needs_F, bool needs_parameters) -> "
      "(Tensor F, Tensor parameters, Tensor volume)");
  m.def("quartic_energy(Tensor F, Tensor mu, Tensor lam, Tensor? scene, str energy) -> Tensor");
  m.def("quartic_stiffness(Tensor F, Tensor mu, Tensor lam, Tensor? scene, str energy, float floor) -> Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("quartic_return_map", TORCH_BOX(&mpm::quartic_return_map));
  m.impl("quartic_return_map_backward", TORCH_BOX(&mpm::quartic_return_map_backward));
  m.impl("quartic_energy", TORCH_BOX(&mpm::quartic_energy));
  m.impl("quartic_stiffness", TORCH_BOX(&mpm::quartic_stiffness));
}
