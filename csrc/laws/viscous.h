#pragma once

#include "laws/strain.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Any law with Newtonian viscosity beside it: Cauchy stress 2 η dev(sym C), so τ += 2 J η dev(sym C).
template <class Law>
struct Viscous : Law {
  static constexpr bool viscous = true;
  static constexpr int parameters = Law::parameters + 1;  // those of the law, η [Pa s]

  template <class T, int D>
  MPM_HD static Matrix<T, D> stress(const Strain<T, D>& s, const T p[]) {
    const Matrix<T, D> deviator = s.rate - (trace(s.rate) * T(1.0 / D)) * identity<T, D>();
    return Law::stress(s, p) + (T(2) * s.J * p[Law::parameters]) * deviator;
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
