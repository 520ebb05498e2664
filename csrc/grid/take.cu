#include "cuda/launch.cuh"
#include "grid/kernels.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 256, kAtOnce = 4;  // columns of a thread, whose loads do not wait for each other

__global__ void __launch_bounds__(kThreads) take_kernel(const __grid_constant__ TakeArguments a, int64_t blocks) {
  const int64_t i = (blockIdx.x % blocks) * kThreads + threadIdx.x;
  const int first = int(blockIdx.x / blocks) * kAtOnce;
  if (i >= a.count) return;
  const int64_t particle = a.particle(i);
  const bool exists = a.has(particle);
  uint64_t value[kAtOnce];
#pragma unroll
  for (int k = 0; k < kAtOnce; k++) value[k] = exists && first + k < a.columns ? a.column[first + k].read(particle) : 0;
#pragma unroll
  for (int k = 0; k < kAtOnce; k++)
    if (first + k < a.columns) a.column[first + k].write(i, value[k]);
}

}  // namespace

void take(const TakeArguments& a, Stream stream) {
  const int64_t blocks = (a.count + kThreads - 1) / kThreads, groups = (a.columns + kAtOnce - 1) / kAtOnce;
  if (blocks * groups > 0) launch(take_kernel, unsigned(blocks * groups), kThreads, 0, stream, a, blocks);
}

}  // namespace mpm::cuda
