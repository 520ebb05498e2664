#include "laws/decompositions.h"
#include "cpu/lanes.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
void svd(const SVDArguments<T, D>& a) {
  for_groups<T>(a.count, [&](const auto& at) { svd_at(a, at); });
}

template <class T, int D>
void polar(const PolarArguments<T, D>& a) {
  for_groups<T>(a.count, [&](const auto& at) { polar_at(a, at); });
}

#define INSTANTIATE(T, D)                       \
  template void svd(const SVDArguments<T, D>&); \
  template void polar(const PolarArguments<T, D>&);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
