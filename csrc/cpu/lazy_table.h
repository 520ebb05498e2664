#pragma once

#include <cstdint>

// Memory of large block tables on the CPU. All bits are set, and only written pages take memory and time: the others
// map one small file repeatedly.
namespace mpm::cpu {

constexpr int64_t kLazyTable = 8 << 20;  // number of bytes from which this costs less than setting all bits

// Null where the system does not support it. Any thread may call both.
void* allocate_lazy_table(int64_t bytes);
void free_lazy_table(void* data, int64_t bytes);

}  // namespace mpm::cpu
