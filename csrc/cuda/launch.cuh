#pragma once

#include <cuda_runtime.h>

#include <algorithm>
#include <stdexcept>
#include <string>

#include "common/instantiate.h"

// Host side of a kernel launch.
namespace mpm::cuda {

using Stream = cudaStream_t;

inline void check(cudaError_t error) {
  if (error != cudaSuccess) throw std::runtime_error(std::string("CUDA: ") + cudaGetErrorString(error));
}

inline int device_attribute(cudaDeviceAttr attribute) {
  int device = 0, value = 0;
  check(cudaGetDevice(&device));
  check(cudaDeviceGetAttribute(&value, attribute, device));
  return value;
}

// Number of thread blocks for `count` work items in a grid-stride loop. It exceeds the number of resident blocks by
// far, so that the hardware balances the load, and is limited, because empty blocks cost time where `count` is a
// generous bound.
inline unsigned grid_size(int64_t count) {
  const int processors = device_attribute(cudaDevAttrMultiProcessorCount);
  return unsigned(std::clamp<int64_t>(count, 1, int64_t(processors) * 128));
}

// The same for a task that may state that it mostly has nothing to do: each thread block then costs time, too.
template <class Task>
unsigned grid_size(const Task& task, int64_t count) {
  constexpr unsigned share = 8;  // one in this number is enough
  if constexpr (requires { task.is_mostly_idle(); })
    if (task.is_mostly_idle()) return std::max(grid_size(count) / share, 1u);
  return grid_size(count);
}

// Shared memory above 48 KB must be requested, and statically declared memory counts too: up to 22 KB.
template <class Kernel>
void allow_shared_memory(Kernel* kernel, size_t shared_memory) {
  if (shared_memory > 26 * 1024)
    check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(shared_memory)));
}

template <class... Parameters, class... Arguments>
void launch(void (*kernel)(Parameters...), unsigned blocks, unsigned threads, size_t shared_memory, cudaStream_t stream,
            const Arguments&... arguments) {
  allow_shared_memory(kernel, shared_memory);
  kernel<<<blocks, threads, shared_memory, stream>>>(arguments...);
  check(cudaGetLastError());
}

// Concurrent thread blocks that may wait for each other, as many of `blocks` as fit on the device.
template <class... Parameters, class... Arguments>
void launch_together(void (*kernel)(Parameters...), unsigned blocks, unsigned threads, size_t shared_memory,
                     cudaStream_t stream, Arguments... arguments) {
  allow_shared_memory(kernel, shared_memory);
  int fitting = 0;
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&fitting, kernel, int(threads), shared_memory));
  const unsigned most = unsigned(fitting * device_attribute(cudaDevAttrMultiProcessorCount));
  void* pointers[] = {&arguments...};
  check(cudaLaunchCooperativeKernel(reinterpret_cast<const void*>(kernel), std::clamp(blocks, 1u, std::max(most, 1u)),
                                    threads, pointers, shared_memory, stream));
}

}  // namespace mpm::cuda
