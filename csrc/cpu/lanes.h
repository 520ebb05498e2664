#pragma once

#include "common/lanes.h"
#include "common/pack.h"
#include "cpu/parallel.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Particles p, ..., p + count − 1 in the first lanes of a pack; the other lanes repeat the last one and are not stored.
template <class T, int N>
struct Consecutive {
  using Value = Pack<T, N>;
  int64_t p;
  int count;

  MPM_HD Value load(const T* pointer, int64_t stride) const {
    if (stride == 1 && count == N) return Value::load(pointer + p);
    return each([&](int64_t particle) { return pointer[particle * stride]; });
  }
  MPM_HD void store(T* pointer, int64_t stride, const Value& value) const {
    if (stride == 1 && count == N) return value.store(pointer + p);
    for (int i = 0; i < count; i++) pointer[(p + i) * stride] = value[i];
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
template <class T, int Bytes = kRegisterBytes, class F>
void for_groups(int64_t particles, const F& f) {
  constexpr int lanes = Bytes / sizeof(T);
  constexpr int64_t grain = 64;  // groups below which a range is not split
  parallel_ranges((particles + lanes - 1) / lanes, grain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin * lanes; p < end * lanes && p < particles; p += lanes)
      f(Consecutive<T, lanes>{p, int(particles - p < lanes ? particles - p : lanes)});
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace cpu
}  // namespace mpm
