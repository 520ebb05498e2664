#pragma once

#include <cooperative_groups.h>

namespace mpm::cuda {

// Barrier of `blocks` concurrent thread blocks; `arrived` is zero before the first one. The barrier of cooperative
// groups polls for the last block without a pause, which slows down blocks that are still at work.
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

// The same for consecutive barriers of one kernel without other work in between. Counts of thread blocks are summed
// with the barrier, so that they need not be read separately.
struct Barrier {
  // Two that alternate, zero before the kernel, with the counts in the upper half: a late block still finds the counts
  // up to this barrier only.
  unsigned long long* arrived;
  unsigned blocks, number = 0;

  // Returns all counts of every other barrier up to this one. `count()` is called by thread 0 when all threads of its
  // block have arrived.
  template <class Count>
  __device__ unsigned wait(const Count& count) {
    __shared__ unsigned sum;
    __syncthreads();
    unsigned long long* const word = arrived + number % 2;
    const unsigned expected = (number / 2 + 1) * blocks;
    number++;
    if (threadIdx.x == 0) {
      const unsigned long long one = 1 + (static_cast<unsigned long long>(count()) << 32);
      asm volatile("red.release.gpu.global.add.u64 [%0], %1;" ::"l"(word), "l"(one) : "memory");
      unsigned long long now;
      do asm volatile("ld.acquire.gpu.global.u64 %0, [%1];" : "=l"(now) : "l"(word) : "memory");
      while (int(unsigned(now) - expected) < 0);
      sum = unsigned(now >> 32);
    }
    __syncthreads();
    return sum;
  }
};

// Whether all thread blocks of a kernel are one cluster, as launch_at_once() makes for few.
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

// Counterpart of `mine` of thread block `block` of a cluster, in shared memory.
template <class T>
__device__ const T* in_block_of_cluster(T* mine, unsigned block) {
#if __CUDA_ARCH__ >= 900
  return cooperative_groups::this_cluster().map_shared_rank(mine, block);
#else
  return mine;
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
