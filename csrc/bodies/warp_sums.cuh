#pragma once

// Sums over the lanes of a warp of several numbers each, in a fixed order.
namespace mpm::cuda {

// Sums of numbers over the lanes that differ in the bits of `Mask` and below. Each step adds the numbers of two lanes;
// one of them keeps the lower half of the sums, the other the upper half. At the end a lane stores the sums [first,
// first + count) in `values`, from values[0] on.
template <int Count, int Mask, class S, int N>
__device__ void scatter_sums(S (&values)[N], int& first, int& count) {
  if constexpr (Mask > 0) {
    constexpr int half = (Count + 1) / 2;
    const bool upper = threadIdx.x & Mask;
#pragma unroll
    for (int i = 0; i < half; i++) {
      const S high = i + half < Count ? values[i + half < Count ? i + half : 0] : S(0);
      const S sent = upper ? values[i] : high;
      values[i] = (upper ? high : values[i]) + __shfl_xor_sync(~0u, sent, Mask);
    }
    const int above = count > half ? count - half : 0;
    first += upper ? half : 0;
    count = upper ? above : count - above;
    scatter_sums<half, Mask / 2>(values, first, count);
  }
}

// Sums by a key, which mostly is that of the call before: a lane has sums of its own, which are added over the lanes
// where the key changes. `to(key, i)` is where sum i of a key is. By all threads of a warp.
template <int N, class S, class To>
class SumsByKey {
 public:
  __device__ explicit SumsByKey(const To& to) : to_(to) {}

  // Adds numbers of a lane; a negative key adds nothing.
  __device__ void add(int key, const S (&values)[N]) {
    unsigned left = __ballot_sync(~0u, key >= 0);
#pragma unroll 1
    while (left) {
      const int next = __shfl_sync(~0u, key, __ffs(int(left)) - 1);
      left &= ~__ballot_sync(~0u, key == next);
      if (next != key_) finish();
      key_ = next;
#pragma unroll
      for (int i = 0; i < N; i++) sums_[i] += key == next ? values[i] : S(0);
    }
  }

  // Adds the sums of the last key, too.
  __device__ void finish() {
    if (key_ < 0) return;
    int first = 0, count = N;
    scatter_sums<N, 16>(sums_, first, count);
#pragma unroll
    for (int i = 0; i < (N + 31) / 32; i++)
      if (i < count) *to_(key_, first + i) += double(sums_[i]);
#pragma unroll
    for (int i = 0; i < N; i++) sums_[i] = S(0);
  }

 private:
  const To& to_;
  int key_ = -1;
  S sums_[N] = {};
};

}  // namespace mpm::cuda
