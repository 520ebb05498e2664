#include "cpu/lanes.h"
#include "laws/quartic_kernels.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
void return_map(const ReturnMapArguments<T, D>& a) {
  ReturnMaps<D>::visit(a.sand.energy, [&]<class Energy>() {
    for_groups<T>(a.sand.particles, [&](const auto& at) { return_map_at<Energy>(a, at); });
  });
}

template <class T, int D>
void return_map_backward(const ReturnMapBackwardArguments<T, D>& a) {
  ReturnMaps<D>::visit(a.sand.energy, [&]<class Energy>() {
    for_groups<T>(a.sand.particles, [&](const auto& at) { return_map_backward_at<Energy>(a, at); });
  });
}

template <class T, int D>
void sand_scalar(const SandScalarArguments<T, D>& a) {
  SandEnergies::visit(a.sand.energy, [&]<class Energy>() {
    for_groups<T>(a.sand.particles, [&](const auto& at) { sand_scalar_at<Energy>(a, at); });
  });
}

#define INSTANTIATE(T, D)                                                     \
  template void return_map(const ReturnMapArguments<T, D>&);                  \
  template void return_map_backward(const ReturnMapBackwardArguments<T, D>&); \
  template void sand_scalar(const SandScalarArguments<T, D>&);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
