#pragma once

#include <climits>
#include <stdexcept>
#include <type_traits>

#include "cuda/schedule.h"

// What the transfer kernels share: particle fields as columns, and where a particle lies in its home block.
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

// The home block of a thread block: its base nodes lie in [first, end), as numbers of type T.
template <class T, int D>
struct Home {
  int scene;
  T first[D], end[D];

  Home() = default;
  template <int Order>
  __device__ void set(const Topology<T, D>& t, int block) {
    int coordinates[D];
    scene = block_coordinates(t.geometry, block, coordinates);
#pragma unroll
    for (int i = 0; i < D; i++) {
      first[i] = T(coordinates[i] * kBlockWidth);
      end[i] = min(first[i] + T(kBlockWidth), T(t.geometry.blocks[i] * kBlockWidth - Order));
    }
  }
  // Cell of x in the block, counted as its base node is, and the distances from that node. False for a particle that is
  // not at home: its position is not the one that was activated.
  template <int Order>
  __device__ bool locate(const Geometry<T, D>& g, const Vector<T, D>& x, int& cell, T* f) const {
    bool inside = true;
    T place = T(0);
#pragma unroll
    for (int i = 0; i < D; i++) {  // no early return: it would make each coordinate wait for the one before
      const T node = base_node<Order>(g, i, x[i]);
      inside = inside && node >= first[i] && node < end[i];  // false for NaN
      place = place * T(kBlockWidth) + (node - first[i]);
      f[i] = distance_in_cells(g, i, x[i], node);
    }
    cell = inside ? int(place) : kBlockNodes<D>;
    return inside;
  }
};

// Channels from `first` on of a particle field [P, K, ...].
template <class T>
Field<T> channels_from(Field<T> f, int first) {
  if (f.pointer) f.pointer += first * f.stride[1];
  return f;
}

// Launches a kernel for all channels: run.operator()<K, Gradient>(first) for K channels from `first` on, D at a time
// while there are as many, then one by one.
template <int D, class Run>
void for_channels(int channels, bool gradient, const Run& run) {
  const auto group = [&]<int K>(int first) {
    if (gradient)
      run.template operator()<K, true>(first);
    else
      run.template operator()<K, false>(first);
  };
  int first = 0;
  for (; first + D <= channels; first += D) group.template operator()<D>(first);
  for (; first < channels; first++) group.template operator()<1>(first);
}

}  // namespace mpm::cuda
