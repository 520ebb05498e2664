#pragma once

#include "laws/strain.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Weakly compressible fluid with the Tait-Murnaghan pressure p = K/γ (J^−γ − 1) (Monaghan 1994), so τ = −J p I.
// For γ = 1 that is τ = K (J − 1) I.
struct WeaklyCompressible {
  static constexpr const char* name = "weakly_compressible";
  static constexpr bool shear = false;
  static constexpr bool viscous = false;
  static constexpr int parameters = 2;  // K [Pa], γ

  template <class T, int D>
  MPM_HD static T energy(const Strain<T, D>& s, const T p[]) {
    return p[0] / p[1] * (s.volumetric - s.log_J * expm1_quotient((T(1) - p[1]) * s.log_J));
  }

  template <class T, int D>
  MPM_HD static Matrix<T, D> stress(const Strain<T, D>& s, const T p[]) {
    return tension(s, p) * identity<T, D>();
  }

  // ρ₀ c² = K J^(1−γ).
  template <class T, int D>
  MPM_HD static T wave_modulus(const Strain<T, D>& s, const T p[]) {
    return p[0] * s.J * (T(1) + power_minus_1(s, p));
  }

  // Upper bound of the second variation t' (tr G)² − t tr G², with t the tension and t' = dt/d ln J, and of |dτ/dF : G
  // F|.
  template <class T, int D>
  MPM_HD static T stiffness(const Strain<T, D>& s, const T p[]) {
    const T t = tension(s, p);
    return T(D) * (wave_modulus(s, p) + t) + max(T(0), T(0) - t);
  }

 private:
  template <class T, int D>
  MPM_HD static T tension(const Strain<T, D>& s, const T p[]) {  // −J p
    return T(0) - p[0] / p[1] * s.J * power_minus_1(s, p);
  }

  template <class T, int D>
  MPM_HD static T power_minus_1(const Strain<T, D>& s, const T p[]) {  // J^−γ − 1
    return expm1((T(0) - p[1]) * s.log_J);
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
