#pragma once

#include "cpu/chunk.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Particles of a group in the form of a kernel body (common/lanes.h).
template <class T, int N>
struct Grouped {
  using Value = Pack<T, N>;
  const GroupOf<N>& group;
  Value load(const T* pointer, int64_t stride) const { return load_row(pointer, stride, group); }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
