#include "cuda/launch.cuh"
#include "laws/quartic_kernels.h"

// One thread per particle.
namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

// Blocks per multiprocessor, which bound the registers. Those of the forward matter to the exact flow alone, whose rare
// roots in float64 would take as many as they need; the backward would lose a third of its time with 190.
template <class T>
constexpr int kForwardBlocks = sizeof(T) == 4 ? 5 : 3;
constexpr int kBackwardBlocks = 4;

template <class Energy, class T, int D>
__global__ void __launch_bounds__(kThreads, kForwardBlocks<T>) return_map_kernel(const ReturnMapArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.sand.particles) return_map_at<Energy>(a, One<T>{p});
}

template <class Energy, class T, int D>
__global__ void __launch_bounds__(kThreads, kBackwardBlocks)
    return_map_backward_kernel(const ReturnMapBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.sand.particles) return_map_backward_at<Energy>(a, One<T>{p});
}

template <class Energy, class T, int D>
__global__ void __launch_bounds__(kThreads) scalar_kernel(const SandScalarArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.sand.particles) sand_scalar_at<Energy>(a, One<T>{p});
}

template <class Arguments>
void for_particles(void (*kernel)(Arguments), const Arguments& a, Stream stream) {
  if (a.sand.particles == 0) return;
  launch(kernel, unsigned((a.sand.particles + kThreads - 1) / kThreads), kThreads, 0, stream, a);
}

}  // namespace

template <class T, int D>
void return_map(const ReturnMapArguments<T, D>& a, Stream stream) {
  ReturnMaps<D>::visit(a.sand.energy,
                       [&]<class Energy>() { for_particles(return_map_kernel<Energy, T, D>, a, stream); });
}

template <class T, int D>
void return_map_backward(const ReturnMapBackwardArguments<T, D>& a, Stream stream) {
  ReturnMaps<D>::visit(a.sand.energy,
                       [&]<class Energy>() { for_particles(return_map_backward_kernel<Energy, T, D>, a, stream); });
}

template <class T, int D>
void sand_scalar(const SandScalarArguments<T, D>& a, Stream stream) {
  SandEnergies::visit(a.sand.energy, [&]<class Energy>() { for_particles(scalar_kernel<Energy, T, D>, a, stream); });
}

#define INSTANTIATE(T, D)                                                             \
  template void return_map(const ReturnMapArguments<T, D>&, Stream);                  \
  template void return_map_backward(const ReturnMapBackwardArguments<T, D>&, Stream); \
  template void sand_scalar(const SandScalarArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cuda
