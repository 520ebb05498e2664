#pragma once

#include <cstdint>

// Memory of large block tables on the CPU. All bits are set, and only pages that are written take memory and time: the
// others are those of one small file, over and over.
namespace mpm::cpu {

constexpr int64_t kOnes = 8 << 20;  // bytes from which this costs less than to set all bits

// Null where the system has no such memory. Any thread may call both.
void* take_ones(int64_t bytes);
void give_back_ones(void* data, int64_t bytes);

}  // namespace mpm::cpu
