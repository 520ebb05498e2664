#pragma once

#include "cuda/launch.cuh"
#include "grid/slot_sums.h"

namespace mpm::cuda {

constexpr int kSlotTurns = 32, kSlotColumns = 32;  // of a thread block at a time

// One row per thread block, which sums its slots in a fixed order. Slots are in the order of their blocks, so those of
// a scene are neighbours, and unused ones come last.
template <class Value>
__global__ void __launch_bounds__(kSlotTurns* kSlotColumns) slot_sums_kernel(const SlotSums<Value> a) {
  __shared__ double sums[kSlotTurns][kSlotColumns];
  const int row = blockIdx.x, turn = threadIdx.x / kSlotColumns, lane = threadIdx.x % kSlotColumns;
  const auto first_from = [&](int64_t least) {  // slot of block `least` or of a later one
    int begin = 0, end = a.max_blocks;
    while (begin < end) {
      const int middle = begin + (end - begin) / 2;
      if (a.block[middle] >= 0 && a.block[middle] < least)
        begin = middle + 1;
      else
        end = middle;
    }
    return begin;
  };
  const int begin = a.by_scene ? first_from(int64_t(row) * a.blocks_per_scene) : 0;
  const int end = first_from(a.by_scene ? (row + int64_t(1)) * a.blocks_per_scene : INT64_MAX);
  for (int first = 0; first < a.columns; first += kSlotColumns) {
    const int column = first + lane;
    double sum = 0;
    for (int slot = begin + turn; column < a.columns && slot < end; slot += kSlotTurns)
      sum += double(a.value[int64_t(slot) * a.columns + column]);
    sums[turn][lane] = sum;
    __syncthreads();
    if (turn == 0 && column < a.columns) {
      for (int other = 1; other < kSlotTurns; other++) sum += sums[other][lane];
      a.sum[row * a.row_stride + column] += Value(sum);
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
