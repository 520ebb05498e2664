#include "cpu/isa.h"
#include "cpu/svd_launchers.h"

namespace mpm::cpu {

#define MPM_SVD_DECLARATIONS           \
  template <class T, int D>            \
  void svd(const SVDArguments<T, D>&); \
  template <class T, int D>            \
  void polar(const PolarArguments<T, D>&);
MPM_CPU_DECLARE_LEVELS(MPM_SVD_DECLARATIONS)

template <class T, int D>
void svd(const SVDArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(svd<T, D>(a));
}
template <class T, int D>
void polar(const PolarArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(polar<T, D>(a));
}

#define INSTANTIATE(T, D)                               \
  template void svd(const SVDArguments<T, D>&, Stream); \
  template void polar(const PolarArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cpu
