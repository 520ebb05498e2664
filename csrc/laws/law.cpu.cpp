// CPU loops of the laws of one header, MPM_LAW_HEADER.
#define MPM_REGISTER_LAW(Law)                                                                           \
  static constinit LawEntry Law##_entry = entry_of<cpu::LawLoops, Law>(int(cpu::Level::TORCH_MPM_ISA)); \
  static const bool Law##_is_entered = enter_law(Law##_entry);

#include "cpu/isa.h"
#include "cpu/lanes.h"
#include "laws/registry.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class Law, class T, int D>
struct LawLoops {
  using Kernels = typename Law::template Kernels<Law>;
  // Where memory limits a kernel, packs fill cache lines: the 18 arrays of F and τ may share cache sets (when P is a
  // power of two), and then a line does not survive until its other half is read.
  static constexpr int kBytes = Law::memory_bound ? 64 : kRegisterBytes;

  template <int Bytes, class F>
  static void by_groups(const LawArguments<T, D>& a, const F& body) {
    for_groups<T, Bytes, Law::memory_bound>(a.particles, body, a.members);
  }

  // Without packs: rarely called functions, which would take minutes to compile with dual numbers of packs.
  template <class F>
  static void one_by_one(const LawArguments<T, D>& a, const F& body) {
    constexpr int64_t grain = 256;  // particles below which a range is not split
    parallel_ranges(a.particles, grain, [&](int64_t begin, int64_t end) {
      for (int64_t p = begin; p < end; p++)
        if (a.members.has(p)) body(One<T>{p});
    });
  }

  static void update(const LawUpdateArguments<T, D>& a, void*) {
    if constexpr (Law::additive)
      if (a.adds) return by_groups<kBytes>(a.law, [&](const auto& at) { Kernels::update(a, Adding(at)); });
    by_groups<kBytes>(a.law, [&](const auto& at) { Kernels::update(a, at); });
  }
  static void update_backward(const LawBackwardArguments<T, D>& a, void*) {
    if constexpr (kChangesNothing<Law>)
      if (a.adds) return by_groups<kBytes>(a.law, [&](const auto& at) { Kernels::update_backward(a, Adding(at)); });
    by_groups<kBytes>(a.law, [&](const auto& at) { Kernels::update_backward(a, at); });
  }
  static void double_backward(const LawDoubleBackwardArguments<T, D>& a, void*) {
    one_by_one(a.law, [&](const auto& at) { Kernels::double_backward(a, at); });
  }
  static void tangent(const LawTangentArguments<T, D>& a, void*) {
    by_groups<kRegisterBytes>(a.law, [&](const auto& at) { Kernels::tangent(a, at); });
  }
  static void scalar(const LawScalarArguments<T, D>& a, void*) {
    by_groups<kRegisterBytes>(a.law, [&](const auto& at) { Kernels::scalar(a, at); });
  }
  // With a decomposition, which is written for packs; nested dual numbers of packs would take minutes to compile
  // without.
  template <class F>
  static void for_energies(const LawArguments<T, D>& a, const F& body) {
    if constexpr (Law::twice_differentiable)
      one_by_one(a, body);
    else
      by_groups<kRegisterBytes>(a, body);
  }
  static void energy_backward(const LawEnergyBackwardArguments<T, D>& a, void*) {
    for_energies(a.law, [&](const auto& at) { Kernels::energy_backward(a, at); });
  }
  static void energy_double_backward(const LawEnergyDoubleBackwardArguments<T, D>& a, void*) {
    for_energies(a.law, [&](const auto& at) { Kernels::energy_double_backward(a, at); });
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu

#include MPM_LAW_HEADER
