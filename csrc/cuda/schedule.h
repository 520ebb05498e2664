#pragma once

#include <cstdint>

// The schedule tensor of the CUDA kernels: the number of work items, then the items from entry 4 on, four ints each:
// slot, begin and end in the index tensor, table index. An item is at most kItemParticles particles of one home block; a
// crowded block makes several.
namespace mpm::cuda {

constexpr int kItemParticles = 576;
constexpr int kScheduleHeader = 4;

// Upper bound of the number of items: homes hold particles, and splitting adds less than one item per kItemParticles.
inline int64_t most_items(int64_t capacity, int64_t particles) {
  return (capacity < particles ? capacity : particles) + particles / kItemParticles;
}

}  // namespace mpm::cuda
