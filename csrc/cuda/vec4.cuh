#pragma once

namespace mpm::cuda {

// Four values in one memory access: four channels of a node, or a row of nodes of a block.
template <class T>
struct alignas(16) Vec4 {
  T e[4];
};

template <class T>
__device__ Vec4<T> load_vec4(const T* p) {
  return *reinterpret_cast<const Vec4<T>*>(p);
}
template <class T>
__device__ void store_vec4(T* p, const Vec4<T>& q) {
  *reinterpret_cast<Vec4<T>*>(p) = q;
}
template <class T>
__device__ void operator+=(Vec4<T>& a, const Vec4<T>& b) {
#pragma unroll
  for (int e = 0; e < 4; e++) a.e[e] += b.e[e];
}
template <class T>
__device__ bool is_zero(const Vec4<T>& v) {
  return v.e[0] == T(0) && v.e[1] == T(0) && v.e[2] == T(0) && v.e[3] == T(0);
}

}  // namespace mpm::cuda
