#pragma once

#include "common/matrix.h"
#include "common/roots.h"

// Singular value decomposition F = U diag(σ) Vᵀ of 2x2 and 3x3 matrices by one-sided Jacobi rotations (Hestenes 1958;
// order of the columns as de Rijk 1989). Written without branches, so that it runs in the lanes of a pack.
//
// U and V are rotations: only the smallest singular value may be negative, where det F is. |σ| descends, up to rounding
// between equal values. Any finite matrix is decomposed with an error of a few units in the last place of its largest
// entry; a NaN or an infinity makes every result NaN.
namespace mpm {
inline namespace TORCH_MPM_ISA {

MPM_HD bool any(bool mask) { return mask; }

template <class T, int D>
struct SVD {
  Matrix<T, D> U;
  Vector<T, D> sigma;
  Matrix<T, D> V;
};

// Sweeps after which the columns of nearly all matrices are orthogonal to rounding, and of all.
template <class T>
struct JacobiSweeps;
template <>
struct JacobiSweeps<float> {
  static constexpr int least = 4, most = 5;
  static constexpr double rounding = 4e-7;  // of the cosine between columns
};
template <>
struct JacobiSweeps<double> {
  static constexpr int least = 5, most = 6;
  static constexpr double rounding = 1e-15;
};
#ifndef __CUDACC__
template <class T, int N>
struct JacobiSweeps<Pack<T, N>> : JacobiSweeps<T> {};
#endif

// 2⁻ᵏ that brings the largest entry of a into [1, 2).
template <class T, int D>
MPM_HD T scale_of(const Matrix<T, D>& a) {
  T largest = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) largest = max(largest, abs(a[i][j]));
  return inverse_power_of_two(largest);
}

// Columns p and q of a become c p + s q and c q − s p.
template <class T, int D>
MPM_HD void rotate_columns(Matrix<T, D>& a, int p, int q, const T& c, const T& s) {
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T x = a[i][p], y = a[i][q];
    a[i][p] = c * x + s * y;
    a[i][q] = c * y - s * x;
  }
}

template <class T, int D>
MPM_HD void rotate_rows(Matrix<T, D>& a, int p, int q, const T& c, const T& s) {
  MPM_UNROLL for (int j = 0; j < D; j++) {
    const T x = a[p][j], y = a[q][j];
    a[p][j] = c * x + s * y;
    a[q][j] = c * y - s * x;
  }
}

// Of columns p and q with themselves and each other.
template <class T>
struct Products {
  T a, b, g;
};

template <class T, int D>
MPM_HD Products<T> products(const Matrix<T, D>& B, int p, int q) {
  Products<T> r{T(0), T(0), T(0)};
  MPM_UNROLL for (int i = 0; i < D; i++) {
    r.a = r.a + B[i][p] * B[i][p];
    r.b = r.b + B[i][q] * B[i][q];
    r.g = r.g + B[i][p] * B[i][q];
  }
  return r;
}

// Makes columns p and q of B orthogonal with the longer one first, and turns those of V with them. With norms a, b and
// product g, tan 2θ = 2g/(a − b); the half angle needs two reciprocal square roots and no division.
template <class T, int D>
MPM_HD void orthogonalize(Matrix<T, D>& B, Matrix<T, D>& V, int p, int q) {
  const auto [a, b, g] = products(B, p, q);
  const T difference = a - b, twice = g + g;
  const T scale = inverse_power_of_two(max(abs(difference), abs(twice)));
  const T cosine = abs(scale * difference) + T(1e-18), sine = scale * twice;  // of 2θ, times their common norm
  const T inverse_norm = rsqrt_estimate(cosine * cosine + sine * sine);
  const T square = T(0.5) + T(0.5) * cosine * inverse_norm, inverse = rsqrt_estimate(square);
  const T large = square * inverse, small = T(0.5) * sine * inverse_norm * inverse;
  const auto exchange = difference < T(0);
  // The remainder of 1 − c² − s² would accumulate over the rotations.
  const T excess = T(0.5) * (T(1) - large * large - small * small);
  const T cosine_half = large + excess * large, sine_half = small + excess * small;
  const T c = select(exchange, sine_half, cosine_half), s = select(exchange, cosine_half, sine_half);
  rotate_columns(B, p, q, c, s);
  rotate_columns(V, p, q, c, s);
}

template <class T, int D>
MPM_HD decltype(T(0) > T(0)) is_oblique(const Matrix<T, D>& B, double cosine) {
  const T tolerance = T(cosine * cosine);
  T excess = T(-1);
  MPM_UNROLL for (int p = 0; p < D - 1; p++) MPM_UNROLL
    for (int q = p + 1; q < D; q++) {
      const Products<T> m = products(B, p, q);
      excess = max(excess, m.g * m.g - tolerance * m.a * m.b);
    }
  return excess > T(0);
}

// Sweeps over the columns of B, and the same rotations of V, until their cosines are small.
template <class T, int D>
MPM_HD void sweep_columns(Matrix<T, D>& B, Matrix<T, D>& V, int least, int most, double cosine) {
#ifdef __CUDACC__
#pragma unroll 1
#endif
  for (int sweep = 0; sweep < most; sweep++) {
    if (sweep >= least && !any(is_oblique(B, cosine))) break;
    MPM_UNROLL for (int p = 0; p < D - 1; p++) MPM_UNROLL
      for (int q = p + 1; q < D; q++) orthogonalize(B, V, p, q);
  }
}

// B, V with B = B V and orthogonal columns of B in descending length; V starts as the identity.
template <class T, int D>
MPM_HD void orthogonalize_columns(Matrix<T, D>& B, Matrix<T, D>& V) {
  V = identity<T, D>();
  using Sweeps = JacobiSweeps<T>;
  if constexpr (D == 2)
    sweep_columns(B, V, 2, 2, 0);
  else
    sweep_columns(B, V, Sweeps::least, Sweeps::most, Sweeps::rounding);
}

// Rotates rows p and q of B so that B[q][p] vanishes and B[p][p] ≥ 0, and columns of U so that U B stays the same.
template <class T, int D>
MPM_HD void eliminate(Matrix<T, D>& B, Matrix<T, D>& U, int p, int q) {
  const T scale = inverse_power_of_two(max(abs(B[p][p]), abs(B[q][p])));
  const T x = scale * B[p][p], y = scale * B[q][p], square = x * x + y * y;
  const auto any = square > T(0);
  const T inverse = rsqrt(select(any, square, T(1)));
  const T c = select(any, x * inverse, T(1)), s = y * inverse;
  rotate_rows(B, p, q, c, s);
  rotate_columns(U, p, q, c, s);
}

// 0, or NaN where an entry is not finite.
template <class T, int D>
MPM_HD T poison(const Matrix<T, D>& a) {
  T r = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r = r + (a[i][j] - a[i][j]);
  return r;
}

template <class T, int D>
MPM_HD SVD<T, D> svd(const Matrix<T, D>& F) {
  const T scale = scale_of(F), nan = poison(F);
  SVD<T, D> r;
  Matrix<T, D> B = scale * F;
  orthogonalize_columns(B, r.V);
  // B = U diag(σ) up to rounding. Elimination keeps U a rotation also where columns are tiny or zero.
  r.U = identity<T, D>();
  MPM_UNROLL for (int p = 0; p < D - 1; p++) MPM_UNROLL
    for (int q = p + 1; q < D; q++) eliminate(B, r.U, p, q);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    r.sigma[i] = B[i][i] / scale + nan;
    MPM_UNROLL for (int j = 0; j < D; j++) {
      r.U[i][j] = r.U[i][j] + nan;
      r.V[i][j] = r.V[i][j] + nan;
    }
  }
  return r;
}

// F = R S with a rotation R and a symmetric S, whose smallest eigenvalue is negative where det F is.
template <class T, int D>
struct Polar {
  Matrix<T, D> R, S;
};

template <class T, int D>
MPM_HD Polar<T, D> polar(const Matrix<T, D>& F) {
  const SVD<T, D> f = svd(F);
  Matrix<T, D> scaled;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) scaled[i][j] = f.V[i][j] * f.sigma[j];
  return {f.U * transpose(f.V), scaled * transpose(f.V)};
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
