#pragma once

#include <climits>
#include <stdexcept>
#include <type_traits>

#include "common/fields.h"
#include "common/matrix.h"

// Particle fields in the form of the transfer kernels.
namespace mpm::cuda {

// The N entries of a particle field as separate pointers, so that an address is one multiply-add away from the
// particle.
template <class T, int N>
struct Columns {
  using Byte = std::conditional_t<std::is_const_v<T>, const char, char>;
  T* pointer[N] = {};
  int stride = 0;  // bytes

  Columns() = default;
  explicit Columns(const Field<T>& f, int inner = 1) {
    if (!f.pointer) return;
    const int64_t bytes = f.stride[0] * int64_t(sizeof(T));
    if (bytes > INT_MAX) throw std::runtime_error("CUDA: particles must be less than 2^31 bytes apart");
    stride = int(bytes);
    for (int k = 0; k < N; k++) pointer[k] = f.pointer + k / inner * f.stride[1] + k % inner * f.stride[2];
  }
  __device__ bool present() const { return pointer[0] != nullptr; }
  __device__ T& at(int p, int k = 0) const {
    return *reinterpret_cast<T*>(reinterpret_cast<Byte*>(pointer[k]) + int64_t(p) * stride);
  }
  template <class U>
  __device__ void write(int p, int k, const U& value) const {
    if (present()) at(p, k) = value;
  }
};

template <class T, int D>
__device__ Vector<T, D> read_vector(const Columns<const T, D>& c, int p) {
  Vector<T, D> v;
#pragma unroll
  for (int i = 0; i < D; i++) v[i] = c.at(p, i);
  return v;
}

// Channels from `first` on of a particle field [P, K, ...].
template <class T>
Field<T> channels_from(Field<T> f, int first) {
  if (f.pointer) f.pointer += first * f.stride[1];
  return f;
}

// Launches a kernel for all channels: run.operator()<K, Gradient>(first) for K channels from `first` on, D at a time
// while there are as many, then one by one; or all at once where there are AtOnce of them, without gradients.
template <int D, int AtOnce = D, class Run>
void for_channels(int channels, bool gradient, const Run& run) {
  const auto group = [&]<int K>(int first) {
    if (gradient)
      run.template operator()<K, true>(first);
    else
      run.template operator()<K, false>(first);
  };
  if (channels == AtOnce && !gradient) return run.template operator()<AtOnce, false>(0);
  int first = 0;
  for (; first + D <= channels; first += D) group.template operator()<D>(first);
  for (; first < channels; first++) group.template operator()<1>(first);
}

}  // namespace mpm::cuda
