#include "common/lanes.h"
#include "cuda/launch.cuh"
#include "implicit/arguments.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

template <class T, int D>
__global__ void __launch_bounds__(kThreads) tangent_product_kernel(const TangentProductArguments<T, D> a) {
  const One<T> at{int64_t(blockIdx.x) * kThreads + threadIdx.x};
  if (at.p >= a.particles) return;
  const Field<const T> given = {a.gradient.pointer, {a.gradient.stride[0], a.gradient.stride[1], a.gradient.stride[2]}};
  const Tangent<T, D> tangent = load_tangent<One<T>, T, D>(at, a.tangent);
  store_matrix<D>(at, a.gradient, apply_tangent(tangent, load_matrix<D>(at, given)));
}

}  // namespace

template <class T, int D>
void tangent_product(const TangentProductArguments<T, D>& a, Stream stream) {
  if (a.particles == 0) return;
  launch(tangent_product_kernel<T, D>, unsigned((a.particles + kThreads - 1) / kThreads), kThreads, 0, stream, a);
}

MPM_INSTANTIATE(tangent_product, TangentProductArguments)

}  // namespace mpm::cuda
