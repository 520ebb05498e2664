#include "cpu/isa.h"
#include "cpu/principal_launchers.h"

namespace mpm::cpu {

#define MPM_PRINCIPAL_DECLARATIONS                                  \
  template <class T, int D>                                         \
  void principal_update(const PrincipalUpdateArguments<T, D>&);     \
  template <class T, int D>                                         \
  void principal_backward(const PrincipalBackwardArguments<T, D>&); \
  template <class T, int D>                                         \
  void principal_scalar(const PrincipalScalarArguments<T, D>&);     \
  template <class T, int D>                                         \
  void principal_energy_backward(const PrincipalEnergyBackwardArguments<T, D>&);
MPM_CPU_DECLARE_LEVELS(MPM_PRINCIPAL_DECLARATIONS)

template <class T, int D>
void principal_update(const PrincipalUpdateArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(principal_update<T, D>(a));
}
template <class T, int D>
void principal_backward(const PrincipalBackwardArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(principal_backward<T, D>(a));
}
template <class T, int D>
void principal_scalar(const PrincipalScalarArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(principal_scalar<T, D>(a));
}
template <class T, int D>
void principal_energy_backward(const PrincipalEnergyBackwardArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(principal_energy_backward<T, D>(a));
}

#define INSTANTIATE(T, D)                                                            \
  template void principal_update(const PrincipalUpdateArguments<T, D>&, Stream);     \
  template void principal_backward(const PrincipalBackwardArguments<T, D>&, Stream); \
  template void principal_scalar(const PrincipalScalarArguments<T, D>&, Stream);     \
  template void principal_energy_backward(const PrincipalEnergyBackwardArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cpu
