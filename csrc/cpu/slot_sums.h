#pragma once

#include "common/host_device.h"
#include "grid/slot_sums.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Sums in the order of the slots: consecutive slots of one row are summed in float64. Any slot may be unused.
template <class Value>
void add_up(const SlotSums<Value>& a) {
  constexpr int most = 16;  // columns at a time
  const auto row_of = [&](int64_t slot) {
    const int row = a.block[slot] < 0 ? -1 : a.by_scene ? a.block[slot] / a.blocks_per_scene : 0;
    return row < a.rows ? row : -1;
  };
  for (int64_t begin = 0, end; begin < a.max_blocks; begin = end) {
    const int row = row_of(begin);
    for (end = begin + 1; end < a.max_blocks && row_of(end) == row;) end++;
    for (int first = 0; row >= 0 && first < a.columns; first += most) {
      const int columns = a.columns - first < most ? a.columns - first : most;
      double sums[most] = {};
      for (int64_t slot = begin; slot < end; slot++)
        for (int c = 0; c < columns; c++) sums[c] += double(a.value[slot * a.columns + first + c]);
      for (int c = 0; c < columns; c++) a.sum[row * a.row_stride + first + c] += Value(sums[c]);
    }
  }
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
