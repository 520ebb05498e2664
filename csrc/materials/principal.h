#pragma once

#include "materials/arguments.h"
#include "materials/lanes.h"
#include "math/svd.h"
#include "math/wide.h"

// What isotropic laws in principal strains share: the Hencky strains of F, and the adjoint of an isotropic tensor
// function of F from that of its principal values.
// A function that many kernels share and that is too large for a call to matter: on the CPU it is compiled once.
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
  MPM_UNROLL
  for (int i = 1; i < D; i++) r = r + a[i];
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

// sinh(x)/x.
template <class T>
MPM_HD T sinhc(const T& x) {
  const T square = x * x;
  T series = T(1);
  MPM_UNROLL
  for (int k = 7; k > 0; k--) series = T(1) + series * square * T(1.0 / (2 * k * (2 * k + 1)));
  const auto small = square < T(0.25);
  const T e = exponential(abs(x));
  return select(small, series, T(0.5) * (e - T(1) / e) / select(small, T(1), abs(x)));
}

template <class T>
MPM_HD T cosh(const T& x) {
  const T e = exponential(abs(x));
  return T(0.5) * (e + T(1) / e);
}

// F = U diag(exp h) Vᵀ with B = Fᵀ U = V diag(exp h) up to a power of two: no V and no order of the strains is needed.
template <class T, int D>
struct HenckyStrain {
  Matrix<T, D> U, B;
  Vector<T, D> h, square;  // squared lengths of the columns of B
  T scale;                 // of B
  MaskOf<T> meaningful;    // det F > 0, everything finite
};

// ln a of the square of a stretch, where a warp of a GPU should take one branch: small strains are never below the other.
#ifdef __CUDACC__
MPM_HD float logarithm_of_square(float a, float a_minus_1) {
  return a_minus_1 > -0.75f ? ::log1pf(a_minus_1) : ::logf(a);
}
MPM_HD double logarithm_of_square(double a, double a_minus_1) {
  return a_minus_1 > -0.75 ? ::log1p(a_minus_1) : ::log(a);
}
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
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = 0; j < D; j++) largest = max(largest, abs(F[i][j]));
  const auto moderate = (largest > T(1e-6)) & (largest < T(1e6));
  return select(moderate, T(1), inverse_power_of_two(largest));
}

// The rest of s from its U, B and scale, of which `shift` is the logarithm.
template <class T, int D>
MPM_HD void measure_strain(HenckyStrain<T, D>& s, const T& shift) {
  T finite = poison(s.B);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    T minus_1 = s.B[0][i] * s.B[0][i] - T(1);
    s.square[i] = s.B[0][i] * s.B[0][i];
    MPM_UNROLL
    for (int k = 1; k < D; k++) {
      minus_1 = minus_1 + s.B[k][i] * s.B[k][i];
      s.square[i] = s.square[i] + s.B[k][i] * s.B[k][i];
    }
    s.h[i] = T(0.5) * logarithm_of_square(s.square[i], minus_1) - shift;
    finite = finite + (s.h[i] - s.h[i]);
  }
  s.meaningful = (determinant(s.B) > T(0)) & (finite == T(0));
}

template <class T, int D>
MPM_HD_LARGE HenckyStrain<T, D> hencky_strain(const Matrix<T, D>& F) {
  HenckyStrain<T, D> s;
  s.scale = scale_of_strain(F);
  s.B = s.scale * transpose(F);
  orthogonalize_columns(s.B, s.U);
  measure_strain(s, log_1p(s.scale, s.scale - T(1)));
  return s;
}

// One step of Newton's method towards the nearest orthogonal matrix.
template <class T, int D>
MPM_HD Matrix<T, D> orthogonalized(const Matrix<T, D>& U) {
  return U * (T(1.5) * identity<T, D>() - T(0.5) * (transpose(U) * U));
}

// Strains and axes in float64 of an F in float32: every digit of a difference of strains is that of F. The axes come
// from float32, and a sweep in float64 makes them exact, or two where three in float32 were too few.
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
    measure_strain(s, convert<W>(log_1p(scale, scale - T(1))));
    return s;
  }
}

// The same in another arithmetic.
template <class To, class T, int D>
MPM_HD HenckyStrain<To, D> convert(const HenckyStrain<T, D>& s) {
  return {convert<To>(s.U),      convert<To>(s.B),     convert<To>(s.h),
          convert<To>(s.square), convert<To>(s.scale), convert<MaskOf<To>>(s.meaningful)};
}

// A diag(d) Bᵀ.
template <class T, int D>
MPM_HD Matrix<T, D> compose(const Matrix<T, D>& A, const Vector<T, D>& d, const Matrix<T, D>& B) {
  Matrix<T, D> scaled;
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = 0; j < D; j++) scaled[i][j] = A[i][j] * d[j];
  return scaled * transpose(B);
}

// V of F = U diag(exp h) Vᵀ.
template <class T, int D>
MPM_HD Matrix<T, D> right_axes(const HenckyStrain<T, D>& s) {
  Matrix<T, D> r;
  MPM_UNROLL
  for (int j = 0; j < D; j++) {
    const T inverse = rsqrt(s.square[j]);
    MPM_UNROLL
    for (int i = 0; i < D; i++) r[i][j] = s.B[i][j] * inverse;
  }
  return r;
}

// Divided differences of principal values i and j: (Hᵢ − Hⱼ)/(hᵢ − hⱼ) of the mapped strains H, (τᵢ − τⱼ)/(Hᵢ − Hⱼ) of
// the stresses.
template <class T>
struct Quotients {
  T map, stress;
};

// Adjoint of F in principal axes, of F ↦ U diag(exp H) Vᵀ and τ = U diag(τᵢ) Uᵀ. `diagonal` is the adjoint of h;
// M = Uᵀ F̄ V and N = Uᵀ τ̄ U are the adjoints of the results in the same axes. Divided differences of exp H and τ by exp h
// are written with sinh x/x, so that they hold at equal strains.
template <class T, int D, class F>
MPM_HD Matrix<T, D> principal_adjoint(const HenckyStrain<T, D>& s, const Vector<T, D>& H, const Vector<T, D>& diagonal,
                                      const Matrix<T, D>& M, const Matrix<T, D>& N, const F& quotients) {
  Vector<T, D> inverse;  // of the stretches
  Matrix<T, D> r;
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    inverse[i] = s.scale * rsqrt(s.square[i]);
    r[i][i] = diagonal[i] * inverse[i];
  }
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = i + 1; j < D; j++) {
    const Quotients<T> quotient = quotients(i, j);
    const T trial = s.h[i] - s.h[j], mapped = H[i] - H[j];
    const T half = exponential(T(0.5) * (H[i] + H[j] - s.h[i] - s.h[j]));
    const T symmetric = half * quotient.map * sinhc(T(0.5) * mapped) / sinhc(T(0.5) * trial);
    const T skew = half * cosh(T(0.5) * mapped) / cosh(T(0.5) * trial);
    const T even = T(0.5) * symmetric * (M[i][j] + M[j][i]), odd = T(0.5) * skew * (M[i][j] - M[j][i]);
    const T stress = (N[i][j] + N[j][i]) * quotient.stress * quotient.map / (T(2) * sinhc(trial));
    r[i][j] = even + odd + stress * inverse[i];
    r[j][i] = even - odd + stress * inverse[j];
  }
  return r;
}

// A parameter of the particles `at`. A scene id out of range takes that of scene 0: such a particle is not transferred
// anyway.
template <class At, class T>
MPM_HD typename At::Value load_parameter(const At& at, const Parameter<T>& parameter, const int* scene,
                                         int64_t scene_stride) {
  if (parameter.scenes) {
    return at.each([&](int64_t p) {
      const int id = scene[p * scene_stride];
      return parameter.pointer[(id >= 0 && id < parameter.scenes ? id : 0) * parameter.stride];
    });
  }
  return at.load(parameter.pointer, parameter.stride);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
