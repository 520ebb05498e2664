#include "cuda/launch.cuh"
#include "pointwise/functions.h"

// One thread per row.
namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

template <class Function, class T, int D>
__global__ void __launch_bounds__(kThreads) forward_kernel(const __grid_constant__ PointwiseArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.count) Applied<Function, D>::forward_at(a, One<T>{p});
}

template <class Function, class T, int D>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(const __grid_constant__ PointwiseBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.count) Applied<Function, D>::backward_at(a, One<T>{p});
}

template <class Function, class T, int D>
__global__ void __launch_bounds__(kThreads) second_kernel(const __grid_constant__ PointwiseSecondArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.count) Applied<Function, D>::second_at(a, One<T>{p});
}

template <class Arguments>
void for_rows(void (*kernel)(Arguments), const std::remove_const_t<Arguments>& a, Stream stream) {
  if (a.count == 0) return;
  launch(kernel, unsigned((a.count + kThreads - 1) / kThreads), kThreads, 0, stream, a);
}

}  // namespace

template <class T, int D>
void pointwise(const PointwiseArguments<T, D>& a, Stream stream) {
  with_function(a.function, [&]<class Function>() { for_rows(forward_kernel<Function, T, D>, a, stream); });
}

template <class T, int D>
void pointwise_backward(const PointwiseBackwardArguments<T, D>& a, Stream stream) {
  with_function(a.function, [&]<class Function>() { for_rows(backward_kernel<Function, T, D>, a, stream); });
}

template <class T, int D>
void pointwise_second(const PointwiseSecondArguments<T, D>& a, Stream stream) {
  with_function(a.function, [&]<class Function>() { for_rows(second_kernel<Function, T, D>, a, stream); });
}

MPM_INSTANTIATE(pointwise, PointwiseArguments)
MPM_INSTANTIATE(pointwise_backward, PointwiseBackwardArguments)
MPM_INSTANTIATE(pointwise_second, PointwiseSecondArguments)

}  // namespace mpm::cuda
