// CUDA kernels of the laws of one header, MPM_LAW_HEADER: one thread per particle.
#define MPM_REGISTER_LAW(Law)                                                  \
  static constinit LawEntry Law##_entry = entry_of<cuda::LawLaunches, Law>(0); \
  static const bool Law##_is_entered = enter_law(Law##_entry);

#include "cuda/programmatic_launch.cuh"
#include "laws/registry.h"

namespace mpm::cuda {

// Thread blocks per multiprocessor, which bound the registers, or 0 for no bound. float64 takes twice as many
// registers.
template <class Law, class T>
constexpr int kUpdateBlocks = sizeof(T) == 4 ? Law::gpu_update_blocks : (Law::gpu_update_blocks + 1) / 2;

template <class Law, bool Adds, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads, kUpdateBlocks<Law, T>)
    law_update_kernel(const LawUpdateArguments<T, D> a) {
  if (a.runs_beside)
    let_next_kernel_begin();
  else
    grid_dependency_sync();
  using At = std::conditional_t<Adds, Adding<One<T>>, One<T>>;
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::update(a, At(One<T>{p}));
  grid_dependency_sync();  // since the next kernel waits only for this one
}

template <class Law, bool Adds, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads, Law::gpu_backward_blocks)
    law_backward_kernel(const LawBackwardArguments<T, D> a) {
  grid_dependency_sync();
  using At = std::conditional_t<Adds, Adding<One<T>>, One<T>>;
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::update_backward(a, At(One<T>{p}));
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads)
    law_double_backward_kernel(const LawDoubleBackwardArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::double_backward(a, One<T>{p});
}

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads) law_tangent_kernel(const LawTangentArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::tangent(a, One<T>{p});
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
  static unsigned blocks(int64_t particles) { return unsigned((particles + Law::gpu_threads - 1) / Law::gpu_threads); }
  template <class Arguments>
  static void for_particles(void (*kernel)(Arguments), const Arguments& a, void* stream) {
    if (a.law.particles > 0)
      launch(kernel, blocks(a.law.particles), Law::gpu_threads, 0, static_cast<Stream>(stream), a);
  }
  // For a kernel that waits for the previous one.
  template <class Arguments>
  static void in_chain(void (*kernel)(Arguments), const Arguments& a, void* stream) {
    if (a.law.particles > 0)
      launch_in_chain(kernel, blocks(a.law.particles), Law::gpu_threads, 0, static_cast<Stream>(stream), a);
  }

  static void update(const LawUpdateArguments<T, D>& a, void* stream) {
    if constexpr (Law::additive)
      if (a.adds) return in_chain(law_update_kernel<Law, true, T, D>, a, stream);
    in_chain(law_update_kernel<Law, false, T, D>, a, stream);
  }
  static void update_backward(const LawBackwardArguments<T, D>& a, void* stream) {
    if constexpr (kChangesNothing<Law>)
      if (a.adds) return in_chain(law_backward_kernel<Law, true, T, D>, a, stream);
    in_chain(law_backward_kernel<Law, false, T, D>, a, stream);
  }
  static void double_backward(const LawDoubleBackwardArguments<T, D>& a, void* stream) {
    for_particles(law_double_backward_kernel<Law, T, D>, a, stream);
  }
  static void tangent(const LawTangentArguments<T, D>& a, void* stream) {
    for_particles(law_tangent_kernel<Law, T, D>, a, stream);
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
