#pragma once

// Files *.op.cpp are compiled into the CPU and into the CUDA library, each time for that backend.
#include "common/tensors.h"

#define MPM_JOIN_(a, b) a##b
#define MPM_JOIN(a, b) MPM_JOIN_(a, b)
#define MPM_BACKEND_IS_cpu 1
#define MPM_BACKEND_IS_cuda 2
#define MPM_BACKEND MPM_JOIN(MPM_BACKEND_IS_, TORCH_MPM_BACKEND)

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "cpu/isa.h"
#include "cpu/parallel.h"
#define MPM_DISPATCH_KEY CPU
namespace mpm {
namespace cpu {
struct Stream {
  operator void*() const { return nullptr; }
};
inline void clear(Tensor& t, Stream) { mpm::clear(t); }
}  // namespace cpu
namespace backend = cpu;
// Excludes other threads from short work, by the rows of a tensor; returns the stream argument of the kernels.
class DeviceScope {
 public:
  explicit DeviceScope(const Tensor& t) : alone_(t.dim() > 0 && t.size(0) < kFew) {}
  cpu::Stream stream() const { return {}; }

 private:
  static constexpr int64_t kFew = 2048;  // number of rows that loops process in about ten microseconds
  cpu::Alone alone_;
};
}  // namespace mpm
#else
#include <cuda_runtime_api.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>

#define MPM_DISPATCH_KEY CUDA
namespace mpm {
namespace cuda {
using Stream = cudaStream_t;
}  // namespace cuda
namespace backend = cuda;
// Makes the tensor's device current and returns torch's current stream of that device.
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
namespace cuda {
inline void clear(Tensor& t, Stream stream) {
  const size_t bytes = size_t(t.numel()) * size_t(t.element_size());
  STD_TORCH_CHECK(cudaMemsetAsync(t.data_ptr(), 0, bytes, stream) == cudaSuccess, "memory could not be cleared");
}
}  // namespace cuda
}  // namespace mpm
#endif

// MPM_BACKEND_KERNELS(LIST) makes the kernels of a family callable as backend::name(arguments, stream), or
// backend::name(order, arguments, stream). LIST(PLAIN, ORDERED, SIZE) names them with their arguments: kernels, kernels
// with the order of the B-spline as a template parameter, and functions that return the bytes of a work space. On the
// CPU a call selects the best compiled instruction set that the machine supports.
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#define MPM_DECLARE_PLAIN(name, Arguments) \
  template <class T, int D>                \
  void name(const Arguments<T, D>&);
#define MPM_DECLARE_ORDERED(name, Arguments) \
  template <int Order, class T, int D>       \
  void name(const Arguments<T, D>&);
#define MPM_DECLARE_SIZE(name, Arguments) \
  template <class T, int D>               \
  int64_t name(const Arguments<T, D>&);
#define MPM_CALL_PLAIN(name, Arguments)         \
  template <class T, int D>                     \
  void name(const Arguments<T, D>& a, Stream) { \
    MPM_CPU_CALL_BEST(name<T, D>(a));           \
  }
#define MPM_CALL_ORDER(name, Arguments)         \
  template <int Order, class T, int D>          \
  void name(const Arguments<T, D>& a, Stream) { \
    MPM_CPU_CALL_BEST(name<Order, T, D>(a));    \
  }
#define MPM_CALL_SIZE(name, Arguments)             \
  template <class T, int D>                        \
  int64_t name(const Arguments<T, D>& a, Stream) { \
    MPM_CPU_CALL_BEST(name<T, D>(a));              \
  }
#define MPM_BACKEND_KERNELS(LIST)                                                        \
  namespace mpm::cpu {                                                                   \
  MPM_CPU_DECLARE_LEVELS(LIST(MPM_DECLARE_PLAIN, MPM_DECLARE_ORDERED, MPM_DECLARE_SIZE)) \
  LIST(MPM_CALL_PLAIN, MPM_CALL_ORDER, MPM_CALL_SIZE)                                    \
  LIST(MPM_IGNORE, MPM_CHOOSE_ORDER, MPM_IGNORE)                                         \
  }
#else
#define MPM_DECLARE_PLAIN(name, Arguments) \
  template <class T, int D>                \
  void name(const Arguments<T, D>&, Stream);
#define MPM_DECLARE_ORDERED(name, Arguments) \
  template <int Order, class T, int D>       \
  void name(const Arguments<T, D>&, Stream);
#define MPM_DECLARE_SIZE(name, Arguments)          \
  template <class T, int D>                        \
  int64_t name(const Arguments<T, D>&);            \
  template <class T, int D>                        \
  int64_t name(const Arguments<T, D>& a, Stream) { \
    return name(a);                                \
  }
#define MPM_BACKEND_KERNELS(LIST)                                \
  namespace mpm::cuda {                                          \
  LIST(MPM_DECLARE_PLAIN, MPM_DECLARE_ORDERED, MPM_DECLARE_SIZE) \
  LIST(MPM_IGNORE, MPM_CHOOSE_ORDER, MPM_IGNORE)                 \
  }
#endif
#define MPM_IGNORE(name, Arguments)
#define MPM_CHOOSE_ORDER(name, Arguments)                             \
  template <class T, int D>                                           \
  void name(int64_t order, const Arguments<T, D>& a, Stream stream) { \
    order == 2 ? name<2, T, D>(a, stream) : name<3, T, D>(a, stream); \
  }

// Registers the kernels of a file for its backend.
#define MPM_LIBRARY_IMPL(m) STABLE_TORCH_LIBRARY_IMPL(torch_mpm, MPM_DISPATCH_KEY, m)
