#pragma once

#include "laws/invariants.h"

// Weakly compressible fluids, which laws/weakly_compressible.h registers. P2G evaluates them beside the law of a solid
// that melts.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// Weakly compressible fluid with the Tait-Murnaghan pressure p = K/γ (J^−γ − 1) (Monaghan 1994), so τ = −J p I.
// For γ = 1 that is τ = K (J − 1) I.
struct WeaklyCompressible : InvariantLaw {
  static constexpr const char* name = "weakly_compressible";
  static constexpr Deformation field = Deformation::volume_ratio;
  static constexpr std::array parameters = {not_negative("bulk_modulus", "Pa"), positive("gamma", "")};

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

// The same with Newtonian viscosity: Cauchy stress 2 η dev(sym C), so τ += 2 J η dev(sym C).
struct ViscousFluid : WeaklyCompressible {
  static constexpr const char* name = "viscous_fluid";
  static constexpr bool viscous = true;
  static constexpr std::array parameters = {WeaklyCompressible::parameters[0], WeaklyCompressible::parameters[1],
                                            not_negative("viscosity", "Pa s")};

  template <class T, int D>
  MPM_HD static Matrix<T, D> stress(const Strain<T, D>& s, const T p[]) {
    const Matrix<T, D> deviator = s.rate - (trace(s.rate) * T(1.0 / D)) * identity<T, D>();
    return WeaklyCompressible::stress(s, p) + (T(2) * s.J * p[2]) * deviator;
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
