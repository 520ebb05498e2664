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
MPM_HD void store_lanes(T* pointer, int64_t stride, int count, const Pack<T, N>& value) {
  for (int i = 0; i < count; i++) pointer[i * stride] = value[i];
}

// The same as calls: long kernels have a hundred of them, and would take twice as long to compile.
template <class T, int N>
[[gnu::noinline]] Pack<T, N> call_load_lanes(const T* pointer, int64_t stride, int count) {
  return load_lanes<T, N>(pointer, stride, count);
}
template <class T, int N>
[[gnu::noinline]] void call_store_lanes(T* pointer, int64_t stride, int count, const Pack<T, N>& value) {
  store_lanes(pointer, stride, count, value);
}

// Particles p, ..., p + count − 1 in the first lanes of a pack; the other lanes repeat the last one and are not stored.
// What is not contiguous is read and written by code in place, or by calls.
template <class T, int N, bool InPlace>
struct Consecutive {
  using Value = Pack<T, N>;
  int64_t p;
  int count;

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
    if (stride == 1 && count == N) [[likely]]
      return value.store(pointer + p);
    if constexpr (InPlace) return store_lanes(pointer + p * stride, stride, count, value);
    call_store_lanes(pointer + p * stride, stride, count, value);
  }
  template <class F>
  MPM_HD Value each(const F& f) const {
    T lanes[N];
    for (int i = 0; i < N; i++) lanes[i] = f(p + (i < count ? i : count - 1));
    return Value::load(lanes);
  }
  MPM_HD void store_integer(int* pointer, const Value& value) const {
    for (int i = 0; i < count; i++) pointer[p + i] = int(value[i]);
  }
};

}  // namespace TORCH_MPM_ISA

namespace cpu {
inline namespace TORCH_MPM_ISA {

// f(at) with the particles in groups of one register, or of another number of bytes.
template <class T, int Bytes = kRegisterBytes, bool InPlace = true, class F>
void for_groups(int64_t particles, const F& f) {
  constexpr int lanes = Bytes / sizeof(T);
  constexpr int64_t grain = 64;  // groups below which a range is not split
  parallel_ranges((particles + lanes - 1) / lanes, grain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin * lanes; p < end * lanes && p < particles; p += lanes)
      f(Consecutive<T, lanes, InPlace>{p, int(particles - p < lanes ? particles - p : lanes)});
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace cpu
}  // namespace mpm
