#pragma once

#include "cuda/launch.cuh"

// Kernels of a step, which mostly follow one another: each is launched while the one before it ends, and waits for that
// where it begins. Compiled for compute capability 9.0 or later; else they are launched as any other.
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

// What a kernel that is launched in a chain does first.
__device__ inline void wait_for_kernel_before() {
#if __CUDA_ARCH__ >= 900
  cudaTriggerProgrammaticLaunchCompletion();  // the next one may come, and wait
  cudaGridDependencySynchronize();
#endif
}

template <class... Parameters, class... Arguments>
void launch_with(cudaLaunchAttribute* attributes, unsigned count, void (*kernel)(Parameters...), unsigned blocks,
                 unsigned threads, size_t shared_memory, cudaStream_t stream, const Arguments&... arguments) {
  allow_shared_memory(kernel, shared_memory);
  cudaLaunchConfig_t config{};
  config.gridDim = blocks;
  config.blockDim = threads;
  config.dynamicSmemBytes = shared_memory;
  config.stream = stream;
  config.attrs = attributes;
  config.numAttrs = count;
  check(cudaLaunchKernelEx(&config, kernel, Parameters(arguments)...));
}

inline cudaLaunchAttribute overlap_attribute() {
  cudaLaunchAttribute overlap;
  overlap.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  overlap.val.programmaticStreamSerializationAllowed = 1;
  return overlap;
}

// The kernel must call wait_for_kernel_before() first of all.
template <class... Parameters, class... Arguments>
void launch_in_chain(void (*kernel)(Parameters...), unsigned blocks, unsigned threads, size_t shared_memory,
                     cudaStream_t stream, const Arguments&... arguments) {
  if (!waits_for_kernel_before(kernel)) return launch(kernel, blocks, threads, shared_memory, stream, arguments...);
  cudaLaunchAttribute overlap = overlap_attribute();
  launch_with(&overlap, 1, kernel, blocks, threads, shared_memory, stream, arguments...);
}

constexpr unsigned kLargestCluster = 16;

// As launch_together(), for at most kLargestCluster thread blocks, whose barriers take a third of the time; in a chain
// like launch_in_chain(). Of kernels for which waits_for_kernel_before().
template <class... Parameters, class... Arguments>
void launch_as_cluster(void (*kernel)(Parameters...), unsigned blocks, unsigned threads, size_t shared_memory,
                       cudaStream_t stream, const Arguments&... arguments) {
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeNonPortableClusterSizeAllowed, 1));
  cudaLaunchAttribute attributes[2] = {overlap_attribute()};
  attributes[1].id = cudaLaunchAttributeClusterDimension;
  attributes[1].val.clusterDim = {blocks, 1, 1};
  launch_with(attributes, 2, kernel, blocks, threads, shared_memory, stream, arguments...);
}

}  // namespace mpm::cuda
