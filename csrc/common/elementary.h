#pragma once

#include <array>
#include <cmath>
#include <cstdint>

#include "common/host_device.h"

// Elementary functions under one name for every scalar type: here for float and double, in common/dual.h and
// common/pack.h for dual numbers and packs.
namespace mpm {
inline namespace TORCH_MPM_ISA {

MPM_HD float expm1(float x) { return ::expm1f(x); }
MPM_HD double expm1(double x) { return ::expm1(x); }
MPM_HD float sqrt(float x) { return ::sqrtf(x); }
MPM_HD double sqrt(double x) { return ::sqrt(x); }
MPM_HD float abs(float x) { return ::fabsf(x); }
MPM_HD double abs(double x) { return ::fabs(x); }
MPM_HD float max(float a, float b) { return a > b ? a : b; }
MPM_HD double max(double a, double b) { return a > b ? a : b; }
MPM_HD float select(bool condition, float a, float b) { return condition ? a : b; }
MPM_HD double select(bool condition, double a, double b) { return condition ? a : b; }
MPM_HD float value_of(float x) { return x; }
MPM_HD double value_of(double x) { return x; }

// A GPU computes sines of half turns: the reduction of large angles in radians needs local memory and registers, even
// where no angle is large. The two roundings of x / π add an error of at most an ulp of x.
#ifdef __CUDA_ARCH__
MPM_HD float sin(float x) { return ::sinpif(float(M_1_PI) * x); }
MPM_HD double sin(double x) { return ::sinpi(M_1_PI * x); }
MPM_HD float cos(float x) { return ::cospif(float(M_1_PI) * x); }
MPM_HD double cos(double x) { return ::cospi(M_1_PI * x); }
#else
MPM_HD float sin(float x) { return ::sinf(x); }
MPM_HD double sin(double x) { return ::sin(x); }
MPM_HD float cos(float x) { return ::cosf(x); }
MPM_HD double cos(double x) { return ::cos(x); }
#endif

// ln a of a = 1 + a_minus_1; both are given because each is inaccurate where the other is accurate.
MPM_HD float log_1p(float a, float a_minus_1) { return ::fabsf(a_minus_1) < 0.5f ? ::log1pf(a_minus_1) : ::logf(a); }
MPM_HD double log_1p(double a, double a_minus_1) { return ::fabs(a_minus_1) < 0.5 ? ::log1p(a_minus_1) : ::log(a); }

// 1/x and a/x of normal numbers, on a GPU without the branch of a division for other numbers.
template <class T>
MPM_HD T reciprocal(const T& x) {
  return T(1) / x;
}
#ifdef __CUDA_ARCH__
MPM_HD float reciprocal(float x) {
  float r;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
  return r + r * (1 - x * r);
}
MPM_HD double reciprocal(double x) {
  double r;
  asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(x));
  const double error = 1 - x * r;
  return r + r * (error + error * error);
}
template <class T>
MPM_HD T quotient(const T& a, const T& x) {
  return a * reciprocal(x);
}
#else
template <class T>
MPM_HD T quotient(const T& a, const T& x) {
  return a / x;
}
#endif

// Bits of IEEE numbers, for functions that process the exponent separately.
template <class T>
struct Format;
template <>
struct Format<float> {
  using Bits = uint32_t;
  static constexpr int mantissa = 23, bias = 127;
  static constexpr Bits sqrt_half = 0x3f3504f3, mantissa_mask = 0x7fffff;
  static constexpr float shifter = 12582912.0f;  // 1.5 2^23: adding it rounds to an integer in the low bits
  static constexpr float ln2_high = 6.9313812256e-01f, ln2_low = 9.0580006145e-06f;
  static constexpr float expm1_low = -87.0f, expm1_high = 88.0f;
  static constexpr int expm1_terms = 8;
  static constexpr std::array<float, 4> log_terms = {0.66666662693f, 0.40000972152f, 0.28498786688f, 0.24279078841f};
};
template <>
struct Format<double> {
  using Bits = uint64_t;
  static constexpr int mantissa = 52, bias = 1023;
  static constexpr Bits sqrt_half = 0x3fe6a09e667f3bcd, mantissa_mask = 0xfffffffffffff;
  static constexpr double shifter = 6755399441055744.0;  // 1.5 2^52
  static constexpr double ln2_high = 6.93147180369123816490e-01, ln2_low = 1.90821492927058770002e-10;
  static constexpr double expm1_low = -708.0, expm1_high = 709.0;
  static constexpr int expm1_terms = 15;
  static constexpr std::array<double, 7> log_terms = {
      6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01,
      1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01};
};

// ln a: a = 2^k m with m in [√½, √2), and the series in ((m − 1)/(m + 1))² of fdlibm's log (Sun Microsystems, 1993),
// with m − 1 taken from a_minus_1 where k = 0. Value is T or a vector of it, Bits the integers of the same width.
template <class T, class Bits, class Value>
MPM_HD Value logarithm(const Value& a, const Value& a_minus_1) {
  using F = Format<T>;
  constexpr typename F::Bits one = typename F::Bits(F::bias) << F::mantissa;
  const Bits bits = __builtin_bit_cast(Bits, a) + (one - F::sqrt_half);
  const Value m = __builtin_bit_cast(Value, (bits & F::mantissa_mask) + F::sqrt_half);
  const Bits shifted = (bits >> F::mantissa) + (__builtin_bit_cast(typename F::Bits, F::shifter) - F::bias);
  const Value k = __builtin_bit_cast(Value, shifted) - F::shifter;
  const Value f = k == 0 ? a_minus_1 : m - 1;
  const Value s = quotient<Value>(f, 2 + f), z = s * s, half_square = T(0.5) * f * f;
  constexpr auto terms = F::log_terms;  // not found in memory by the device
  Value series = terms.back() - Value{};
  MPM_UNROLL for (int i = int(terms.size()) - 2; i >= 0; i--)
    series = terms[i] + z * series;
  return s * (half_square + z * series) + k * F::ln2_low - half_square + f + k * F::ln2_high;
}

// (eˣ − 1)/x, also at x = 0.
template <class T>
MPM_HD T expm1_quotient(const T& x) {
  const auto small = abs(x) < T(0.5);
  T series = T(1);
  for (int k = 15; k > 1; k--) series = T(1) + series * x * T(1.0 / k);
  const T safe = select(small, T(1), x);
  return select(small, series, expm1(safe) / safe);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
