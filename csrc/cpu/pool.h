#pragma once

#include <cstdint>

// Memory of large tensors on the CPU. A step makes its results anew, and fresh memory costs a page fault and a zeroed
// page every 4 KB: up to a third of a step. What a dead tensor leaves is kept for the next step, on large pages where
// the system has them. Kept memory is at most kKept times that of living tensors, so that little stays behind when they
// go, or kKeptAnyway, so that the next rollout of a training loop finds the memory of the one before.
namespace mpm::cpu {

constexpr int64_t kPooled = 1 << 20;  // bytes from which a tensor comes from the pool
constexpr int64_t kKept = 4, kKeptAnyway = 128 << 20;

struct Buffer {
  char* data;
  int64_t size;   // bytes from data on
  char* mapping;  // what the system gave
  int64_t mapped;
};

// Uninitialised memory, or null where the system has none. Any thread may call both.
Buffer* take(int64_t bytes);
void give_back(Buffer* buffer);

}  // namespace mpm::cpu
