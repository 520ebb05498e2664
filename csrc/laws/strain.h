#pragma once

#include "common/dual.h"
#include "common/matrix.h"

// Strain of one particle for an isotropic law without principal values. Every quantity that vanishes at rest is stored
// as a difference from rest, so that small strains lose no digits to the 1 in F Fᵀ and J.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
struct Strain {
  Matrix<T, D> e;  // F Fᵀ − I, of laws with shear
  T J;             // det F
  T volumetric;    // J − 1
  T log_J;
  Matrix<T, D> rate;  // symmetric part of the velocity gradient C [1/s], of laws with viscosity
};

// det(I + H) − 1 from the principal invariants of H.
template <class T>
MPM_HD T determinant_minus_1(const Matrix<T, 2>& H) {
  return trace(H) + determinant(H);
}
template <class T>
MPM_HD T determinant_minus_1(const Matrix<T, 3>& H) {
  return trace(H) + (trace(cofactor(H)) + determinant(H));
}

template <class T, int D>
MPM_HD Strain<T, D> strain_of_volume(const T& J, const Matrix<T, D>& C) {
  Strain<T, D> s;
  s.e = zero_matrix<T, D>();
  s.J = J;
  s.volumetric = J - T(1);
  s.log_J = log_1p(s.J, s.volumetric);
  s.rate = symmetric_part(C);
  return s;
}

template <class T, int D>
MPM_HD Strain<T, D> strain_of_deformation(const Matrix<T, D>& F, const Matrix<T, D>& C) {
  const Matrix<T, D> H = F - identity<T, D>();
  Strain<T, D> s;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = i; j < D; j++) {
      T product = H[i][0] * H[j][0];
      MPM_UNROLL for (int k = 1; k < D; k++)
        product = product + H[i][k] * H[j][k];
      s.e[i][j] = s.e[j][i] = H[i][j] + H[j][i] + product;
    }
  s.J = determinant(F);
  s.volumetric = determinant_minus_1(H);
  s.log_J = log_1p(s.J, s.volumetric);
  s.rate = symmetric_part(C);
  return s;
}

template <class T, int D>
MPM_HD Strain<Dual<T>, D> constant(const Strain<T, D>& s) {
  const auto lift = [](const T& a) { return Dual<T>(a, T(0)); };
  Strain<Dual<T>, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) {
      r.e[i][j] = lift(s.e[i][j]);
      r.rate[i][j] = lift(s.rate[i][j]);
    }
  r.J = lift(s.J);
  r.volumetric = lift(s.volumetric);
  r.log_J = lift(s.log_J);
  return r;
}

// The strain with derivative 1 in its volume ratio.
template <class T, int D>
MPM_HD Strain<Dual<T>, D> vary_volume(const Strain<T, D>& s) {
  Strain<Dual<T>, D> r = constant(s);
  r.J.derivative = r.volumetric.derivative = T(1);
  r.log_J.derivative = T(1) / s.J;
  return r;
}

// Upper bound of the largest eigenvalue of a symmetric matrix from its mean and deviatoric norm: exact for D = 2 and
// when the other two are equal, at most 4/3 of it for positive ones (Wolkowicz and Styan 1980, theorem 2.1).
template <class T, int D>
MPM_HD T largest_eigenvalue_bound(const Matrix<T, D>& a) {
  const T mean = trace(a) * T(1.0 / D);
  const Matrix<T, D> deviator = a - mean * identity<T, D>();
  return mean + sqrt(T((D - 1.0) / D) * contract(deviator, deviator));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
