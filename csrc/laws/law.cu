// The CUDA kernels of the laws of one header, MPM_LAW_HEADER: one thread per particle.
#define MPM_REGISTER_LAW(Law) static const bool Law##_is_entered = enter<cuda::LawLaunches, Law>(0);

#include "laws/registry.h"
#include "rollout/resident.cuh"

namespace mpm::cuda {

// Thread blocks per multiprocessor, which bound the registers, or 0: as the compiler likes. float64 takes twice as many
// registers.
template <class Law, class T>
constexpr int kUpdateBlocks = sizeof(T) == 4 ? Law::gpu_update_blocks : (Law::gpu_update_blocks + 1) / 2;

template <class Law, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads, kUpdateBlocks<Law, T>)
    law_update_kernel(const LawUpdateArguments<T, D> a) {
  wait_for_kernel_before();
  const int64_t p = int64_t(blockIdx.x) * Law::gpu_threads + threadIdx.x;
  if (p < a.law.particles && a.law.members.has(p)) Law::template Kernels<Law>::update(a, One<T>{p});
}

template <class Law, bool Adds, class T, int D>
__global__ void __launch_bounds__(Law::gpu_threads, Law::gpu_backward_blocks)
    law_backward_kernel(const LawBackwardArguments<T, D> a) {
  wait_for_kernel_before();
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

// The momentum of particles whose stress is computed as they are loaded, and kept where it has a place.
template <class Law, class T, int D>
struct LawMomentumSource : MomentumSource<2, T, D, Stress::moment, true> {
  using Base = MomentumSource<2, T, D, Stress::moment, true>;
  static constexpr int resident = Law::gpu_p2g_blocks;
  LawUpdateArguments<T, D> law;

  LawMomentumSource(const P2GArguments<T, D>& a, const LawUpdateArguments<T, D>& law) : Base(a), law(law) {}

  __device__ Matrix<T, D> update(int p) const {
    Matrix<T, D> stress;
    LawUpdateArguments<T, D> a = law;
    a.stress = {&stress[0][0], {0, D, 1}};
    Law::template Kernels<Law>::update(a, One<T>{p});
    if (law.stress.pointer) store_matrix<D>(One<T>{p}, law.stress, stress);
    return stress;
  }
  __device__ ParticleMomentum<T, D> load(int p, int scene) const {
    ParticleMomentum<T, D> m = Base::fields.read(p, scene, true, true);
    m.stress = update(p);
    return m;
  }
  __device__ void leave_out(int p) const { update(p); }
};

// Of float alone: in double the kernels would take all registers.
template <class Law, class T, int D>
struct FusedLaunch {};

template <class Law, int D>
struct FusedLaunch<Law, float, D> {
  static void p2g(const LawUpdateArguments<float, D>& law, const P2GArguments<float, D>& a, void* stream) {
    launch_scatter(LawMomentumSource<Law, float, D>(a, law), false, static_cast<Stream>(stream));
  }
  static void resident(const LawUpdateArguments<float, D>& law, const ResidentArguments<float, D>& a, void* stream) {
    launch_resident(LawMomentumSource<Law, float, D>(a.p2g, law), AdvanceGather<2, float, D, false, false>(a.advance),
                    a, static_cast<Stream>(stream));
  }
};

template <class Law, class T, int D>
struct LawLaunches : FusedLaunch<Law, T, D> {
  static unsigned blocks(int64_t particles) { return unsigned((particles + Law::gpu_threads - 1) / Law::gpu_threads); }
  template <class Arguments>
  static void for_particles(void (*kernel)(Arguments), const Arguments& a, void* stream) {
    if (a.law.particles > 0)
      launch(kernel, blocks(a.law.particles), Law::gpu_threads, 0, static_cast<Stream>(stream), a);
  }
  // Of a kernel that waits for the one before it.
  template <class Arguments>
  static void in_chain(void (*kernel)(Arguments), const Arguments& a, void* stream) {
    if (a.law.particles > 0)
      launch_in_chain(kernel, blocks(a.law.particles), Law::gpu_threads, 0, static_cast<Stream>(stream), a);
  }

  static void update(const LawUpdateArguments<T, D>& a, void* stream) {
    in_chain(law_update_kernel<Law, T, D>, a, stream);
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
