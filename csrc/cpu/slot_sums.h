#pragma once

#include "cpu/parallel.h"
#include "grid/slot_sums.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// In the order of the slots, whatever the number of threads.
template <class Value>
void add_up(const SlotSums<Value>& a) {
  constexpr int most = 16;  // columns at a time
  parallel_ranges(a.rows, 1, [&](int64_t begin, int64_t end) {
    for (int row = int(begin); row < int(end); row++) {
      const SlotRange slots = slots_of_row(a, row);
      for (int first = 0; first < a.columns; first += most) {
        const int columns = a.columns - first < most ? a.columns - first : most;
        Value sums[most] = {};
        for (int64_t slot = slots.begin; slot < slots.end; slot++)
          for (int c = 0; c < columns; c++) sums[c] += a.value[slot * a.columns + first + c];
        for (int c = 0; c < columns; c++) a.sum[row * a.row_stride + first + c] += sums[c];
      }
    }
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
