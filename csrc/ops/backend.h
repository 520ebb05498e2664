#pragma once

// csrc/ops is compiled into the CPU and into the CUDA library, each time with the launchers of that backend.
#include "ops/tensors.h"

#define MPM_JOIN_(a, b) a##b
#define MPM_JOIN(a, b) MPM_JOIN_(a, b)
#define MPM_BACKEND_IS_cpu 1
#define MPM_BACKEND_IS_cuda 2
#define MPM_BACKEND MPM_JOIN(MPM_BACKEND_IS_, TORCH_MPM_BACKEND)

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "cpu/launchers.h"
#define MPM_DISPATCH_KEY CPU
namespace mpm {
namespace backend = cpu;
// Nothing to guard on the CPU; gives the launchers' stream argument.
struct DeviceScope {
  explicit DeviceScope(const Tensor&) {}
  cpu::Stream stream() const { return {}; }
};
}  // namespace mpm
#else
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>

#include "cuda/launchers.h"
#define MPM_DISPATCH_KEY CUDA
namespace mpm {
namespace backend = cuda;
// Makes the tensor's device current and gives torch's current stream of that device.
struct DeviceScope {
  explicit DeviceScope(const Tensor& t) : guard(t.get_device_index()) {
    void* current = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(t.get_device_index(), &current));
    stream_ = static_cast<cudaStream_t>(current);
  }
  cudaStream_t stream() const { return stream_; }

 private:
  torch::stable::accelerator::DeviceGuard guard;
  cudaStream_t stream_ = nullptr;
};
}  // namespace mpm
#endif

// Registers the kernels of a file for its backend.
#define MPM_LIBRARY_IMPL(m) STABLE_TORCH_LIBRARY_IMPL(torch_mpm, MPM_DISPATCH_KEY, m)
