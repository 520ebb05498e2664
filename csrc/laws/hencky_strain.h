#pragma once

#include "common/svd.h"
#include "common/wide.h"

// Common parts of isotropic laws in principal strains: the Hencky strains of F, and the adjoint of an isotropic tensor
// function of F from that of its principal values. A function that many kernels share and that is too large for
// inlining to pay: on the CPU it is compiled once.
#if defined(__CUDACC__)
#define MPM_HD_LARGE MPM_HD
#else
#define MPM_HD_LARGE inline __attribute__((noinline))
#endif

namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T>
MPM_HD T min(const T& a, const T& b) {
  return select(a < b, a, b);
}

template <class T, int D>
MPM_HD T sum(const Vector<T, D>& a) {
  T r = a[0];
  MPM_UNROLL for (int i = 1; i < D; i++)
    r = r + a[i];
  return r;
}

// eˣ to rounding also where it is small.
MPM_HD float exponential(float x) { return ::expf(x); }
MPM_HD double exponential(double x) { return ::exp(x); }
template <class T>
MPM_HD T exponential(const T& x) {
  const T e = expm1(abs(x)) + T(1);
  return select(x < T(0), T(1) / e, e);
}

// sinh(x)/x and cosh(x).
template <class T>
struct Hyperbolic {
  T sinhc, cosh;
};

// Terms of their series that matter up to x² = 1/4.
template <class T>
constexpr int kHyperbolicTerms = 7;
template <>
constexpr int kHyperbolicTerms<float> = 4;
#ifndef __CUDACC__
template <int N>
constexpr int kHyperbolicTerms<Pack<float, N>> = 4;
#endif

template <class T>
MPM_HD Hyperbolic<T> hyperbolic(const T& x) {
  constexpr auto inverse_factorial = [] {
    std::array<double, 16> r = {1.0};
    for (int k = 1; k < 16; k++) r[k] = r[k - 1] / k;
    return r;
  }();
  constexpr int terms = kHyperbolicTerms<T>;
  const T square = x * x;
  Hyperbolic<T> r = {T(inverse_factorial[2 * terms + 1]), T(inverse_factorial[2 * terms])};
  MPM_UNROLL for (int k = terms - 1; k >= 0; k--) {
    r.sinhc = r.sinhc * square + T(inverse_factorial[2 * k + 1]);
    r.cosh = r.cosh * square + T(inverse_factorial[2 * k]);
  }
  const auto large = square > T(0.25);
  if (any(large)) {
    const T size = select(large, abs(x), T(1)), e = exponential(size), inverse = T(1) / e;
    r.sinhc = select(large, T(0.5) * (e - inverse) / size, r.sinhc);
    r.cosh = select(large, T(0.5) * (e + inverse), r.cosh);
  }
  return r;
}

template <class T>
MPM_HD T sinhc(const T& x) {
  return hyperbolic(x).sinhc;
}

// F = U diag(exp h) Vᵀ with B = Fᵀ U = V diag(exp h) up to a power of two: neither V nor an order of the strains is
// needed.
template <class T, int D>
struct HenckyStrain {
  Matrix<T, D> U, B;
  Vector<T, D> h, inverse;  // reciprocal lengths of the columns of B
  T scale;                  // scale of B
  MaskOf<T> valid;          // det F > 0, everything finite
};

// ln a of the square of a stretch, where a warp of a GPU should take one branch: small strains never take the other.
#ifdef __CUDACC__
MPM_HD float logarithm_of_square(float a, float a_minus_1) {
  return a_minus_1 > -0.75f ? ::log1pf(a_minus_1) : ::logf(a);
}
MPM_HD double logarithm_of_square(double a, double a_minus_1) { return logarithm<double, uint64_t>(a, a_minus_1); }
#else
template <class T>
MPM_HD T logarithm_of_square(const T& a, const T& a_minus_1) {
  return log_1p(a, a_minus_1);
}
#endif

// Only extreme entries are scaled: the logarithm of a stretch near one keeps its digits.
template <class T, int D>
MPM_HD T scale_of_strain(const Matrix<T, D>& F) {
  T largest = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) largest = max(largest, abs(F[i][j]));
  const auto moderate = (largest > T(1e-6)) & (largest < T(1e6));
  return select(moderate, T(1), inverse_power_of_two(largest));
}

// Other members of s from its U, B and scale.
template <class T, int D>
MPM_HD void measure_strain(HenckyStrain<T, D>& s) {
  T shift = T(0);
  if (any((s.scale < T(1)) | (s.scale > T(1)))) shift = logarithm_of_square(s.scale, s.scale - T(1));
  MPM_UNROLL for (int i = 0; i < D; i++) {
    T square = s.B[0][i] * s.B[0][i], minus_1 = s.B[0][i] * s.B[0][i] - T(1);
    MPM_UNROLL for (int k = 1; k < D; k++) {
      minus_1 = minus_1 + s.B[k][i] * s.B[k][i];
      square = square + s.B[k][i] * s.B[k][i];
    }
    s.h[i] = T(0.5) * logarithm_of_square(square, minus_1) - shift;
    s.inverse[i] = rsqrt(square);
  }
  // Neither is finite where an entry of B is not.
  const T volume = determinant(s.B), finite = (volume - volume) + (sum(s.h) - sum(s.h));
  s.valid = (volume > T(0)) & (finite == T(0));
}

template <class T, int D>
MPM_HD_LARGE HenckyStrain<T, D> hencky_strain(const Matrix<T, D>& F) {
  HenckyStrain<T, D> s;
  s.scale = scale_of_strain(F);
  s.B = s.scale * transpose(F);
  orthogonalize_columns(s.B, s.U);
  measure_strain(s);
  return s;
}

// One step of Newton's method towards the nearest orthogonal matrix.
template <class T, int D>
MPM_HD Matrix<T, D> orthogonalized(const Matrix<T, D>& U) {
  return U * (T(1.5) * identity<T, D>() - T(0.5) * (transpose(U) * U));
}

// Strains and axes in float64 of an F in float32: every digit of a difference of strains is that of F. The axes are
// computed in float32, and a sweep in float64 makes them exact, or two sweeps where three in float32 were too few.
template <class T, int D>
MPM_HD_LARGE HenckyStrain<Wide<T>, D> wide_hencky_strain(const Matrix<T, D>& F) {
  using W = Wide<T>;
  if constexpr (std::is_same_v<T, W> || D == 2) {
    return hencky_strain(convert<W>(F));
  } else {
    const T scale = scale_of_strain(F);
    Matrix<T, D> B = scale * transpose(F), U = identity<T, D>();
    sweep_columns(B, U, 3, 3, 0);
    HenckyStrain<W, D> s;
    s.scale = convert<W>(scale);
    s.U = orthogonalized(convert<W>(U));
    s.B = transpose(s.scale * convert<W>(F)) * s.U;
    sweep_columns(s.B, s.U, 1, JacobiSweeps<W>::most, 1e-10);
    measure_strain(s);
    return s;
  }
}

// The same in another arithmetic.
template <class To, class T, int D>
MPM_HD HenckyStrain<To, D> convert(const HenckyStrain<T, D>& s) {
  return {convert<To>(s.U),       convert<To>(s.B),     convert<To>(s.h),
          convert<To>(s.inverse), convert<To>(s.scale), convert<MaskOf<To>>(s.valid)};
}

// A diag(d) Bᵀ.
template <class T, int D>
MPM_HD Matrix<T, D> compose(const Matrix<T, D>& A, const Vector<T, D>& d, const Matrix<T, D>& B) {
  Matrix<T, D> scaled;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) scaled[i][j] = A[i][j] * d[j];
  return scaled * transpose(B);
}

// V of F = U diag(exp h) Vᵀ.
template <class T, int D>
MPM_HD Matrix<T, D> right_axes(const HenckyStrain<T, D>& s) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = s.B[i][j] * s.inverse[j];
  return r;
}

// Divided differences of principal values i and j: (Hᵢ − Hⱼ)/(hᵢ − hⱼ) of the mapped strains H, (τᵢ − τⱼ)/(Hᵢ − Hⱼ) of
// the stresses.
template <class T>
struct Quotients {
  T map, stress;
};

// Adjoint of F in principal axes, of F ↦ U diag(exp H) Vᵀ and τ = U diag(τᵢ) Uᵀ. `diagonal` is the adjoint of h; Uᵀ F̄
// V = even + odd and N = Uᵀ τ̄ U are the adjoints of the results in the same axes, as symmetric and skew part. Divided
// differences of exp H and τ by exp h are written with sinh x/x, so that they are valid at equal strains.
template <class T, int D, class F>
MPM_HD Matrix<T, D> principal_adjoint(const HenckyStrain<T, D>& s, const Vector<T, D>& H, const Vector<T, D>& diagonal,
                                      const Matrix<T, D>& even, const Matrix<T, D>& odd, const Matrix<T, D>& N,
                                      const F& quotients) {
  Vector<T, D> inverse, root;  // of the stretches; of the factors of the map
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    inverse[i] = s.scale * s.inverse[i];
    root[i] = exponential(T(0.5) * (H[i] - s.h[i]));
    r[i][i] = diagonal[i] * inverse[i];
  }
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = i + 1; j < D; j++) {
      const Quotients<T> quotient = quotients(i, j);
      const Hyperbolic<T> trial = hyperbolic(T(0.5) * (s.h[i] - s.h[j])), mapped = hyperbolic(T(0.5) * (H[i] - H[j]));
      const T by_sinhc = quotient.map * reciprocal(trial.sinhc), by_cosh = reciprocal(trial.cosh);
      const T stretch = root[i] * root[j];
      const T symmetric = stretch * mapped.sinhc * by_sinhc * even[i][j],
              skew = stretch * mapped.cosh * by_cosh * odd[i][j];
      const T stress = quotient.stress * by_sinhc * by_cosh * N[i][j];
      r[i][j] = symmetric + skew + stress * inverse[i];
      r[j][i] = symmetric - skew + stress * inverse[j];
    }
  return r;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
