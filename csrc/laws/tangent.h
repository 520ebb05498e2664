#pragma once

#include "common/lanes.h"
#include "laws/hencky_strain.h"

// Second derivative of the energy ψ of an isotropic solid, as a linear map of velocity gradients L: for a trial
// deformation F = U diag(σ) Vᵀ that changes by dF = L F₀,
//   L ↦ dP F₀ᵀ = U (∂P̂/∂F̂ : M) Bᵀ,   M = Uᵀ L B,   B = F₀ V.
// In these axes ∂P̂/∂F̂ is a symmetric block between the diagonal entries of M, and on each pair Mᵢⱼ, Mⱼᵢ one number
// for their sum and one for their difference (Teran et al. 2005; Ogden 1997, section 6.1.4).
namespace mpm {

template <int D>
constexpr int kShears = D * (D - 1) / 2;
template <int D>
constexpr int kSymmetric = D * (D + 1) / 2;
// Entries of a particle: U, B, the upper triangle of the diagonal block, `even`, `odd`.
template <int D>
constexpr int kTangentEntries = 2 * D * D + kSymmetric<D> + 2 * kShears<D>;

inline namespace TORCH_MPM_ISA {

template <class T, int D>
struct Tangent {
  Matrix<T, D> U, B;
  Matrix<T, D> diagonal;                // symmetric
  T even[kShears<D>], odd[kShears<D>];  // pairs (0, 1), (0, 2), (1, 2)
};

// visit(k, a reference to entry k).
template <class T, int D, class F>
MPM_HD void for_entries(Tangent<T, D>& t, const F& visit) {
  int n = 0;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) visit(n++, t.U[i][j]);
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) visit(n++, t.B[i][j]);
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = i; j < D; j++) visit(n++, t.diagonal[i][j]);
  MPM_UNROLL for (int k = 0; k < kShears<D>; k++)
    visit(n++, t.even[k]);
  MPM_UNROLL for (int k = 0; k < kShears<D>; k++)
    visit(n++, t.odd[k]);
}

template <class T, int D>
MPM_HD void mirror_diagonal(Tangent<T, D>& t) {
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < i; j++) t.diagonal[i][j] = t.diagonal[j][i];
}

// dP F₀ᵀ along L.
template <class T, int D>
MPM_HD Matrix<T, D> apply_tangent(const Tangent<T, D>& t, const Matrix<T, D>& L) {
  const Matrix<T, D> M = transpose(t.U) * L * t.B;
  Matrix<T, D> r;
  int k = 0;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    r[i][i] = t.diagonal[i][0] * M[0][0];
    MPM_UNROLL for (int j = 1; j < D; j++)
      r[i][i] = r[i][i] + t.diagonal[i][j] * M[j][j];
    MPM_UNROLL for (int j = i + 1; j < D; j++, k++) {
      const T even = t.even[k] * (T(0.5) * (M[i][j] + M[j][i])), odd = t.odd[k] * (T(0.5) * (M[i][j] - M[j][i]));
      r[i][j] = even + odd;
      r[j][i] = even - odd;
    }
  }
  return t.U * r * transpose(t.B);
}

// The block of a node with L = v aᵀ: the symmetric H with v · H v = L : dP F₀ᵀ.
template <class T, int D>
MPM_HD Matrix<T, D> node_block(const Tangent<T, D>& t, const Vector<T, D>& a) {
  const Vector<T, D> b = transpose(t.B) * a;
  Matrix<T, D> h;
  MPM_UNROLL for (int i = 0; i < D; i++)
    h[i][i] = t.diagonal[i][i] * b[i] * b[i];
  int k = 0;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = i + 1; j < D; j++, k++) {
      const T own = T(0.5) * (t.even[k] + t.odd[k]), mixed = T(0.5) * (t.even[k] - t.odd[k]);
      h[i][i] = h[i][i] + own * b[j] * b[j];
      h[j][j] = h[j][j] + own * b[i] * b[i];
      h[i][j] = h[j][i] = (t.diagonal[i][j] + mixed) * b[i] * b[j];
    }
  return t.U * h * transpose(t.U);
}

// (Pᵢ − Pⱼ)/(σᵢ − σⱼ) and (Pᵢ + Pⱼ)/(σᵢ + σⱼ), both times σᵢσⱼ, of Pᵢ = τᵢ/σᵢ: with half the difference of the strains,
// the mean of the stresses and their quotient (τᵢ − τⱼ)/(hᵢ − hⱼ), so that equal stretches need no special case.
template <class T>
struct ShearModuli {
  T even, odd;
};

template <class T>
MPM_HD ShearModuli<T> shear_moduli(const T& half, const T& mean, const T& quotient) {
  const Hyperbolic<T> of = hyperbolic(half);
  return {quotient * of.cosh / of.sinhc - mean, mean - quotient * half * half * of.sinhc / of.cosh};
}

// Symmetric matrix without its negative eigenvalues. Shifted by its norm it has only positive ones, which are its
// singular values.
template <class T, int D>
MPM_HD Matrix<T, D> positive_part(const Matrix<T, D>& a) {
  const T scale = scale_of(a);
  Matrix<T, D> B = scale * a, V;
  const T shift = sqrt(contract(B, B));
  MPM_UNROLL for (int i = 0; i < D; i++)
    B[i][i] = B[i][i] + shift;
  orthogonalize_columns(B, V);
  Vector<T, D> eigenvalue;
  MPM_UNROLL for (int k = 0; k < D; k++) {
    T square = T(0);
    MPM_UNROLL for (int i = 0; i < D; i++)
      square = square + B[i][k] * V[i][k];
    eigenvalue[k] = max(square - shift, T(0)) / scale;
  }
  return compose(V, eigenvalue, V);
}

template <class T, int D>
MPM_HD void project(Tangent<T, D>& t) {
  t.diagonal = positive_part(t.diagonal);
  MPM_UNROLL for (int k = 0; k < kShears<D>; k++) {
    t.even[k] = max(t.even[k], T(0));
    t.odd[k] = max(t.odd[k], T(0));
  }
}

// From the derivatives ∂τᵢ/∂hⱼ of the principal stresses, and quotient(i, j) = (τᵢ − τⱼ)/(hᵢ − hⱼ), times a weight.
template <class T, int D, class Quotient>
MPM_HD Tangent<T, D> principal_tangent(const HenckyStrain<T, D>& s, const Vector<T, D>& tau, const Matrix<T, D>& moduli,
                                       const Matrix<T, D>& before, const T& weight, const Quotient& quotient) {
  Tangent<T, D> t;
  t.U = s.U;
  t.B = before * right_axes(s);
  Vector<T, D> inverse;  // of the stretches
  MPM_UNROLL for (int i = 0; i < D; i++)
    inverse[i] = s.scale * s.inverse[i];
  int k = 0;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    t.diagonal[i][i] = weight * (moduli[i][i] - tau[i]) * inverse[i] * inverse[i];
    MPM_UNROLL for (int j = i + 1; j < D; j++, k++) {
      const T factor = weight * inverse[i] * inverse[j];
      t.diagonal[i][j] = t.diagonal[j][i] = factor * T(0.5) * (moduli[i][j] + moduli[j][i]);
      const ShearModuli<T> shear =
          shear_moduli(T(0.5) * (s.h[i] - s.h[j]), T(0.5) * (tau[i] + tau[j]), T(quotient(i, j)));
      t.even[k] = factor * shear.even;
      t.odd[k] = factor * shear.odd;
    }
  }
  return t;
}

template <class At, class T, int D>
MPM_HD Tangent<typename At::Value, D> load_tangent(const At& at, const Field<const T>& f) {
  Tangent<typename At::Value, D> t;
  for_entries(t, [&](int k, auto& entry) { entry = at.load(f.pointer + k * f.stride[1], f.stride[0]); });
  mirror_diagonal(t);
  return t;
}

// Zero where it is not valid or not finite.
template <class At, class T, class Mask, int D>
MPM_HD void store_tangent(const At& at, const Field<T>& f, const Mask& valid, Tangent<typename At::Value, D> t) {
  using V = typename At::Value;
  V poison = V(0);
  for_entries(t, [&](int, auto& entry) { poison = poison + (entry - entry); });
  const auto keep = valid & (poison == V(0));
  for_entries(
      t, [&](int k, auto& entry) { at.store(f.pointer + k * f.stride[1], f.stride[0], select(keep, entry, V(0))); });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
