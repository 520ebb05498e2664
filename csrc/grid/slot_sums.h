#pragma once

#include <cstdint>

// Sums of what each slot has, over the slots of each scene.
namespace mpm {

// sum[r, c] += values of slots [max_blocks, columns]: of those of scene r, or, in the only row, of all that are used.
template <class Value>
struct SlotSums {
  int max_blocks = 0, blocks_per_scene = 0;
  const int* block = nullptr;  // [max_blocks] block of a slot, -1 where unused
  int rows = 0, columns = 0;
  bool by_scene = false;
  const Value* value = nullptr;
  Value* sum = nullptr;
  int64_t row_stride = 0;
};

}  // namespace mpm
