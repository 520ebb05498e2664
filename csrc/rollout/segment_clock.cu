#include "cuda/launch.cuh"
#include "rollout/kernels.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

__global__ void __launch_bounds__(kThreads) segment_clock_kernel(const __grid_constant__ SegmentClockArguments a) {
  const int64_t scene = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (scene < a.scenes) next_segment(a, scene);
}

}  // namespace

void segment_clock(const SegmentClockArguments& a, Stream stream) {
  if (a.scenes > 0)
    launch(segment_clock_kernel, unsigned((a.scenes + kThreads - 1) / kThreads), kThreads, 0, stream, a);
}

}  // namespace mpm::cuda
