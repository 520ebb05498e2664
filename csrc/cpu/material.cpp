#include "cpu/material_launchers.h"
#include "cpu/parallel.h"
#include "materials/kernels.h"

namespace mpm::cpu {
namespace {

constexpr int64_t kGrain = 2048;  // particles below which a range is not split

template <class F>
void for_particles(int64_t particles, const F& f) {
  parallel_ranges(particles, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; p++) f(p);
  });
}

}  // namespace

template <class T, int D>
void material_stress(const StressArguments<T, D>& a, Stream) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    for_particles(a.law.particles, [&](int64_t p) { stress_at<Law, T>(a, p); });
  });
}

template <class T, int D>
void material_stress_backward(const StressBackwardArguments<T, D>& a, Stream) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    for_particles(a.law.particles, [&](int64_t p) { stress_backward_at<Law, T>(a, p); });
  });
}

template <class T, int D>
void material_scalar(const ScalarArguments<T, D>& a, Stream) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    for_particles(a.law.particles, [&](int64_t p) {
      a.which == Scalar::energy ? energy_at<Law>(a, p) : modulus_at<Law, T>(a, p);
    });
  });
}

template <class T, int D>
void material_energy_backward(const EnergyBackwardArguments<T, D>& a, Stream) {
  AllLaws::visit(a.law.law, [&]<class Law>() {
    for_particles(a.law.particles, [&](int64_t p) { energy_backward_at<Law>(a, p); });
  });
}

#define INSTANTIATE(T, D)                                                              \
  template void material_stress(const StressArguments<T, D>&, Stream);                  \
  template void material_stress_backward(const StressBackwardArguments<T, D>&, Stream); \
  template void material_scalar(const ScalarArguments<T, D>&, Stream);                  \
  template void material_energy_backward(const EnergyBackwardArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cpu
