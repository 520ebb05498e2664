#include "cpu/lanes.h"
#include "pointwise/functions.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
void pointwise(const PointwiseArguments<T, D>& a) {
  with_function(a.function, [&]<class Function>() {
    for_groups<T>(a.count, [&](const auto& at) { Applied<Function, D>::forward_at(a, at); });
  });
}

template <class T, int D>
void pointwise_backward(const PointwiseBackwardArguments<T, D>& a) {
  with_function(a.function, [&]<class Function>() {
    for_groups<T, kRegisterBytes, false>(a.count, [&](const auto& at) { Applied<Function, D>::backward_at(a, at); });
  });
}

template <class T, int D>
void pointwise_second(const PointwiseSecondArguments<T, D>& a) {
  with_function(a.function, [&]<class Function>() {
    for_groups<T, kRegisterBytes, false>(a.count, [&](const auto& at) { Applied<Function, D>::second_at(a, at); });
  });
}

MPM_INSTANTIATE(pointwise, PointwiseArguments)
MPM_INSTANTIATE(pointwise_backward, PointwiseBackwardArguments)
MPM_INSTANTIATE(pointwise_second, PointwiseSecondArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
