#pragma once

#include <cstdint>

// Memory of large tensors on the CPU. A step allocates its results, and fresh memory costs a page fault and a zeroed
// page every 4 KB: up to a third of a step. Memory of dead tensors is stored for the next step, on large pages where
// the system has them. Stored memory is at most kKept times that of living tensors, so that little remains after them,
// or kKeptAnyway, so that the next rollout of a training loop finds the memory of the previous one.
namespace mpm::cpu {

constexpr int64_t kLeastCached = 1 << 20;  // bytes from which the memory of a tensor is stored
constexpr int64_t kKept = 4, kKeptAnyway = 128 << 20;

struct Buffer {
  char* data;
  int64_t size;   // usable bytes from data on
  char* mapping;  // address returned by the system
  int64_t mapped;
};

// Uninitialised memory, or null where the system has none. Any thread may call both.
Buffer* take(int64_t bytes);
void give_back(Buffer* buffer);

}  // namespace mpm::cpu
