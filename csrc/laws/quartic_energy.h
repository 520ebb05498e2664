#pragma once

#include "laws/hencky_strain.h"

// Sand in terms of the Hencky strains h (logarithms of the principal stretches): energies, stresses, moduli.
//
// The quartic energy of Gao et al. 2018 (supplement, equations 15, 17 and 22), with c = h, or c = min(h, 0) where the
// energy is unilateral, and likewise for the trace:
//   ψ = aμ Σ cᵢ⁴ + aλ/2 (tr h)⁴,   τᵢ = 4aμ cᵢ³ + 2aλ (tr h)³.
// Its coefficient is the published one, which fits a (1 − x)⁴ to (ln x)² on [0.25, 1]; the tangent at rest is zero.
// The quadratic energy of Klár et al. 2016: ψ = μ Σ hᵢ² + λ/2 (tr h)².
namespace mpm {
inline namespace TORCH_MPM_ISA {

constexpr double kQuarticCoefficient = 6.254421582537118;

// An energy, and the energy of the yield surface where it differs. The flow is radial unless exact_flow.
template <bool Quadratic, bool UnilateralStress, bool UnilateralYield>
struct SandEnergy {
  static constexpr bool quadratic = Quadratic, unilateral_stress = UnilateralStress, unilateral_yield = UnilateralYield;
  static constexpr bool exact_flow = false;
};

struct FullQuartic : SandEnergy<false, false, false> {};
struct UnilateralQuartic : SandEnergy<false, true, true> {};
struct Quadratic : SandEnergy<true, false, false> {};
// Return map to the yield surface of the full energy, stress of the unilateral one, as in the program published by Gao
// et al.
struct MixedQuartic : SandEnergy<false, true, false> {};

template <class Energy>
struct ExactFlow : Energy {
  static constexpr bool exact_flow = true;
};

template <bool Unilateral, class T>
MPM_HD T one_sided(const T& x) {
  if constexpr (Unilateral)
    return min(x, T(0));
  else
    return x;
}

template <class T>
MPM_HD T cube(const T& x) {
  return x * x * x;
}

template <class Energy, class T, int D>
MPM_HD T sand_energy(const Vector<T, D>& h, const T& mu, const T& lam) {
  const T trace = one_sided<Energy::unilateral_stress>(sum(h));
  T squares = T(0), fourth = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T c = one_sided<Energy::unilateral_stress>(h[i]);
    squares = squares + c * c;
    fourth = fourth + c * c * (c * c);
  }
  if constexpr (Energy::quadratic)
    return mu * squares + T(0.5) * lam * trace * trace;
  else
    return T(kQuarticCoefficient) * (mu * fourth + T(0.5) * lam * (trace * trace) * (trace * trace));
}

// Principal Kirchhoff stresses τ = μ m + λ l 1, as the two terms m and l.
template <class T, int D>
struct StressTerms {
  Vector<T, D> shear;
  T dilation;
};

template <class Energy, class T, int D>
MPM_HD StressTerms<T, D> stress_terms(const Vector<T, D>& h) {
  StressTerms<T, D> r;
  const T trace = one_sided<Energy::unilateral_stress>(sum(h));
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T c = one_sided<Energy::unilateral_stress>(h[i]);
    r.shear[i] = Energy::quadratic ? T(2) * c : T(4 * kQuarticCoefficient) * cube(c);
  }
  r.dilation = Energy::quadratic ? trace : T(2 * kQuarticCoefficient) * cube(trace);
  return r;
}

template <class Energy, class T, int D>
MPM_HD Vector<T, D> sand_stress(const Vector<T, D>& h, const T& mu, const T& lam) {
  const StressTerms<T, D> terms = stress_terms<Energy>(h);
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = mu * terms.shear[i] + lam * terms.dilation;
  return r;
}

// The tangent ∂τ/∂h = diag(shear) + dilation 1 1ᵀ.
template <class Energy, class T, int D>
MPM_HD StressTerms<T, D> stress_tangent(const Vector<T, D>& h, const T& mu, const T& lam) {
  StressTerms<T, D> r;
  const T trace = one_sided<Energy::unilateral_stress>(sum(h));
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T c = one_sided<Energy::unilateral_stress>(h[i]);
    r.shear[i] = Energy::quadratic ? T(2) * mu : T(12 * kQuarticCoefficient) * mu * c * c;
  }
  r.dilation = Energy::quadratic ? lam : T(6 * kQuarticCoefficient) * lam * trace * trace;
  return r;
}

// (a³ − b³)/(a − b), of the negative parts if unilateral, also where a = b.
template <bool Unilateral, class T>
MPM_HD T cube_quotient(const T& a, const T& b) {
  const T c = one_sided<Unilateral>(a), d = one_sided<Unilateral>(b);
  const T full = c * c + c * d + d * d;
  if constexpr (!Unilateral) return full;
  // (c − d)/(a − b): 1 where both are negative, 0 where neither is.
  const T difference = a - b;
  const auto same = difference == T(0);
  return full * select(same, T(1), (c - d) / select(same, T(1), difference));
}

// (τᵢ − τⱼ)/(hᵢ − hⱼ), also where the strains are equal.
template <class Energy, class T>
MPM_HD T stress_quotient(const T& a, const T& b, const T& mu) {
  if constexpr (Energy::quadratic) return T(2) * mu;
  return T(4 * kQuarticCoefficient) * mu * cube_quotient<Energy::unilateral_stress>(a, b);
}

// Upper bound of |dτ/dF : G F| + max |τᵢ| ≥ the second variation of ψ, over velocity gradients G with |G| = 1. In
// principal axes the diagonal of dτ is the tangent above; off the diagonal, with d = hᵢ − hⱼ, it is at most (τᵢ −
// τⱼ)/sinh d √cosh 2d ≤ (τᵢ − τⱼ)/d + √2 |τᵢ − τⱼ|. Strains below `floor` count as `floor`, because the quartic
// energies have no stiffness at rest.
template <class Energy, class T, int D>
MPM_HD T sand_stiffness(const Vector<T, D>& h, const T& mu, const T& lam, const T& floor) {
  const Vector<T, D> tau = sand_stress<Energy>(h, mu, lam);
  Vector<T, D> floored;
  const T trace = min(sum(h), T(-D) * floor);
  T highest = tau[0], lowest = tau[0];
  MPM_UNROLL for (int i = 0; i < D; i++) {
    highest = max(highest, tau[i]);
    lowest = min(lowest, tau[i]);
    floored[i] = T(0) - max(floor, Energy::unilateral_stress ? T(0) - h[i] : abs(h[i]));
  }
  const StressTerms<T, D> tangent = stress_tangent<Energy>(floored, mu, lam);
  T shear = tangent.shear[0];
  MPM_UNROLL for (int i = 1; i < D; i++)
    shear = max(shear, tangent.shear[i]);
  const T largest = Energy::unilateral_stress ? trace : T(0) - max(abs(sum(h)), T(D) * floor);
  const T dilation = Energy::quadratic ? T(D) * lam : T(6 * kQuarticCoefficient * D) * lam * largest * largest;
  return shear + max(max(T(0), dilation), T(1.4142135623730951) * (highest - lowest)) + max(highest, T(0) - lowest);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
