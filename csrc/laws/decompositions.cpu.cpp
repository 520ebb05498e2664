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

MPM_INSTANTIATE(svd, SVDArguments)
MPM_INSTANTIATE(polar, PolarArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
