#pragma once

#include <cstdint>

// Sums of the values of slots, over the slots of each scene.
namespace mpm {

// sum[r, c] += sum of values [max_blocks, columns] over the slots of scene r, or, for a single row, over all used
// slots.
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
