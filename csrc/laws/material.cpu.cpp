#include "common/pack.h"
#include "cpu/parallel.h"
#include "laws/kernels.h"

// Particles in the lanes of packs, the last few one by one.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T, int N>
struct Lane<Pack<T, N>> {
  MPM_HD static Pack<T, N> load(const T* pointer, int64_t stride) {
    if (stride == 1) return Pack<T, N>::load(pointer);
    return each([&](int i) { return pointer[i * stride]; });
  }
  MPM_HD static void store(T* pointer, int64_t stride, const Pack<T, N>& value) {
    if (stride == 1) return value.store(pointer);
    for (int i = 0; i < N; i++) pointer[i * stride] = value[i];
  }
  template <class F>
  MPM_HD static Pack<T, N> each(const F& f) {
    Pack<T, N> r;
    for (int i = 0; i < N; i++) r.set(i, f(i));
    return r;
  }
};

}  // namespace TORCH_MPM_ISA

namespace cpu {
inline namespace TORCH_MPM_ISA {

constexpr int64_t kGrain = 128;  // packs below which a range is not split

// f.operator()<V>(p) for the particles p, ..., in V = packs or scalars. A pack is a cache line: the 18 arrays of F and
// τ may fall on the same cache sets (when P is a power of two), and then a line does not survive until its other half
// is read.
template <class T, class F>
void for_particles(int64_t particles, const F& f) {
  constexpr int lanes = 64 / sizeof(T);
  parallel_ranges((particles + lanes - 1) / lanes, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin * lanes; p < end * lanes && p < particles; p += lanes) {
      if (p + lanes <= particles)
        f.template operator()<Pack<T, lanes>>(p);
      else
        for (int64_t q = p; q < particles; q++) f.template operator()<T>(q);
    }
  });
}

template <class T, int D>
void material_stress(const StressArguments<T, D>& a) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    for_particles<T>(a.law.particles, [&]<class V>(int64_t p) { stress_at<Law, V>(a, p); });
  });
}

template <class T, int D>
void material_stress_backward(const StressBackwardArguments<T, D>& a) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    for_particles<T>(a.law.particles, [&]<class V>(int64_t p) { stress_backward_at<Law, V>(a, p); });
  });
}

template <class T, int D>
void material_scalar(const ScalarArguments<T, D>& a) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    if (a.which != Scalar::energy)
      return for_particles<T>(a.law.particles, [&]<class V>(int64_t p) { modulus_at<Law, V>(a, p); });
    parallel_ranges(a.law.particles, kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t p = begin; p < end; p++) energy_at<Law>(a, p);
    });
  });
}

template <class T, int D>
void material_energy_backward(const EnergyBackwardArguments<T, D>& a) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    parallel_ranges(a.law.particles, kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t p = begin; p < end; p++) energy_backward_at<Law>(a, p);
    });
  });
}

#define INSTANTIATE(T, D)                                                       \
  template void material_stress(const StressArguments<T, D>&);                  \
  template void material_stress_backward(const StressBackwardArguments<T, D>&); \
  template void material_scalar(const ScalarArguments<T, D>&);                  \
  template void material_energy_backward(const EnergyBackwardArguments<T, D>&);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace TORCH_MPM_ISA
}  // namespace cpu
}  // namespace mpm
