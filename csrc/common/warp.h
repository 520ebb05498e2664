#pragma once

#include "common/host_device.h"

// Calls of functions that are not inlined. The threads of a warp make them together:
//     if (any_of_warp(wanted)) {
//       function(wanted, ...);  // which returns at once for threads that do not want it
//       join_warp();
//     }
// The machine code of nvcc 13.0 gives barriers of convergence up where a branch contains a deep call. The threads of a
// warp then leave the branch at different times. Values that are common to a warp, as the counters of its loops, are
// overwritten or increment twice. A function that is called so and calls another one does the same: it has no branch
// around that call but for a condition of `any_of_warp`. All threads of the warp that have not returned from the kernel
// call both functions. On the CPU, a warp is one thread.

// A call keeps the registers and instructions of what few nodes need out of the loops over all others.
#if defined(__CUDACC__)
#define MPM_HD_CALL __host__ __device__ __noinline__
#else
#define MPM_HD_CALL inline __attribute__((noinline))
#endif

namespace mpm {
inline namespace TORCH_MPM_ISA {

MPM_HD bool any_of_warp(bool wanted) {
#ifdef __CUDA_ARCH__
  return __any_sync(0xffffffffu, wanted);
#else
  return wanted;
#endif
}

MPM_HD void join_warp() {
#ifdef __CUDA_ARCH__
  __syncwarp();
#endif
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
