#pragma once

#include "common/tensors.h"

// Memory that is laid out piece by piece.
namespace mpm {

// Consecutive pieces of one tensor of bytes; without a tensor the bytes are only counted.
class Arena {
 public:
  Arena() = default;
  explicit Arena(const Tensor& memory) : start_(static_cast<char*>(memory.data_ptr())) {}

  template <class T>
  T* take(int64_t count) {
    char* const p = start_ ? start_ + size_ : nullptr;
    size_ += (count * int64_t(sizeof(T)) + kAlignment - 1) / kAlignment * kAlignment;
    return reinterpret_cast<T*>(p);
  }

  // A contiguous tensor, which must not outlive the memory; undefined while bytes are counted.
  template <class T>
  Tensor tensor(const Tensor& like, const Shape& shape, ScalarType type) {
    int64_t count = 1;
    for (int64_t size : shape) count *= size;
    T* const data = take<T>(count);
    if (!data) return {};
    Shape strides(shape.size(), 1);
    for (size_t i = shape.size(); i-- > 1;) strides[i - 1] = strides[i] * shape[i];
    return torch::stable::from_blob(data, shape, strides, like.device(), type);
  }

  void skip(int64_t bytes) { size_ += bytes; }
  int64_t size() const { return size_; }

 private:
  static constexpr int64_t kAlignment = 256;
  char* start_ = nullptr;
  int64_t size_ = 0;
};

}  // namespace mpm
