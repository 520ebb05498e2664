#pragma once

#include "common/lanes.h"
#include "common/pack.h"
#include "cpu/parallel.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T, int N>
MPM_HD Pack<T, N> load_lanes(const T* pointer, int64_t stride, int count) {
  T lanes[N];
  for (int i = 0; i < N; i++) lanes[i] = pointer[(i < count ? i : count - 1) * stride];
  return Pack<T, N>::load(lanes);
}
template <class T, int N>
MPM_HD void store_lanes(T* pointer, int64_t stride, unsigned lanes, const Pack<T, N>& value) {
  for (int i = 0; i < N; i++)
    if (lanes >> i & 1) pointer[i * stride] = value[i];
}

// The same as calls: long kernels have a hundred of them, and would take twice as long to compile inline.
template <class T, int N>
[[gnu::noinline]] Pack<T, N> call_load_lanes(const T* pointer, int64_t stride, int count) {
  return load_lanes<T, N>(pointer, stride, count);
}
template <class T, int N>
[[gnu::noinline]] void call_store_lanes(T* pointer, int64_t stride, unsigned lanes, const Pack<T, N>& value) {
  store_lanes(pointer, stride, lanes, value);
}

// Particles p, ..., p + count − 1 in the first lanes of a pack; the other lanes repeat the last one. Particles of the
// bits `lanes` are stored. Non-contiguous data is read and written inline, or by calls.
template <class T, int N, bool InPlace>
struct Consecutive {
  using Value = Pack<T, N>;
  static constexpr unsigned kAll = (2u << (N - 1)) - 1;
  int64_t p;
  int count;
  unsigned lanes;

  MPM_HD Value load(const T* pointer, int64_t stride) const {
    if (stride == 1 && count == N) [[likely]]
      return Value::load(pointer + p);
    if constexpr (InPlace) return load_lanes<T, N>(pointer + p * stride, stride, count);
    return call_load_lanes<T, N>(pointer + p * stride, stride, count);
  }
  MPM_HD Value load_shared(const T* pointer, int64_t stride) const {
    return stride == 0 ? Value(*pointer) : load(pointer, stride);
  }
  MPM_HD void store(T* pointer, int64_t stride, const Value& value) const {
    if (stride == 1 && lanes == kAll) [[likely]]
      return value.store(pointer + p);
    if constexpr (InPlace) return store_lanes(pointer + p * stride, stride, lanes, value);
    call_store_lanes(pointer + p * stride, stride, lanes, value);
  }
  template <class F>
  MPM_HD Value each(const F& f) const {
    T values[N];
    for (int i = 0; i < N; i++) values[i] = f(p + (i < count ? i : count - 1));
    return Value::load(values);
  }
  MPM_HD void store_integer(int* pointer, const Value& value) const {
    for (int i = 0; i < N; i++)
      if (lanes >> i & 1) pointer[p + i] = int(value[i]);
  }
};

}  // namespace TORCH_MPM_ISA

namespace cpu {
inline namespace TORCH_MPM_ISA {

// f(at) for the particles, or some of them, in groups of one register or of another number of bytes.
template <class T, int Bytes = kRegisterBytes, bool InPlace = true, class F>
void for_groups(int64_t particles, const F& f, const Members& members = {}) {
  constexpr int N = Bytes / sizeof(T);
  constexpr int64_t grain = 64;  // groups below which a range is not split
  parallel_ranges((particles + N - 1) / N, grain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin * N; p < end * N && p < particles; p += N) {
      const int count = int(particles - p < N ? particles - p : N);
      unsigned lanes = (2u << (count - 1)) - 1;
      if (members.material)
        for (int i = 0; i < count; i++)
          if (!members.has(p + i)) lanes &= ~(1u << i);
      if (lanes) f(Consecutive<T, N, InPlace>{p, count, lanes});
    }
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace cpu
}  // namespace mpm
