#include "cpu/heat_launchers.h"
#include "cpu/heat_layout.h"
#include "cpu/isa.h"
#include "cpu/parallel.h"

namespace mpm::cpu {

#define MPM_HEAT_DECLARATIONS                             \
  template <int Order, class T, int D>                    \
  void heat_cg(const HeatArguments<T, D>&);               \
  template <int Order, class T, int D>                    \
  void heat_operator(const HeatOperatorArguments<T, D>&); \
  template <int Order, class T, int D>                    \
  void heat_stencil(const HeatOperatorArguments<T, D>&);
MPM_CPU_DECLARE_LEVELS(MPM_HEAT_DECLARATIONS)

template <class T, int D>
int64_t heat_workspace(const HeatArguments<T, D>& a) {
  return lay_out_heat(a, nullptr).size;
}
template <class T, int D>
int64_t heat_operator_workspace(const HeatOperatorArguments<T, D>&) {
  return 0;
}
template <int Order, class T, int D>
void heat_cg(const HeatArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(heat_cg<Order, T, D>(a));
}
template <int Order, class T, int D>
void heat_operator(const HeatOperatorArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(heat_operator<Order, T, D>(a));
}
template <int Order, class T, int D>
void heat_stencil(const HeatOperatorArguments<T, D>& a, Stream) {
  MPM_CPU_CALL_BEST(heat_stencil<Order, T, D>(a));
}
template <class T, int D>
void heat_patches(const PatchArguments<T, D>& a, Stream) {
  constexpr int64_t grain = 1024;  // patches below which a range is not split
  parallel_ranges(a.count, grain, [&](int64_t begin, int64_t end) {
    for (int64_t o = begin; o < end; o++)
      for (int k = 0; k < kCorners<D>; k++) solve_corner(a, o, k);
  });
  parallel_ranges(a.count, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i++) sum_corners(a, i);
  });
}

#define INSTANTIATE(T, D)                                                       \
  template int64_t heat_workspace(const HeatArguments<T, D>&);                  \
  template int64_t heat_operator_workspace(const HeatOperatorArguments<T, D>&); \
  template void heat_patches(const PatchArguments<T, D>&, Stream);              \
  INSTANTIATE_ORDER(2, T, D)                                                    \
  INSTANTIATE_ORDER(3, T, D)
#define INSTANTIATE_ORDER(Order, T, D)                                                  \
  template void heat_cg<Order, T, D>(const HeatArguments<T, D>&, Stream);               \
  template void heat_operator<Order, T, D>(const HeatOperatorArguments<T, D>&, Stream); \
  template void heat_stencil<Order, T, D>(const HeatOperatorArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cpu
