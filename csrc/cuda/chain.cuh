#pragma once

#include "cuda/launch.cuh"

// Kernels of a step, which mostly follow one another: each is launched while the one before it is at work, and waits
// for that. Compiled for compute capability 9.0 or later; else they are launched as any other.
namespace mpm::cuda {

// Whether a kernel was compiled to wait: PTX of an older architecture, which newer devices take too, was not. All
// kernels are compiled for the same ones.
template <class Kernel>
bool waits_for_kernel_before(Kernel* kernel) {
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

// What every thread of a kernel that is launched in a chain does, once or more often: before it reads what the kernel
// before has written, and before it ends. The next one comes after that, so what it does before it waits in turn may
// read what was written before the kernel before it.
__device__ inline void wait_for_kernel_before() {
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

// The kernel must call wait_for_kernel_before().
template <class... Parameters, class... Arguments>
void launch_in_chain(void (*kernel)(Parameters...), unsigned blocks, unsigned threads, size_t shared_memory,
                     cudaStream_t stream, const Arguments&... arguments) {
  if (!waits_for_kernel_before(kernel)) return launch(kernel, blocks, threads, shared_memory, stream, arguments...);
  allow_shared_memory(kernel, shared_memory);
  cudaLaunchAttribute overlap = overlap_attribute();
  const cudaLaunchConfig_t config = launch_config(&overlap, 1, blocks, threads, shared_memory, stream);
  check(cudaLaunchKernelEx(&config, kernel, Parameters(arguments)...));
}

constexpr unsigned kLargestCluster = 16;  // of which not every device takes more than 8

// Thread blocks that run all at once and may wait for each other, by wait_for_all(): a few as one cluster, whose
// barriers are faster, in a chain like launch_in_chain(). The kernel must call wait_for_kernel_before() first of all.
template <class... Parameters, class... Arguments>
void launch_at_once(void (*kernel)(Parameters...), unsigned blocks, unsigned threads, size_t shared_memory,
                    cudaStream_t stream, const Arguments&... arguments) {
  if (blocks > kLargestCluster || !waits_for_kernel_before(kernel))
    return launch_together(kernel, blocks, threads, shared_memory, stream, arguments...);
  allow_shared_memory(kernel, shared_memory);
  cudaLaunchAttribute attributes[2] = {overlap_attribute()};
  attributes[1].id = cudaLaunchAttributeClusterDimension;
  attributes[1].val.clusterDim = {blocks, 1, 1};
  const cudaLaunchConfig_t config = launch_config(attributes, 2, blocks, threads, shared_memory, stream);
  const auto takes_cluster = [&] {
    cudaLaunchConfig_t cluster = config;  // without the chain
    cluster.attrs = attributes + 1;
    cluster.numAttrs = 1;
    int clusters = 0;
    if (cudaFuncSetAttribute(kernel, cudaFuncAttributeNonPortableClusterSizeAllowed, 1) == cudaSuccess &&
        cudaOccupancyMaxActiveClusters(&clusters, kernel, &cluster) == cudaSuccess)
      return clusters > 0;
    cudaGetLastError();  // which is no error: the device takes no such cluster
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
