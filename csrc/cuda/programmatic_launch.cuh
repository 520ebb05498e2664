#pragma once

#include "cuda/launch.cuh"

// Consecutive kernels of a step: each is launched while the previous one runs, and waits for it (programmatic dependent
// launch). For compute capability 9.0 or later; otherwise they are launched as usual.
namespace mpm::cuda {

// Whether a kernel was compiled with this wait: PTX of an older architecture, which newer devices accept too, was not.
// All kernels are compiled for the same architectures.
template <class Kernel>
bool has_grid_dependency_sync(Kernel* kernel) {
  const auto compiled_for = [&] {
    cudaFuncAttributes attributes;
    check(cudaFuncGetAttributes(&attributes, kernel));
    return attributes.ptxVersion;
  };
  static const bool waits = compiled_for() >= 90;
  return waits && device_attribute(cudaDevAttrComputeCapabilityMajor) >= 9;
}

__device__ inline void let_next_kernel_begin() {
#if __CUDA_ARCH__ >= 900
  cudaTriggerProgrammaticLaunchCompletion();
#endif
}

// To be called by every thread of a kernel launched in a chain, once or more often: before it reads results of the
// previous kernel, and before it ends. The next kernel starts afterwards, so before its own wait it may read results of
// kernels before its predecessor.
__device__ inline void grid_dependency_sync() {
#if __CUDA_ARCH__ >= 900
  cudaGridDependencySynchronize();
#endif
  let_next_kernel_begin();
}

inline cudaLaunchConfig_t launch_config(cudaLaunchAttribute* attributes, unsigned count, unsigned blocks,
                                        unsigned threads, size_t shared_memory, cudaStream_t stream) {
  cudaLaunchConfig_t config{};
  config.gridDim = blocks;
  config.blockDim = threads;
  config.dynamicSmemBytes = shared_memory;
  config.stream = stream;
  config.attrs = attributes;
  config.numAttrs = count;
  return config;
}

inline cudaLaunchAttribute overlap_attribute() {
  cudaLaunchAttribute overlap;
  overlap.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  overlap.val.programmaticStreamSerializationAllowed = 1;
  return overlap;
}

// The kernel must call grid_dependency_sync().
template <class... Parameters, class... Arguments>
void launch_in_chain(void (*kernel)(Parameters...), unsigned blocks, unsigned threads, size_t shared_memory,
                     cudaStream_t stream, const Arguments&... arguments) {
  if (!has_grid_dependency_sync(kernel)) return launch(kernel, blocks, threads, shared_memory, stream, arguments...);
  allow_shared_memory(kernel, shared_memory);
  cudaLaunchAttribute overlap = overlap_attribute();
  const cudaLaunchConfig_t config = launch_config(&overlap, 1, blocks, threads, shared_memory, stream);
  check(cudaLaunchKernelEx(&config, kernel, Parameters(arguments)...));
}

constexpr unsigned kLargestCluster = 16;  // not every device supports more than 8

// Concurrent thread blocks that may wait for each other, by wait_for_all(): few as one cluster, whose barriers are
// faster, in a chain like launch_in_chain(). The kernel must call grid_dependency_sync() first of all.
template <class... Parameters, class... Arguments>
void launch_at_once(void (*kernel)(Parameters...), unsigned blocks, unsigned threads, size_t shared_memory,
                    cudaStream_t stream, const Arguments&... arguments) {
  if (blocks > kLargestCluster || !has_grid_dependency_sync(kernel))
    return launch_together(kernel, blocks, threads, shared_memory, stream, arguments...);
  allow_shared_memory(kernel, shared_memory);
  cudaLaunchAttribute attributes[2] = {overlap_attribute()};
  attributes[1].id = cudaLaunchAttributeClusterDimension;
  attributes[1].val.clusterDim = {blocks, 1, 1};
  const cudaLaunchConfig_t config = launch_config(attributes, 2, blocks, threads, shared_memory, stream);
  const auto takes_cluster = [&] {
    cudaLaunchConfig_t cluster = config;  // without a chain
    cluster.attrs = attributes + 1;
    cluster.numAttrs = 1;
    int clusters = 0;
    if (cudaFuncSetAttribute(kernel, cudaFuncAttributeNonPortableClusterSizeAllowed, 1) == cudaSuccess &&
        cudaOccupancyMaxActiveClusters(&clusters, kernel, &cluster) == cudaSuccess)
      return clusters > 0;
    cudaGetLastError();  // not an error: the device does not support such a cluster
    return false;
  };
  struct Answer {
    void (*kernel)(Parameters...) = nullptr;
    int device = -1;
    unsigned blocks = 0;
    bool yes = false;
  };
  static thread_local Answer last;
  int device = 0;
  check(cudaGetDevice(&device));
  if (last.kernel != kernel || last.device != device || last.blocks != blocks)
    last = {kernel, device, blocks, takes_cluster()};
  if (last.yes)
    check(cudaLaunchKernelEx(&config, kernel, Parameters(arguments)...));
  else
    launch_together(kernel, blocks, threads, shared_memory, stream, arguments...);
}

}  // namespace mpm::cuda
