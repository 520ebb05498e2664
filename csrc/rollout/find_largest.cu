#include "cuda/launch.cuh"
#include "rollout/kernels.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads)
    find_largest_kernel(const Field<const float> numbers, int64_t count, int* bits) {
  int largest = 0;
  for (int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x; i < count; i += int64_t(gridDim.x) * kThreads)
    largest = ::max(largest, __float_as_int(fabsf(numbers.pointer[i * numbers.stride[0]])));
  largest = __reduce_max_sync(~0u, largest);
  if (threadIdx.x % 32 == 0) atomicMax(bits, largest);
}

}  // namespace

// As integers numbers that are not negative have the same order.
void find_largest(const Field<const float>& numbers, int64_t count, int* bits, Stream stream) {
  check(cudaMemsetAsync(bits, 0, sizeof(int), stream));
  launch(find_largest_kernel, grid_size((count + kThreads - 1) / kThreads), kThreads, 0, stream, numbers, count, bits);
}

}  // namespace mpm::cuda
