#pragma once

// Threads that share a slot.
namespace mpm::cuda {

constexpr int kSlotLanes = 16;

// The lanes of a slot are half a warp and take the same branches; those of the other half may differ.
struct SumLanes {
  template <class T>
  __device__ T operator()(T x) const {
    const unsigned mask = 0xffffu << (threadIdx.x & kSlotLanes);
    for (int step = kSlotLanes / 2; step > 0; step /= 2) x += __shfl_down_sync(mask, x, step, kSlotLanes);
    return x;
  }
};

}  // namespace mpm::cuda
