#pragma once

#include <climits>

// The largest of values, NaN above all of them; negative values count as zero. Bits of the others are in the order of
// the values.
namespace mpm::cuda {

__device__ inline void raise(double* largest, long long wanted) {
  auto* const bits = reinterpret_cast<long long*>(largest);
  if (*const_cast<volatile long long*>(bits) < wanted) atomicMax(bits, wanted);
}

__device__ inline long long ordered_bits(double value) {
  return value == value ? __double_as_longlong(value) : LLONG_MAX;
}

// Called by the lanes of a warp that are active together, with the same destination.
__device__ inline void raise_by_warp(double* largest, float value) {
  const unsigned lanes = __activemask(), most = __reduce_max_sync(lanes, __float_as_uint(value <= 0 ? 0.0f : value));
  if (most > 0 && int(threadIdx.x % 32) == __ffs(lanes) - 1) raise(largest, ordered_bits(__uint_as_float(most)));
}
__device__ inline void raise_by_warp(double* largest, double value) {
  if (!(value <= 0)) raise(largest, ordered_bits(value));
}

}  // namespace mpm::cuda
