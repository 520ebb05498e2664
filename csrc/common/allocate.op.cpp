#include <cstring>

#include "common/backend.h"

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "cpu/memory_cache.h"
#include "cpu/parallel.h"
#endif

namespace mpm {
namespace {

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
// Bytes of an element of a type that the memory cache supports, otherwise 0.
int64_t element_size(ScalarType type) {
  switch (type) {
    case ScalarType::Double:
    case ScalarType::Long:
      return 8;
    case ScalarType::Float:
    case ScalarType::Int:
      return 4;
    case ScalarType::Half:
    case ScalarType::BFloat16:
    case ScalarType::Short:
      return 2;
    case ScalarType::Byte:
    case ScalarType::Char:
    case ScalarType::Bool:
      return 1;
    default:
      return 0;
  }
}

// Tensor in memory of the cache; undefined where the tensor is small or the system has no memory.
Tensor empty_from_cache(const Tensor& like, const Shape& shape, const Shape& strides, ScalarType type) {
  int64_t last = 0;
  for (size_t i = 0; i < shape.size(); i++) {
    if (shape[i] == 0) return absent();
    last += (shape[i] - 1) * strides[i];
  }
  const int64_t bytes = (last + 1) * element_size(type);  // zero for other types
  cpu::Buffer* buffer = bytes < cpu::kLeastCached ? nullptr : cpu::take(bytes);
  if (!buffer) return absent();
  return torch::stable::from_blob(buffer->data, shape, strides, like.device(), type,
                                  [buffer](void*) { cpu::give_back(buffer); });
}
#endif

[[noreturn]] void fail_to_allocate(const Shape& shape) {
  STD_TORCH_CHECK(false, "a result of shape ", text(shape), " could not be allocated");
}

// Refuses sizes whose products below would overflow, or that exceed any memory.
void check_allocatable(const Shape& shape) {
  constexpr int64_t most = int64_t(1) << 48;
  int64_t count = 1;
  for (int64_t size : shape) {
    if (size < 0 || size > most / count) fail_to_allocate(shape);
    count *= size > 1 ? size : 1;
  }
}

}  // namespace

Tensor empty_strided(const Tensor& like, const Shape& shape, const Shape& strides, ScalarType type) {
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
  if (Tensor cached = empty_from_cache(like, shape, strides, type); cached.defined()) return cached;
#endif
  AtenTensorHandle handle;
  int32_t device;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_device_type(like.get(), &device));
  const int32_t dtype = torch::stable::detail::to<int32_t>(torch::stable::detail::from(type));
  if (aoti_torch_empty_strided(int64_t(shape.size()), shape.data(), strides.data(), dtype, device,
                               like.get_device_index(), &handle) != AOTI_TORCH_SUCCESS)
    fail_to_allocate(shape);
  return Tensor(handle);
}

Tensor empty(const Tensor& like, const Shape& shape, ScalarType type) {
  check_allocatable(shape);
  Shape strides(shape.size());
  int64_t next = 1;
  for (size_t i = shape.size(); i-- > 0; next *= shape[i]) strides[i] = next;
  return empty_strided(like, shape, strides, type);
}

Tensor empty(const Tensor& like, const Shape& shape) { return empty(like, shape, like.scalar_type()); }

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
void clear_memory(void* memory, int64_t bytes) {
  constexpr int64_t grain = 1 << 18;  // bytes below which clearing on one thread is faster
  cpu::parallel_for(
      bytes, grain,
      [](void* data, int64_t begin, int64_t end) {
        std::memset(static_cast<char*>(data) + begin, 0, size_t(end - begin));
      },
      memory);
}
#endif

void clear(Tensor& t) {
  if (t.numel() == 0) return;
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
  clear_memory(t.data_ptr(), t.numel() * int64_t(t.element_size()));
#else
  torch::stable::zero_(t);
#endif
}

Tensor zeros(const Tensor& like, const Shape& shape) {
  Tensor t = empty(like, shape);
  clear(t);
  return t;
}

Tensor empty_particles(const Tensor& like, const Shape& shape) {
  check_allocatable(shape);
  Shape strides(shape.size());
  strides[0] = 1;
  int64_t next = shape.size() > 1 ? particle_pitch(like, shape[0]) : 0;
  for (size_t i = shape.size() - 1; i > 0; i--) {
    strides[i] = next;
    next *= shape[i];
  }
  return empty_strided(like, shape, strides, like.scalar_type());
}

}  // namespace mpm
