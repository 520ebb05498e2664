#pragma once

#include "cuda/programmatic_launch.cuh"

// Loops with a thread for each of many pieces of work.
namespace mpm::cuda {

constexpr int kEachThreads = 256;

// Calls work(a, i) for i < count, one per thread.
template <auto work, class Arguments>
__global__ void __launch_bounds__(kEachThreads) each_kernel(const __grid_constant__ Arguments a, int64_t count) {
  grid_dependency_sync();
  const int64_t i = int64_t(blockIdx.x) * kEachThreads + threadIdx.x;
  if (i < count) work(a, i);
}

template <auto work, class Arguments>
void for_each(int64_t count, const Arguments& a, Stream stream) {
  if (count == 0) return;
  launch_in_chain(each_kernel<work, Arguments>, unsigned((count + kEachThreads - 1) / kEachThreads), kEachThreads, 0,
                  stream, a, count);
}

}  // namespace mpm::cuda
