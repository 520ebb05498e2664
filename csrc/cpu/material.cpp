#include "cpu/isa.h"
#include "cpu/material_launchers.h"

namespace mpm::cpu {

#define MPM_MATERIAL_DECLARATIONS                                      \
  template <class T, int D>                                            \
  void material_stress(const StressArguments<T, D>&);                  \
  template <class T, int D>                                            \
  void material_stress_backward(const StressBackwardArguments<T, D>&); \
  template <class T, int D>                                            \
  void material_scalar(const ScalarArguments<T, D>&);                  \
  template <class T, int D>                                            \
  void material_energy_backward(const EnergyBackwardArguments<T, D>&);
MPM_CPU_DECLARE_LEVELS(MPM_MATERIAL_DECLARATIONS)

template <class T, int D>
void material_stress(const StressArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(material_stress<T, D>(a));
}
template <class T, int D>
void material_stress_backward(const StressBackwardArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(material_stress_backward<T, D>(a));
}
template <class T, int D>
void material_scalar(const ScalarArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(material_scalar<T, D>(a));
}
template <class T, int D>
void material_energy_backward(const EnergyBackwardArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(material_energy_backward<T, D>(a));
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

}  // namespace mpm::cpu
