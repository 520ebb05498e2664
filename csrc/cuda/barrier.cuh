#pragma once

#include <cooperative_groups.h>

namespace mpm::cuda {

// Barrier of `blocks` thread blocks that all run at once; `arrived` is zero before the first one. That of cooperative
// groups asks for the last block without a pause, which slows down those that are still at work.
__device__ inline void wait_for_blocks(unsigned* arrived, unsigned blocks) {
  __syncthreads();
  if (threadIdx.x == 0) {
    __threadfence();
    const unsigned all = (atomicAdd(arrived, 1) / blocks + 1) * blocks;
    while (int(*static_cast<volatile unsigned*>(arrived) - all) < 0) __nanosleep(50);
    __threadfence();
  }
  __syncthreads();
}

// The same for a chain of barriers of one kernel, where nothing else is to be done meanwhile.
struct Barrier {
  unsigned* arrived;  // zero before the kernel
  unsigned blocks, all = 0;

  __device__ void wait() {
    __syncthreads();
    all += blocks;
    if (threadIdx.x == 0) {
      asm volatile("red.release.gpu.global.add.u32 [%0], 1;" ::"l"(arrived) : "memory");
      unsigned now;
      do asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(now) : "l"(arrived) : "memory");
      while (int(now - all) < 0);
    }
    __syncthreads();
  }
};

// Whether all thread blocks of a kernel are one cluster, as launch_at_once() makes of few.
__device__ inline bool is_cluster() {
#if __CUDA_ARCH__ >= 900
  return cooperative_groups::this_cluster().num_blocks() == gridDim.x;
#else
  return false;
#endif
}

__device__ inline void wait_for_cluster() {
#if __CUDA_ARCH__ >= 900
  cooperative_groups::this_cluster().sync();
#endif
}

// Barrier of all thread blocks of a kernel launched by launch_at_once().
__device__ inline void wait_for_all() {
  if (is_cluster())
    wait_for_cluster();
  else
    cooperative_groups::this_grid().sync();
}

}  // namespace mpm::cuda
