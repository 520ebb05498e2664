#pragma once

#include "cuda/launch.cuh"
#include "grid/slot_sums.h"

namespace mpm::cuda {

constexpr int kSlotTurns = 32, kSlotColumns = 32;  // of a thread block at a time

// A thread block has a row, and adds up its slots in a fixed order.
template <class Value>
__global__ void __launch_bounds__(kSlotTurns* kSlotColumns) slot_sums_kernel(const SlotSums<Value> a) {
  __shared__ Value sums[kSlotTurns][kSlotColumns];
  const int row = blockIdx.x, turn = threadIdx.x / kSlotColumns, lane = threadIdx.x % kSlotColumns;
  const auto [begin, end] = slots_of_row(a, row);
  for (int first = 0; first < a.columns; first += kSlotColumns) {
    const int column = first + lane;
    Value sum = 0;
    for (int slot = begin + turn; column < a.columns && slot < end; slot += kSlotTurns)
      sum += a.value[int64_t(slot) * a.columns + column];
    sums[turn][lane] = sum;
    __syncthreads();
    if (turn == 0 && column < a.columns) {
      for (int other = 1; other < kSlotTurns; other++) sum += sums[other][lane];
      a.sum[row * a.row_stride + column] += sum;
    }
    __syncthreads();
  }
}

template <class Value>
void add_up(const SlotSums<Value>& a, Stream stream) {
  if (a.rows > 0 && a.columns > 0)
    launch(slot_sums_kernel<Value>, unsigned(a.rows), kSlotTurns * kSlotColumns, 0, stream, a);
}

}  // namespace mpm::cuda
