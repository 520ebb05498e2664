#pragma once

// Sums over the lanes of a warp of several numbers each, in a fixed order.
namespace mpm::cuda {

// Sums of numbers over the lanes that differ in the bits of `Mask` and below. Each step adds the numbers of two lanes;
// one of them keeps the lower half of the sums, the other the upper half. At the end a lane stores the sums [first,
// first + count) in `values`, from values[0] on.
template <int Count, int Mask, int N>
__device__ void scatter_sums(double (&values)[N], int& first, int& count) {
  if constexpr (Mask > 0) {
    constexpr int half = (Count + 1) / 2;
    const bool upper = threadIdx.x & Mask;
#pragma unroll
    for (int i = 0; i < half; i++) {
      const double high = i + half < Count ? values[i + half < Count ? i + half : 0] : 0;
      const double sent = upper ? values[i] : high;
      values[i] = (upper ? high : values[i]) + __shfl_xor_sync(~0u, sent, Mask);
    }
    const int above = count > half ? count - half : 0;
    first += upper ? half : 0;
    count = upper ? above : count - above;
    scatter_sums<half, Mask / 2>(values, first, count);
  }
}

// Adds the numbers of all lanes with the same key, which is not negative, to those at `to(key, i)`. By all threads of a
// warp; a negative key adds nothing.
template <int N, class To>
__device__ void add_by_key(int key, const double (&values)[N], const To& to) {
  unsigned left = __ballot_sync(~0u, key >= 0);
#pragma unroll 1
  while (left) {
    const int own = __shfl_sync(~0u, key, __ffs(int(left)) - 1);
    left &= ~__ballot_sync(~0u, key == own);
    double sums[N];
#pragma unroll
    for (int i = 0; i < N; i++) sums[i] = key == own ? values[i] : 0;
    int first = 0, count = N;
    scatter_sums<N, 16>(sums, first, count);
#pragma unroll
    for (int i = 0; i < (N + 31) / 32; i++)
      if (i < count) *to(own, first + i) += sums[i];
  }
}

}  // namespace mpm::cuda
