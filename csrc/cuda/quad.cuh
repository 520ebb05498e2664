#pragma once

namespace mpm::cuda {

// Four values in one memory access: four channels of a node, or a row of nodes of a block.
template <class T>
struct alignas(16) Quad {
  T e[4];
};

template <class T>
__device__ Quad<T> load_quad(const T* p) {
  return *reinterpret_cast<const Quad<T>*>(p);
}
template <class T>
__device__ void store_quad(T* p, const Quad<T>& q) {
  *reinterpret_cast<Quad<T>*>(p) = q;
}

}  // namespace mpm::cuda
