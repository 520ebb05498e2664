#pragma once

#include <span>
#include <string>

#include "laws/law.h"

// Registry of the compiled laws with their kernels. Each object file of laws/law.cpu.cpp and laws/law.cu registers its
// laws when the library is loaded; ops find them by name, and Python reads the whole list. Entries are constants, so
// that objects of all instruction sets can be loaded: none of their code runs before the best one is chosen.
namespace mpm {

struct LawInfo {
  const char* name = "";
  Deformation field = Deformation::gradient;
  bool viscous = false, plastic = false, optional_history = false, twice_differentiable = false,
       twice_differentiable_energy = false, has_tangent = false, in_2d = true, additive = false;
  std::span<const Quantity> parameters, history;
  std::span<const char* const> options;

  bool changes() const { return plastic || !history.empty(); }  // deformation or history
};

// For one scalar and dimension; the stream is that of CUDA, or null. Missing kernels of a law are null.
template <class T, int D>
struct LawKernels {
  void (*update)(const LawUpdateArguments<T, D>&, void* stream) = nullptr;
  void (*update_backward)(const LawBackwardArguments<T, D>&, void* stream) = nullptr;
  void (*double_backward)(const LawDoubleBackwardArguments<T, D>&, void* stream) = nullptr;
  void (*scalar)(const LawScalarArguments<T, D>&, void* stream) = nullptr;
  void (*energy_backward)(const LawEnergyBackwardArguments<T, D>&, void* stream) = nullptr;
  void (*energy_double_backward)(const LawEnergyDoubleBackwardArguments<T, D>&, void* stream) = nullptr;
  void (*tangent)(const LawTangentArguments<T, D>&, void* stream) = nullptr;
};

struct LawEntry {
  LawInfo info;
  int level = 0;  // instruction set, in the CPU library
  LawKernels<float, 2> float_2;
  LawKernels<float, 3> float_3;
  LawKernels<double, 2> double_2;
  LawKernels<double, 3> double_3;

  template <class T, int D>
  LawKernels<T, D>& kernels() {
    if constexpr (sizeof(T) == sizeof(float)) {
      if constexpr (D == 2)
        return float_2;
      else
        return float_3;
    } else {
      if constexpr (D == 2)
        return double_2;
      else
        return double_3;
    }
  }
};

// Registers a law.
bool enter_law(LawEntry& law);

// Null where the name is unknown for the instruction set in use.
LawEntry* find_law(const std::string& name);

// In the form that Python reads.
std::string laws_as_json();
std::string law_names();

inline namespace TORCH_MPM_ISA {

template <class Law>
constexpr LawInfo info_of() {
  return {Law::name,
          Law::field,
          Law::viscous,
          Law::plastic,
          Law::optional_history,
          Law::twice_differentiable,
          Law::twice_differentiable_energy,
          Law::has_tangent,
          Law::in_2d,
          Law::additive,
          Law::parameters,
          Law::history,
          Law::options};
}

// Kernels<Law, T, D> has the functions of LawKernels as static members.
template <template <class, class, int> class Kernels, class Law, class T, int D>
constexpr LawKernels<T, D> all_kernels() {
  static_assert(kParameters<Law> <= kMostParameters && kHistory<Law> <= kMostHistory);
  static_assert(kChangesNothing<Law> || (!Law::viscous && Law::field == Deformation::gradient),
                "rollout/substeps_backward.op.cpp has no term for it");
  static_assert(!Law::additive || kChangesNothing<Law>, "only what changes nothing can be beside another law");
  LawKernels<T, D> kernels;
  if constexpr (D == 3 || Law::in_2d) {
    using K = Kernels<Law, T, D>;
    kernels.update = K::update;
    kernels.update_backward = K::update_backward;
    kernels.scalar = K::scalar;
    kernels.energy_backward = K::energy_backward;
    if constexpr (Law::has_tangent) kernels.tangent = K::tangent;
    if constexpr (Law::twice_differentiable) kernels.double_backward = K::double_backward;
    if constexpr (Law::twice_differentiable_energy) kernels.energy_double_backward = K::energy_double_backward;
  }
  return kernels;
}

template <template <class, class, int> class Kernels, class Law>
constexpr LawEntry entry_of(int level) {
  return {info_of<Law>(),
          level,
          all_kernels<Kernels, Law, float, 2>(),
          all_kernels<Kernels, Law, float, 3>(),
          all_kernels<Kernels, Law, double, 2>(),
          all_kernels<Kernels, Law, double, 3>()};
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
