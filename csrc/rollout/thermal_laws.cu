#include "rollout/thermal_laws_backward.h"

#include "cuda/for_each.cuh"
#include "rollout/kernels.h"

// Laws of temperature in many substeps.
namespace mpm::cuda {

template <class T, int D>
void begin_thermal_laws(const ThermalLawsArguments<T, D>& a, Stream stream) {
  for_each<begin_laws_of<T, D>>(a.particles, a, stream);
}

template <class T, int D>
void end_thermal_laws(const ThermalLawsArguments<T, D>& a, Stream stream) {
  for_each<end_laws_of<T, D>>(a.particles, a, stream);
}

template <class T, int D>
void end_thermal_laws_backward(const ThermalLawsBackwardArguments<T, D>& a, Stream stream) {
  for_each<end_laws_backward<T, D>>(a.forward.particles, a, stream);
}

template <class T, int D>
void begin_thermal_laws_backward(const ThermalLawsBackwardArguments<T, D>& a, Stream stream) {
  for_each<begin_laws_backward<T, D>>(a.forward.particles, a, stream);
}

MPM_INSTANTIATE(begin_thermal_laws, ThermalLawsArguments)
MPM_INSTANTIATE(end_thermal_laws, ThermalLawsArguments)
MPM_INSTANTIATE(end_thermal_laws_backward, ThermalLawsBackwardArguments)
MPM_INSTANTIATE(begin_thermal_laws_backward, ThermalLawsBackwardArguments)

}  // namespace mpm::cuda
