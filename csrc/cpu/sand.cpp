#include "cpu/isa.h"
#include "cpu/sand_launchers.h"

namespace mpm::cpu {

#define MPM_SAND_DECLARATIONS                                        \
  template <class T, int D>                                          \
  void return_map(const ReturnMapArguments<T, D>&);                  \
  template <class T, int D>                                          \
  void return_map_backward(const ReturnMapBackwardArguments<T, D>&); \
  template <class T, int D>                                          \
  void sand_scalar(const SandScalarArguments<T, D>&);
MPM_CPU_DECLARE_LEVELS(MPM_SAND_DECLARATIONS)

template <class T, int D>
void return_map(const ReturnMapArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(return_map<T, D>(a));
}
template <class T, int D>
void return_map_backward(const ReturnMapBackwardArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(return_map_backward<T, D>(a));
}
template <class T, int D>
void sand_scalar(const SandScalarArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(sand_scalar<T, D>(a));
}

#define INSTANTIATE(T, D)                                                             \
  template void return_map(const ReturnMapArguments<T, D>&, Stream);                  \
  template void return_map_backward(const ReturnMapBackwardArguments<T, D>&, Stream); \
  template void sand_scalar(const SandScalarArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cpu
