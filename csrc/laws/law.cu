// The CUDA kernels of the laws of one header, MPM_LAW_HEADER: one thread per particle.
#define MPM_REGISTER_LAW(Law) static const bool Law##_is_entered = enter<cuda::LawLaunches, Law>(0);

#include "cuda/launch.cuh"
#include "laws/registry.h"

namespace mpm::cuda {

// Thread blocks per multiprocessor, which bound the registers, or 0: as the compiler likes. float64 takes twice as many
// registers.
template <class Law, class T>
constexpr int kUpdateBlocks = sizeof(T) == 4 ? Law::gpu_update_blocks : (Law::gpu_update_blocks + 1) / 2;

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads, kUpdateBlocks<Law, T>)
    law_update_kernel(const LawUpdateArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::update(a, One<T>{p});
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads, Law::gpu_backward_blocks)
    law_backward_kernel(const LawBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::update_backward(a, One<T>{p});
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads)
    law_double_backward_kernel(const LawDoubleBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::double_backward(a, One<T>{p});
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads) law_scalar_kernel(const LawScalarArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::scalar(a, One<T>{p});
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads)
    law_energy_backward_kernel(const LawEnergyBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::energy_backward(a, One<T>{p});
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads)
    law_energy_double_backward_kernel(const LawEnergyDoubleBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::energy_double_backward(a, One<T>{p});
}

template <class Law, class T, int D>
struct LawLaunches {
  template <class Arguments>
  static void for_particles(void (*kernel)(Arguments), const Arguments& a, void* stream) {
    if (a.law.particles == 0) return;
    const unsigned blocks = unsigned((a.law.particles + Law::gpu_threads - 1) / Law::gpu_threads);
    launch(kernel, blocks, Law::gpu_threads, 0, static_cast<Stream>(stream), a);
  }

  static void update(const LawUpdateArguments<T, D>& a, void* stream) {
    for_particles(law_update_kernel<Law, T, D>, a, stream);
  }
  static void update_backward(const LawBackwardArguments<T, D>& a, void* stream) {
    for_particles(law_backward_kernel<Law, T, D>, a, stream);
  }
  static void double_backward(const LawDoubleBackwardArguments<T, D>& a, void* stream) {
    for_particles(law_double_backward_kernel<Law, T, D>, a, stream);
  }
  static void scalar(const LawScalarArguments<T, D>& a, void* stream) {
    for_particles(law_scalar_kernel<Law, T, D>, a, stream);
  }
  static void energy_backward(const LawEnergyBackwardArguments<T, D>& a, void* stream) {
    for_particles(law_energy_backward_kernel<Law, T, D>, a, stream);
  }
  static void energy_double_backward(const LawEnergyDoubleBackwardArguments<T, D>& a, void* stream) {
    for_particles(law_energy_double_backward_kernel<Law, T, D>, a, stream);
  }
};

}  // namespace mpm::cuda

#include MPM_LAW_HEADER
