#include "cpu/lanes.h"
#include "laws/principal_kernels.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// body(at, choose) for the particles in groups of one register, with a choice among all laws: one decomposition serves
// them all.
template <class T, int D, class F>
void for_strains(const PrincipalArguments<T, D>& a, const F& body) {
  for_groups<T>(a.particles, [&](const auto& at) { body(at, [&](const auto& f) { PrincipalLaws::visit(a.law, f); }); });
}

template <class T, int D>
void principal_update(const PrincipalUpdateArguments<T, D>& a) {
  for_strains(a.law, [&](const auto& at, const auto& choose) { principal_update_at(a, at, choose); });
}

template <class T, int D>
void principal_backward(const PrincipalBackwardArguments<T, D>& a) {
  for_strains(a.law, [&](const auto& at, const auto& choose) { principal_backward_at(a, at, choose); });
}

template <class T, int D>
void principal_scalar(const PrincipalScalarArguments<T, D>& a) {
  for_strains(a.law, [&](const auto& at, const auto& choose) { principal_scalar_at(a, at, choose); });
}

template <class T, int D>
void principal_energy_backward(const PrincipalEnergyBackwardArguments<T, D>& a) {
  for_strains(a.law, [&](const auto& at, const auto& choose) { principal_energy_backward_at(a, at, choose); });
}

#define INSTANTIATE(T, D)                                                    \
  template void principal_update(const PrincipalUpdateArguments<T, D>&);     \
  template void principal_backward(const PrincipalBackwardArguments<T, D>&); \
  template void principal_scalar(const PrincipalScalarArguments<T, D>&);     \
  template void principal_energy_backward(const PrincipalEnergyBackwardArguments<T, D>&);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
