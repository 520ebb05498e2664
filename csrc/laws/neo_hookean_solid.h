#pragma once

#include "laws/invariants.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Compressible neo-Hookean solid (Bonet and Wood 2008, section 6.4.3):
//   ψ = μ/2 (tr F Fᵀ − D) − μ ln J + λ/2 (ln J)²,   τ = μ (F Fᵀ − I) + λ ln J I.
struct NeoHookean : InvariantLaw {
  static constexpr const char* name = "neo_hookean";
  static constexpr Deformation field = Deformation::gradient;
  static constexpr std::array parameters = {not_negative("mu", "Pa"), real("lam", "Pa")};

  template <class T, int D>
  MPM_HD static T energy(const Strain<T, D>& s, const T p[]) {
    const T& mu = p[0];
    const T& lam = p[1];
    return mu * (T(0.5) * trace(s.e) - s.log_J) + T(0.5) * lam * s.log_J * s.log_J;
  }

  template <class T, int D>
  MPM_HD static Matrix<T, D> stress(const Strain<T, D>& s, const T p[]) {
    const T& mu = p[0];
    const T& lam = p[1];
    return mu * s.e + (lam * s.log_J) * identity<T, D>();
  }

  // ρ₀ c² of the fastest plane wave. Along n the acoustic tensor is μ |Fᵀn|² I + (μ + λ (1 − ln J)) n nᵀ.
  template <class T, int D>
  MPM_HD static T wave_modulus(const Strain<T, D>& s, const T p[]) {
    const T& mu = p[0];
    const T& lam = p[1];
    return mu * largest_stretch(s) + max(T(0), mu + lam * (T(1) - s.log_J));
  }

  // Upper bound, over velocity gradients G with |G| = 1, of the second variation of ψ,
  //   μ |G F|² + a tr G² + λ (tr G)²  with a = μ − λ ln J,
  // and of |dτ/dF : G F|, the tangent of a step before the particles have moved.
  template <class T, int D>
  MPM_HD static T stiffness(const Strain<T, D>& s, const T p[]) {
    const T& mu = p[0];
    const T& lam = p[1];
    const T stretch = mu * largest_stretch(s), a = mu - lam * s.log_J, dilation = T(D) * lam;
    return stretch + max(max(T(0) - a, a), max(a + dilation, stretch + max(T(0), dilation)));
  }

 private:
  template <class T, int D>
  MPM_HD static T largest_stretch(const Strain<T, D>& s) {  // squared
    return largest_eigenvalue_bound(s.e + identity<T, D>());
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
