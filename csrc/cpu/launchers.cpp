#include "cpu/launchers.h"

#include "cpu/activate_layout.h"
#include "cpu/cell_order_launchers.h"
#include "cpu/g2p_advance_launchers.h"
#include "cpu/isa.h"
#include "cpu/kernels.h"

// Forwards each launcher to its kernels of the best instruction set.
namespace mpm::cpu {

#define MPM_CPU_DECLARE(name, Arguments) \
  template <int Order, class T, int D>   \
  void name(const Arguments<T, D>&);

MPM_CPU_DECLARE_LEVELS(MPM_CPU_KERNELS(MPM_CPU_DECLARE))

template <class T, int D>
int64_t activate_workspace(const ActivateArguments<T, D>& a) {
  return activate_layout(a, nullptr).size;
}

#define MPM_CPU_FORWARD(name, Arguments)        \
  template <int Order, class T, int D>          \
  void name(const Arguments<T, D>& a, Stream) { \
    MPM_CPU_CALL_BEST(name<Order, T, D>(a));    \
  }
MPM_CPU_KERNELS(MPM_CPU_FORWARD)

#define MPM_CPU_EXPORT(T, D)                                                 \
  template int64_t activate_workspace<T, D>(const ActivateArguments<T, D>&); \
  MPM_CPU_EXPORT_ORDER(T, D, 2)                                              \
  MPM_CPU_EXPORT_ORDER(T, D, 3)
#define MPM_CPU_EXPORT_ORDER(T, D, Order)                                             \
  template void activate<Order, T, D>(const ActivateArguments<T, D>&, Stream);        \
  template void cell_order<Order, T, D>(const CellOrderArguments<T, D>&, Stream);     \
  template void p2g<Order, T, D>(const P2GArguments<T, D>&, Stream);                  \
  template void p2g_backward<Order, T, D>(const P2GBackwardArguments<T, D>&, Stream); \
  template void scatter<Order, T, D>(const ScatterArguments<T, D>&, Stream);          \
  template void gather<Order, T, D>(const GatherArguments<T, D>&, Stream);            \
  template void g2p_advance<Order, T, D>(const G2PAdvanceArguments<T, D>&, Stream);   \
  template void position_gradient<Order, T, D>(const PositionGradientArguments<T, D>&, Stream);
MPM_CPU_EXPORT(float, 2)
MPM_CPU_EXPORT(float, 3)
MPM_CPU_EXPORT(double, 2)
MPM_CPU_EXPORT(double, 3)

}  // namespace mpm::cpu
