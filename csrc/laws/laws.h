#pragma once

#include "laws/neo_hookean.h"
#include "laws/viscous.h"
#include "laws/weakly_compressible.h"

// The laws that are compiled. A new law is one header and one name in AllLaws.
namespace mpm {
inline namespace TORCH_MPM_ISA {

struct ViscousFluid : Viscous<WeaklyCompressible> {
  static constexpr const char* name = "viscous_fluid";
};

template <class... Laws>
struct LawList {
  // Calls f.operator()<Law>() for the law of this index.
  template <class F>
  static void visit(int index, F&& f) {
    int i = 0;
    ((i++ == index ? f.template operator()<Laws>() : void()), ...);
  }
  static constexpr int size = sizeof...(Laws);
  static constexpr int most_parameters = [] {
    int n = 0;
    ((n = Laws::parameters > n ? Laws::parameters : n), ...);
    return n;
  }();
};

using AllLaws = LawList<NeoHookean, WeaklyCompressible, ViscousFluid>;

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
