#pragma once

#include <cstdint>
#ifdef __AVX2__
#include <immintrin.h>
#endif

#include "common/elementary.h"

// Pack<T, N>: N values of T in one computation, on GCC and Clang vector extensions. A formula written for a scalar T
// computes N particles when called with a pack. For the CPU only.
namespace mpm {
inline namespace TORCH_MPM_ISA {

#if defined(__AVX512F__)
constexpr int kRegisterBytes = 64;
#elif defined(__AVX__)
constexpr int kRegisterBytes = 32;
#else
constexpr int kRegisterBytes = 16;
#endif

// Register of values, and the integers of the same width that comparisons return.
template <class T, int Width>
struct RegisterOf;
template <int Width>
struct RegisterOf<float, Width> {
  typedef float Value __attribute__((vector_size(Width * 4)));
  typedef int32_t Integer __attribute__((vector_size(Width * 4)));
  typedef uint32_t Bits __attribute__((vector_size(Width * 4)));
};
template <int Width>
struct RegisterOf<double, Width> {
  typedef double Value __attribute__((vector_size(Width * 8)));
  typedef int64_t Integer __attribute__((vector_size(Width * 8)));
  typedef uint64_t Bits __attribute__((vector_size(Width * 8)));
};

template <class T, int N>
struct PackShape {
  static constexpr int kWidth = N * int(sizeof(T)) < kRegisterBytes ? N : kRegisterBytes / int(sizeof(T));
  static constexpr int kParts = N / kWidth;
  using Value = typename RegisterOf<T, kWidth>::Value;
  using Integer = typename RegisterOf<T, kWidth>::Integer;
  using Bits = typename RegisterOf<T, kWidth>::Bits;
};

template <class T, int N>
struct Mask {
  typename PackShape<T, N>::Integer part[PackShape<T, N>::kParts];  // -1 where true, 0 where false
  MPM_HD bool operator[](int i) const { return part[i / PackShape<T, N>::kWidth][i % PackShape<T, N>::kWidth] != 0; }
};

template <class T, int N>
struct Pack {
  static constexpr int kWidth = PackShape<T, N>::kWidth, kParts = PackShape<T, N>::kParts;
  typename PackShape<T, N>::Value part[kParts];

  Pack() = default;
  // The same value in every lane.
  MPM_HD explicit Pack(double x) {
    MPM_UNROLL for (int k = 0; k < kParts; k++)
      part[k] = T(x) - typename PackShape<T, N>::Value{};
  }

  MPM_HD T operator[](int i) const { return part[i / kWidth][i % kWidth]; }
  MPM_HD void set(int i, T x) { part[i / kWidth][i % kWidth] = x; }

  MPM_HD static Pack load(const T* from) {
    Pack r;
    MPM_UNROLL for (int k = 0; k < kParts; k++)  // copied together, several registers would pass through the stack
      __builtin_memcpy(&r.part[k], from + k * kWidth, sizeof(r.part[k]));
    return r;
  }
  MPM_HD void store(T* to) const {
    MPM_UNROLL for (int k = 0; k < kParts; k++)
      __builtin_memcpy(to + k * kWidth, &part[k], sizeof(part[k]));
  }

#ifdef __AVX512VL__
  // Lanes of a bit mask from `from` on, the others of this pack; only the former are read. For N = 8, and 16 in float.
  MPM_HD Pack with(const T* from, unsigned lanes) const {
    Pack r;
    if constexpr (N == 16)
      r.part[0] = _mm512_mask_loadu_ps(part[0], __mmask16(lanes), from);
    else if constexpr (sizeof(T) == 4)
      r.part[0] = _mm256_mask_loadu_ps(part[0], __mmask8(lanes), from);
    else
      r.part[0] = _mm512_mask_loadu_pd(part[0], __mmask8(lanes), from);
    return r;
  }
  // Writes the lanes of a bit mask. For N = 8, and 16 in float.
  MPM_HD void store(T* to, unsigned lanes) const {
    if constexpr (N == 16)
      _mm512_mask_storeu_ps(to, __mmask16(lanes), part[0]);
    else if constexpr (sizeof(T) == 4)
      _mm256_mask_storeu_ps(to, __mmask8(lanes), part[0]);
    else
      _mm512_mask_storeu_pd(to, __mmask8(lanes), part[0]);
  }
#endif

  // from[index[i]] in lane i.
  MPM_HD static Pack gather(const T* from, const int* index) {
#ifdef __AVX2__
    if constexpr (N == 8 && sizeof(T) == 4) {
      const __m256i at = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(index));
      const __m256 all = _mm256_castsi256_ps(_mm256_set1_epi32(-1));  // the masked form needs no undefined source
      const __m256 r = _mm256_mask_i32gather_ps(_mm256_setzero_ps(), from, at, all, 4);
      return load(reinterpret_cast<const T*>(&r));
    }
#endif
    T r[N];
    MPM_UNROLL for (int i = 0; i < N; i++)
      r[i] = from[index[i]];
    return load(r);
  }
};

#define MPM_PACK_OPERATOR(op)                                                \
  template <class T, int N>                                                  \
  MPM_HD Pack<T, N> operator op(const Pack<T, N>& a, const Pack<T, N>& b) {  \
    Pack<T, N> r;                                                            \
    MPM_UNROLL for (int k = 0; k < r.kParts; k++)                            \
      r.part[k] = a.part[k] op b.part[k];                                    \
    return r;                                                                \
  }                                                                          \
  template <class T, int N>                                                  \
  MPM_HD Pack<T, N>& operator op## = (Pack<T, N> & a, const Pack<T, N>& b) { \
    return a = a op b;                                                       \
  }
MPM_PACK_OPERATOR(+)
MPM_PACK_OPERATOR(-)
MPM_PACK_OPERATOR(*)
MPM_PACK_OPERATOR(/)
#undef MPM_PACK_OPERATOR

#define MPM_PACK_COMPARISON(op)                                             \
  template <class T, int N>                                                 \
  MPM_HD Mask<T, N> operator op(const Pack<T, N>& a, const Pack<T, N>& b) { \
    Mask<T, N> r;                                                           \
    MPM_UNROLL for (int k = 0; k < a.kParts; k++)                           \
      r.part[k] = a.part[k] op b.part[k];                                   \
    return r;                                                               \
  }
MPM_PACK_COMPARISON(<)
MPM_PACK_COMPARISON(>)
MPM_PACK_COMPARISON(<=)
MPM_PACK_COMPARISON(>=)
MPM_PACK_COMPARISON(==)
#undef MPM_PACK_COMPARISON

#define MPM_MASK_OPERATOR(op)                                               \
  template <class T, int N>                                                 \
  MPM_HD Mask<T, N> operator op(const Mask<T, N>& a, const Mask<T, N>& b) { \
    Mask<T, N> r;                                                           \
    MPM_UNROLL for (int k = 0; k < PackShape<T, N>::kParts; k++)            \
      r.part[k] = a.part[k] op b.part[k];                                   \
    return r;                                                               \
  }
MPM_MASK_OPERATOR(&)
MPM_MASK_OPERATOR(|)
#undef MPM_MASK_OPERATOR

template <class T, int N>
MPM_HD Pack<T, N> operator-(const Pack<T, N>& a) {
  Pack<T, N> r;
  MPM_UNROLL for (int k = 0; k < r.kParts; k++)
    r.part[k] = -a.part[k];
  return r;
}

// a where the mask is true, b elsewhere.
template <class T, int N>
MPM_HD Pack<T, N> select(const Mask<T, N>& mask, const Pack<T, N>& a, const Pack<T, N>& b) {
  Pack<T, N> r;
  MPM_UNROLL for (int k = 0; k < r.kParts; k++)
    r.part[k] = mask.part[k] ? a.part[k] : b.part[k];
  return r;
}

template <class T, int N>
MPM_HD bool any(const Mask<T, N>& mask) {
  bool r = false;
  MPM_UNROLL for (int i = 0; i < N; i++)
    r |= mask[i];
  return r;
}

template <class T, int N>
MPM_HD bool all(const Mask<T, N>& mask) {
  bool r = true;
  MPM_UNROLL for (int i = 0; i < N; i++)
    r &= mask[i];
  return r;
}

// f of each lane; the compiler turns the loop into vector code where f is an instruction.
template <class T, int N, class F>
MPM_HD Pack<T, N> map(const Pack<T, N>& a, const F& f) {
  T lanes[N];
  a.store(lanes);
  for (int i = 0; i < N; i++) lanes[i] = f(lanes[i]);
  return Pack<T, N>::load(lanes);
}

#ifdef __FMA__
// The instruction by name: whether the compiler contracts a * b + c depends on the context.
MPM_HD __m128 fused(__m128 a, __m128 b, __m128 c) { return _mm_fmadd_ps(a, b, c); }
MPM_HD __m128d fused(__m128d a, __m128d b, __m128d c) { return _mm_fmadd_pd(a, b, c); }
MPM_HD __m256 fused(__m256 a, __m256 b, __m256 c) { return _mm256_fmadd_ps(a, b, c); }
MPM_HD __m256d fused(__m256d a, __m256d b, __m256d c) { return _mm256_fmadd_pd(a, b, c); }
#ifdef __AVX512F__
MPM_HD __m512 fused(__m512 a, __m512 b, __m512 c) { return _mm512_fmadd_ps(a, b, c); }
MPM_HD __m512d fused(__m512d a, __m512d b, __m512d c) { return _mm512_fmadd_pd(a, b, c); }
#endif
#endif

// a b + c rounded once.
template <class T, int N>
MPM_HD Pack<T, N> fma(const Pack<T, N>& a, const Pack<T, N>& b, const Pack<T, N>& c) {
#ifdef __FMA__
  Pack<T, N> r;
  MPM_UNROLL for (int k = 0; k < r.kParts; k++)
    r.part[k] = fused(a.part[k], b.part[k], c.part[k]);
  return r;
#else
  T x[N], y[N], z[N];
  a.store(x);
  b.store(y);
  c.store(z);
  for (int i = 0; i < N; i++)
    z[i] = sizeof(T) == 4 ? T(__builtin_fmaf(x[i], y[i], z[i])) : T(__builtin_fma(x[i], y[i], z[i]));
  return Pack<T, N>::load(z);
#endif
}

template <class T, int N>
MPM_HD Pack<T, N> sin(const Pack<T, N>& a) {
  return map(a, [](T x) { return mpm::sin(x); });
}
template <class T, int N>
MPM_HD Pack<T, N> cos(const Pack<T, N>& a) {
  return map(a, [](T x) { return mpm::cos(x); });
}

template <class T, int N>
MPM_HD Pack<T, N> floor(const Pack<T, N>& a) {
  return map(a, [](T x) { return sizeof(T) == 4 ? T(__builtin_floorf(x)) : T(__builtin_floor(x)); });
}

template <class T, int N>
MPM_HD Pack<T, N> sqrt(const Pack<T, N>& a) {
  return map(a, [](T x) { return mpm::sqrt(x); });
}

template <class T, int N>
MPM_HD Pack<T, N> abs(const Pack<T, N>& a) {
  return select(a < Pack<T, N>(0), -a, a);
}

#ifdef __AVX2__
// The instructions by name, which choose b where the order is undefined, too.
#define MPM_LARGER(Register, prefix, suffix) \
  MPM_HD Register larger(Register a, Register b) { return prefix##_max_##suffix(a, b); }
MPM_LARGER(__m128, _mm, ps)
MPM_LARGER(__m128d, _mm, pd)
MPM_LARGER(__m256, _mm256, ps)
MPM_LARGER(__m256d, _mm256, pd)
#ifdef __AVX512F__
// The masked form needs no undefined source.
MPM_HD __m512 larger(__m512 a, __m512 b) { return _mm512_maskz_max_ps(__mmask16(-1), a, b); }
MPM_HD __m512d larger(__m512d a, __m512d b) { return _mm512_maskz_max_pd(__mmask8(-1), a, b); }
#endif
#undef MPM_LARGER
#endif

// a where a > b, else b.
template <class T, int N>
MPM_HD Pack<T, N> max(const Pack<T, N>& a, const Pack<T, N>& b) {
#ifdef __AVX2__
  Pack<T, N> r;
  MPM_UNROLL for (int k = 0; k < r.kParts; k++)
    r.part[k] = larger(a.part[k], b.part[k]);
  return r;
#else
  return select(a > b, a, b);
#endif
}

template <class T, int N>
MPM_HD Pack<T, N> log_1p(const Pack<T, N>& a, const Pack<T, N>& a_minus_1) {
  Pack<T, N> r;
  MPM_UNROLL for (int k = 0; k < r.kParts; k++)
    r.part[k] = logarithm<T, typename PackShape<T, N>::Bits>(a.part[k], a_minus_1.part[k]);
  return r;
}

// eˣ − 1 with x = k ln 2 + r: the Taylor series of r, scaled.
template <class T, int N>
MPM_HD Pack<T, N> expm1(const Pack<T, N>& x) {
  using F = Format<T>;
  using Value = typename PackShape<T, N>::Value;
  using Bits = typename PackShape<T, N>::Bits;
  Pack<T, N> result;
  MPM_UNROLL for (int part = 0; part < x.kParts; part++) {
    Value a = x.part[part];
    const auto overflow = a > F::expm1_high;
    a = a < F::expm1_low ? F::expm1_low - Value{} : overflow ? F::expm1_high - Value{} : a;
    const Value shifted = a * T(1.4426950408889634) + F::shifter, k = shifted - F::shifter;
    const Value r = a - k * F::ln2_high - k * F::ln2_low;
    Value series = 1 + r * T(1.0 / F::expm1_terms);
    MPM_UNROLL for (int i = F::expm1_terms - 1; i > 1; i--)
      series = 1 + r * T(1.0 / i) * series;
    const Bits exponent = (__builtin_bit_cast(Bits, shifted) + F::bias) << F::mantissa;
    const Value scale = __builtin_bit_cast(Value, exponent);
    result.part[part] = overflow ? T(__builtin_inf()) - Value{} : scale * (r * series) + (scale - 1);
  }
  return result;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
