#pragma once

#include <type_traits>

#include "common/elementary.h"
#ifndef __CUDACC__
#include "common/pack.h"
#endif

// Reciprocal square roots and exact scaling by powers of two.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// One Newton step towards 1/√x.
template <class T>
MPM_HD T refine_rsqrt(const T& x, const T& y) {
  return y + T(0.5) * y * (T(1) - x * y * y);
}

// 1/√x for x > 0 that are neither tiny nor huge, to rounding in float32 and to 11 digits or better in float64.
template <class T>
MPM_HD T rsqrt_estimate(const T& x) {
  return rsqrt(x);
}

#ifdef __CUDA_ARCH__
MPM_HD float rsqrt_estimate(float x) {
  asm("rsqrt.approx.ftz.f32 %0, %0;" : "+f"(x));
  return x;
}
MPM_HD double rsqrt_estimate(double x) {
  double y;
  asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(y) : "d"(x));
  return refine_rsqrt(x, y);
}
MPM_HD float rsqrt(float x) { return refine_rsqrt(x, ::rsqrtf(x)); }
MPM_HD double rsqrt(double x) { return refine_rsqrt(x, rsqrt_estimate(max(x, 1e-300))); }
#else
MPM_HD float rsqrt(float x) { return 1 / ::sqrtf(x); }
MPM_HD double rsqrt(double x) { return 1 / ::sqrt(x); }
#endif

// 2⁻ᵏ with 2ᵏ ≤ x < 2ᵏ⁺¹ for x ≥ 0, as far as both are normal numbers: x times it is in [1, 2) for normal x below the
// largest binade, and below 4 for all others.
MPM_HD float inverse_power_of_two(float x) {
  const int32_t exponent = 0x7f000000 - (__builtin_bit_cast(int32_t, x) & 0x7f800000);
  return __builtin_bit_cast(float, exponent > 0x00800000 ? exponent : 0x00800000);
}
MPM_HD double inverse_power_of_two(double x) {
  const int64_t exponent = 0x7fe0000000000000 - (__builtin_bit_cast(int64_t, x) & 0x7ff0000000000000);
  return __builtin_bit_cast(double, exponent > 0x0010000000000000 ? exponent : 0x0010000000000000);
}

// An estimate of ∛x, to 3 digits or better and smooth, for x > 0.
#ifdef __CUDA_ARCH__
MPM_HD float cube_root(float x) { return ::exp2f(__log2f(x) * (1.0f / 3)); }
MPM_HD double cube_root(double x) { return cube_root(float(x)); }
#else
MPM_HD float cube_root(float x) { return ::cbrtf(x); }
MPM_HD double cube_root(double x) { return ::cbrt(x); }
#endif

#ifndef __CUDACC__
// A third of the exponent (Kahan 1991), refined by one Newton step.
template <class T, int N>
MPM_HD Pack<T, N> cube_root(const Pack<T, N>& x) {
  using Integer = typename PackShape<T, N>::Integer;
  using Value = typename PackShape<T, N>::Value;
  constexpr T offset = sizeof(T) == 4 ? T(709921077) : T(3071306043645493248);
  Pack<T, N> r;
  MPM_UNROLL for (int k = 0; k < r.kParts; k++) {
    const Value bits = __builtin_convertvector(__builtin_bit_cast(Integer, x.part[k]), Value);
    r.part[k] = __builtin_bit_cast(Value, __builtin_convertvector(bits * T(1.0 / 3) + offset, Integer));
  }
  return Pack<T, N>(2.0 / 3) * r + Pack<T, N>(1.0 / 3) * x / (r * r);
}

template <class T, int N>
MPM_HD Pack<T, N> rsqrt(const Pack<T, N>& x) {
#ifdef __AVX512F__
  // An estimate of 14 bits, refined.
  if constexpr (sizeof(x.part[0]) == 64) {
    Pack<T, N> r;
    MPM_UNROLL for (int k = 0; k < r.kParts; k++) {
      if constexpr (sizeof(T) == 4)
        r.part[k] = (typename PackShape<T, N>::Value)_mm512_maskz_rsqrt14_ps(__mmask16(-1), (__m512)x.part[k]);
      else
        r.part[k] = (typename PackShape<T, N>::Value)_mm512_maskz_rsqrt14_pd(__mmask8(-1), (__m512d)x.part[k]);
    }
    r = refine_rsqrt(x, r);
    return sizeof(T) == 4 ? r : refine_rsqrt(x, r);
  }
#endif
  return Pack<T, N>(1) / sqrt(x);
}

template <class T, int N>
MPM_HD Pack<T, N> inverse_power_of_two(const Pack<T, N>& x) {
  using F = Format<T>;
  using Integer = typename PackShape<T, N>::Integer;
  using Int = std::make_signed_t<typename F::Bits>;
  constexpr Int infinity = Int(2 * F::bias + 1) << F::mantissa, two = Int(F::bias * 2) << F::mantissa,
                smallest = Int(1) << F::mantissa;
  Pack<T, N> r;
  MPM_UNROLL for (int k = 0; k < r.kParts; k++) {
    const Integer exponent = two - (__builtin_bit_cast(Integer, x.part[k]) & infinity);
    r.part[k] =
        __builtin_bit_cast(typename PackShape<T, N>::Value, exponent > smallest ? exponent : smallest - Integer{});
  }
  return r;
}
#endif

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
