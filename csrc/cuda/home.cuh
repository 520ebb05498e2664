#pragma once

#include <climits>
#include <stdexcept>

#include "cuda/schedule.h"

// What the transfer kernels share: particle fields as columns, and where a particle lies in its home block.
namespace mpm::cuda {

// The N entries of a particle field as separate pointers, so that an address is one addition away from the particle.
template <class T, int N>
struct Columns {
  T* pointer[N] = {};
  int stride = 0;

  Columns() = default;
  explicit Columns(const Field<T>& f, int inner = 1) {
    if (!f.pointer) return;
    if (f.stride[0] > INT_MAX) throw std::runtime_error("CUDA: particles must be less than 2^31 elements apart");
    stride = int(f.stride[0]);
    for (int k = 0; k < N; k++) pointer[k] = f.pointer + k / inner * f.stride[1] + k % inner * f.stride[2];
  }
  __device__ bool present() const { return pointer[0] != nullptr; }
  __device__ T& at(int p, int k = 0) const { return pointer[k][int64_t(p) * stride]; }
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

template <class T, int D>
__device__ int scene_of(const Topology<T, D>& t, int block) {
  return t.scenes > 1 ? block / t.geometry.blocks_per_scene : 0;
}

// Base node relative to the home block, and the distances from it. False for a particle that is not at home: its
// position is not the one that was activated.
template <int Order, class T, int D>
__device__ bool locate_at_home(const Topology<T, D>& t, int scene, int home, const Vector<T, D>& x, int* base, T* f) {
  const bool inside = locate<Order>(t.geometry, x.e, base, f);
  int block[D];
#pragma unroll
  for (int i = 0; i < D; i++) {
    block[i] = base[i] / kBlockWidth;
    base[i] %= kBlockWidth;
  }
  return inside && block_index(t.geometry, scene, block) == home;
}

// Channels from `first` on of a particle field [P, K, ...].
template <class T>
Field<T> channels_from(Field<T> f, int first) {
  if (f.pointer) f.pointer += first * f.stride[1];
  return f;
}

}  // namespace mpm::cuda
