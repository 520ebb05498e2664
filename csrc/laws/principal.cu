#include "cuda/launch.cuh"
#include "laws/principal_kernels.h"

// One thread per particle, one kernel per law.
namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) update_kernel(const PrincipalUpdateArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) principal_update_at(a, One<T>{p}, Only<Law>());
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) backward_kernel(const PrincipalBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) principal_backward_at(a, One<T>{p}, Only<Law>());
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) scalar_kernel(const PrincipalScalarArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) principal_scalar_at(a, One<T>{p}, Only<Law>());
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) energy_backward_kernel(const PrincipalEnergyBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) principal_energy_backward_at(a, One<T>{p}, Only<Law>());
}

template <class Arguments>
void for_particles(void (*kernel)(Arguments), const Arguments& a, Stream stream) {
  if (a.law.particles == 0) return;
  launch(kernel, unsigned((a.law.particles + kThreads - 1) / kThreads), kThreads, 0, stream, a);
}

}  // namespace

template <class T, int D>
void principal_update(const PrincipalUpdateArguments<T, D>& a, Stream stream) {
  PrincipalLaws::visit(a.law.law, [&]<class Law>() { for_particles(update_kernel<Law, T, D>, a, stream); });
}

template <class T, int D>
void principal_backward(const PrincipalBackwardArguments<T, D>& a, Stream stream) {
  PrincipalLaws::visit(a.law.law, [&]<class Law>() { for_particles(backward_kernel<Law, T, D>, a, stream); });
}

template <class T, int D>
void principal_scalar(const PrincipalScalarArguments<T, D>& a, Stream stream) {
  PrincipalLaws::visit(a.law.law, [&]<class Law>() { for_particles(scalar_kernel<Law, T, D>, a, stream); });
}

template <class T, int D>
void principal_energy_backward(const PrincipalEnergyBackwardArguments<T, D>& a, Stream stream) {
  PrincipalLaws::visit(a.law.law, [&]<class Law>() { for_particles(energy_backward_kernel<Law, T, D>, a, stream); });
}

#define INSTANTIATE(T, D)                                                            \
  template void principal_update(const PrincipalUpdateArguments<T, D>&, Stream);     \
  template void principal_backward(const PrincipalBackwardArguments<T, D>&, Stream); \
  template void principal_scalar(const PrincipalScalarArguments<T, D>&, Stream);     \
  template void principal_energy_backward(const PrincipalEnergyBackwardArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cuda
