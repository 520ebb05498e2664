// The CPU loops of the laws of one header, MPM_LAW_HEADER.
#define MPM_REGISTER_LAW(Law) \
  static const bool Law##_is_entered = enter<cpu::LawLoops, Law>(int(cpu::Level::TORCH_MPM_ISA));

#include "cpu/isa.h"
#include "cpu/lanes.h"
#include "laws/registry.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class Law, class T, int D>
struct LawLoops {
  using Kernels = typename Law::template Kernels<Law>;
  static constexpr int kBytes = Law::packs_fill_cache_lines ? 64 : kRegisterBytes;

  // Without packs: what is seldom called, and would take minutes to compile with dual numbers of packs.
  template <class F>
  static void one_by_one(int64_t particles, const F& body) {
    constexpr int64_t grain = 256;  // particles below which a range is not split
    parallel_ranges(particles, grain, [&](int64_t begin, int64_t end) {
      for (int64_t p = begin; p < end; p++) body(One<T>{p});
    });
  }

  static void update(const LawUpdateArguments<T, D>& a, void*) {
    for_groups<T, kBytes>(a.law.particles, [&](const auto& at) { Kernels::update(a, at); });
  }
  static void update_backward(const LawBackwardArguments<T, D>& a, void*) {
    for_groups<T, kBytes>(a.law.particles, [&](const auto& at) { Kernels::update_backward(a, at); });
  }
  static void double_backward(const LawDoubleBackwardArguments<T, D>& a, void*) {
    one_by_one(a.law.particles, [&](const auto& at) { Kernels::double_backward(a, at); });
  }
  static void scalar(const LawScalarArguments<T, D>& a, void*) {
    for_groups<T>(a.law.particles, [&](const auto& at) { Kernels::scalar(a, at); });
  }
  static void energy_backward(const LawEnergyBackwardArguments<T, D>& a, void*) {
    const auto body = [&](const auto& at) { Kernels::energy_backward(a, at); };
    if constexpr (Law::twice_differentiable)
      one_by_one(a.law.particles, body);
    else
      for_groups<T>(a.law.particles, body);
  }
  static void energy_double_backward(const LawEnergyDoubleBackwardArguments<T, D>& a, void*) {
    one_by_one(a.law.particles, [&](const auto& at) { Kernels::energy_double_backward(a, at); });
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu

#include MPM_LAW_HEADER
