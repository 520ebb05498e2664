#include "cuda/programmatic_launch.cuh"
#include "transfer/advance.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

template <class T, int D>
__global__ void __launch_bounds__(kThreads) advance_kernel(const AdvanceArguments<T, D> a) {
  grid_dependency_sync();
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.particles) advance_particle(a, One<T>{p});
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) advance_backward_kernel(const AdvanceBackwardArguments<T, D> a) {
  grid_dependency_sync();
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.forward.particles) advance_particle_backward(a, One<T>{p});
}

unsigned blocks_for(int64_t particles) { return unsigned((particles + kThreads - 1) / kThreads); }

}  // namespace

template <class T, int D>
void advance(const AdvanceArguments<T, D>& a, Stream stream) {
  if (a.particles == 0) return;
  launch_in_chain(advance_kernel<T, D>, blocks_for(a.particles), kThreads, 0, stream, a);
}

template <class T, int D>
void advance_backward(const AdvanceBackwardArguments<T, D>& a, Stream stream) {
  if (a.forward.particles == 0) return;
  launch_in_chain(advance_backward_kernel<T, D>, blocks_for(a.forward.particles), kThreads, 0, stream, a);
}

MPM_INSTANTIATE(advance, AdvanceArguments)
MPM_INSTANTIATE(advance_backward, AdvanceBackwardArguments)

}  // namespace mpm::cuda
