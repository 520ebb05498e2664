#include "cuda/launch.cuh"
#include "laws/decompositions.h"

// One thread per matrix.
namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

template <class T, int D>
__global__ void __launch_bounds__(kThreads) svd_kernel(const SVDArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.count) svd_at(a, One<T>{p});
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) polar_kernel(const PolarArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.count) polar_at(a, One<T>{p});
}

template <class Arguments>
void for_matrices(void (*kernel)(Arguments), const Arguments& a, Stream stream) {
  if (a.count == 0) return;
  launch(kernel, unsigned((a.count + kThreads - 1) / kThreads), kThreads, 0, stream, a);
}

}  // namespace

template <class T, int D>
void svd(const SVDArguments<T, D>& a, Stream stream) {
  for_matrices(svd_kernel<T, D>, a, stream);
}

template <class T, int D>
void polar(const PolarArguments<T, D>& a, Stream stream) {
  for_matrices(polar_kernel<T, D>, a, stream);
}

MPM_INSTANTIATE(svd, SVDArguments)
MPM_INSTANTIATE(polar, PolarArguments)

}  // namespace mpm::cuda
