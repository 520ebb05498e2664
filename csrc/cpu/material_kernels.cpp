#include "cpu/parallel.h"
#include "materials/kernels.h"
#include "math/pack.h"

// Particles in the lanes of packs, the last few one by one.
namespace mpm {
inline namespace TORCH_MPM_ISA {

constexpr int kLanes = 8;

template <class T>
struct Lane<Pack<T, kLanes>> {
  MPM_HD static Pack<T, kLanes> load(const T* pointer, int64_t stride) {
    if (stride == 1) return Pack<T, kLanes>::load(pointer);
    return each([&](int i) { return pointer[i * stride]; });
  }
  MPM_HD static void store(T* pointer, int64_t stride, const Pack<T, kLanes>& value) {
    if (stride == 1) return value.store(pointer);
    for (int i = 0; i < kLanes; i++) pointer[i * stride] = value[i];
  }
  template <class F>
  MPM_HD static Pack<T, kLanes> each(const F& f) {
    Pack<T, kLanes> r;
    for (int i = 0; i < kLanes; i++) r.set(i, f(i));
    return r;
  }
};

}  // namespace TORCH_MPM_ISA

namespace cpu {
inline namespace TORCH_MPM_ISA {

constexpr int64_t kGrain = 2048 / kLanes;  // packs below which a range is not split

// f.operator()<V>(p) for the particles p, ..., in V = packs or scalars.
template <class T, class F>
void for_particles(int64_t particles, const F& f) {
  parallel_ranges((particles + kLanes - 1) / kLanes, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin * kLanes; p < end * kLanes && p < particles; p += kLanes) {
      if (p + kLanes <= particles)
        f.template operator()<Pack<T, kLanes>>(p);
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
