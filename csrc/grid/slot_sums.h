#pragma once

#include <cstdint>

#include "common/host_device.h"

// Sums of what each slot has, over the slots of each scene.
namespace mpm {

// sum[r, c] += values of slots [max_blocks, columns]: of those of scene r, or, in the only row, of all that are used.
// Slots are in the order of their blocks, and unused ones come last.
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

struct SlotRange {
  int begin, end;
};

inline namespace TORCH_MPM_ISA {

template <class Value>
MPM_HD SlotRange slots_of_row(const SlotSums<Value>& a, int row) {
  const auto first_from = [&](int64_t least) {  // slot whose block is `least` or a later one
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
  if (!a.by_scene) return {0, first_from(INT64_MAX)};
  return {first_from(int64_t(row) * a.blocks_per_scene), first_from((row + int64_t(1)) * a.blocks_per_scene)};
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
