#include "cuda/launch.cuh"
#include "laws/kernels.h"

// One thread per particle; the state is a structure of arrays, so that its loads and stores coalesce.
namespace mpm::cuda {
namespace {

constexpr int kThreads = 256;

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) stress_kernel(const StressArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) stress_at<Law, T>(a, p);
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) stress_backward_kernel(const StressBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) stress_backward_at<Law, T>(a, p);
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) modulus_kernel(const ScalarArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) modulus_at<Law, T>(a, p);
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) energy_kernel(const ScalarArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) energy_at<Law>(a, p);
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(kThreads) energy_backward_kernel(const EnergyBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p < a.law.particles) energy_backward_at<Law>(a, p);
}

template <class Arguments>
void for_particles(void (*kernel)(Arguments), const Arguments& a, Stream stream) {
  if (a.law.particles == 0) return;
  launch(kernel, unsigned((a.law.particles + kThreads - 1) / kThreads), kThreads, 0, stream, a);
}

}  // namespace

template <class T, int D>
void material_stress(const StressArguments<T, D>& a, Stream stream) {
  AllLaws::visit(a.law.law, [&]<class Law>() { for_particles(stress_kernel<Law, T, D>, a, stream); });
}

template <class T, int D>
void material_stress_backward(const StressBackwardArguments<T, D>& a, Stream stream) {
  AllLaws::visit(a.law.law, [&]<class Law>() { for_particles(stress_backward_kernel<Law, T, D>, a, stream); });
}

template <class T, int D>
void material_scalar(const ScalarArguments<T, D>& a, Stream stream) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    for_particles(a.which == Scalar::energy ? energy_kernel<Law, T, D> : modulus_kernel<Law, T, D>, a, stream);
  });
}

template <class T, int D>
void material_energy_backward(const EnergyBackwardArguments<T, D>& a, Stream stream) {
  AllLaws::visit(a.law.law, [&]<class Law>() { for_particles(energy_backward_kernel<Law, T, D>, a, stream); });
}

#define INSTANTIATE(T, D)                                                               \
  template void material_stress(const StressArguments<T, D>&, Stream);                  \
  template void material_stress_backward(const StressBackwardArguments<T, D>&, Stream); \
  template void material_scalar(const ScalarArguments<T, D>&, Stream);                  \
  template void material_energy_backward(const EnergyBackwardArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cuda
