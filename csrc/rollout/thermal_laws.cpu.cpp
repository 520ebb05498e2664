#include "rollout/thermal_laws_backward.h"

#include "common/instantiate.h"
#include "cpu/parallel.h"

// Laws of temperature in many substeps that are computed kernel by kernel: those with a record.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 4096;  // particles below which a range is not split

template <class F>
void for_each(int64_t particles, const F& visit) {
  parallel_ranges(particles, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; p++) visit(p);
  });
}

}  // namespace

template <class T, int D>
void begin_thermal_laws(const ThermalLawsArguments<T, D>& a) {
  for_each(a.particles, [&](int64_t p) { begin_laws_of(a, p); });
}

template <class T, int D>
void end_thermal_laws(const ThermalLawsArguments<T, D>& a) {
  for_each(a.particles, [&](int64_t p) { end_laws_of(a, p); });
}

template <class T, int D>
void end_thermal_laws_backward(const ThermalLawsBackwardArguments<T, D>& a) {
  for_each(a.forward.particles, [&](int64_t p) { end_laws_backward(a, p); });
}

template <class T, int D>
void begin_thermal_laws_backward(const ThermalLawsBackwardArguments<T, D>& a) {
  for_each(a.forward.particles, [&](int64_t p) { begin_laws_backward(a, p); });
}

MPM_INSTANTIATE(begin_thermal_laws, ThermalLawsArguments)
MPM_INSTANTIATE(end_thermal_laws, ThermalLawsArguments)
MPM_INSTANTIATE(end_thermal_laws_backward, ThermalLawsBackwardArguments)
MPM_INSTANTIATE(begin_thermal_laws_backward, ThermalLawsBackwardArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
