#include "cpu/launchers.h"

#include <cstdlib>
#include <cstring>

#include "cpu/activate_layout.h"
#include "cpu/kernels.h"

// Chooses the instruction set once per process and forwards each launcher to its kernels.
namespace mpm::cpu {

#define MPM_CPU_DECLARE(name, Arguments) \
  template <int Order, class T, int D>   \
  void name(const Arguments<T, D>&);

inline namespace baseline {
MPM_CPU_KERNELS(MPM_CPU_DECLARE)
}
#ifdef __x86_64__
namespace avx2 {
MPM_CPU_KERNELS(MPM_CPU_DECLARE)
}
namespace avx512 {
MPM_CPU_KERNELS(MPM_CPU_DECLARE)
}
#endif

namespace {

enum class Level { baseline, avx2, avx512 };

// The best level of this machine, or a lower one asked for by TORCH_MPM_ISA_LEVEL.
Level choose_level() {
#ifdef __x86_64__
  const char* wish = std::getenv("TORCH_MPM_ISA_LEVEL");
  const auto at_most = [&](const char* name) { return wish && std::strcmp(wish, name) == 0; };
  __builtin_cpu_init();
  if (at_most("baseline") || !__builtin_cpu_supports("x86-64-v3")) return Level::baseline;
  if (at_most("avx2") || !__builtin_cpu_supports("x86-64-v4")) return Level::avx2;
  return Level::avx512;
#else
  return Level::baseline;
#endif
}

const Level level = choose_level();

}  // namespace

template <class T, int D>
int64_t activate_workspace(const ActivateArguments<T, D>& a) {
  return activate_layout(a, nullptr).size;
}

#ifdef __x86_64__
#define MPM_CPU_FORWARD(name, Arguments)                                    \
  template <int Order, class T, int D>                                      \
  void name(const Arguments<T, D>& a, Stream) {                             \
    if (level == Level::avx512) return avx512::name<Order, T, D>(a);        \
    if (level == Level::avx2) return avx2::name<Order, T, D>(a);            \
    baseline::name<Order, T, D>(a);                                         \
  }
#else
#define MPM_CPU_FORWARD(name, Arguments)        \
  template <int Order, class T, int D>          \
  void name(const Arguments<T, D>& a, Stream) { \
    baseline::name<Order, T, D>(a);             \
  }
#endif
MPM_CPU_KERNELS(MPM_CPU_FORWARD)

#define MPM_CPU_EXPORT(T, D)                                                  \
  template int64_t activate_workspace<T, D>(const ActivateArguments<T, D>&); \
  MPM_CPU_EXPORT_ORDER(T, D, 2)                                               \
  MPM_CPU_EXPORT_ORDER(T, D, 3)
#define MPM_CPU_EXPORT_ORDER(T, D, Order)                                                                 \
  template void activate<Order, T, D>(const ActivateArguments<T, D>&, Stream);                            \
  template void p2g<Order, T, D>(const P2GArguments<T, D>&, Stream);                                      \
  template void p2g_backward<Order, T, D>(const P2GBackwardArguments<T, D>&, Stream);                     \
  template void scatter<Order, T, D>(const ScatterArguments<T, D>&, Stream);                              \
  template void gather<Order, T, D>(const GatherArguments<T, D>&, Stream);                                \
  template void position_gradient<Order, T, D>(const PositionGradientArguments<T, D>&, Stream);
MPM_CPU_EXPORT(float, 2)
MPM_CPU_EXPORT(float, 3)
MPM_CPU_EXPORT(double, 2)
MPM_CPU_EXPORT(double, 3)

}  // namespace mpm::cpu
