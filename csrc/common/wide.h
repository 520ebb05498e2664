#pragma once

#include "common/matrix.h"
#include "common/roots.h"

// Float64 for the small differences of float32 arguments, and conversions between the two; float64 is unchanged.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T>
struct WideOf {
  using type = double;
};
#ifndef __CUDACC__
template <class T, int N>
struct WideOf<Pack<T, N>> {
  using type = Pack<double, N>;
};
#endif
template <class T>
using Wide = typename WideOf<T>::type;

template <class T>
using MaskOf = decltype(T(0) < T(0));

template <class To>
MPM_HD To convert(float x) {
  return To(x);
}
template <class To>
MPM_HD To convert(double x) {
  return To(x);
}
template <class To>
MPM_HD To convert(bool mask) {
  return mask;
}

#ifndef __CUDACC__
template <class To, class T, int N>
MPM_HD To convert(const Pack<T, N>& x) {
  T lanes[N];
  To r;
  decltype(r[0]) converted[N];
  x.store(lanes);
  for (int i = 0; i < N; i++) converted[i] = lanes[i];
  return To::load(converted);
}
// To a mask of packs of another type.
template <class To, class T, int N>
MPM_HD To convert(const Mask<T, N>& mask) {
  To r;
  constexpr int width = sizeof(r.part[0]) / sizeof(r.part[0][0]);
  for (int i = 0; i < N; i++) r.part[i / width][i % width] = mask[i] ? -1 : 0;
  return r;
}
#endif

template <class To, class T, int D>
MPM_HD Vector<To, D> convert(const Vector<T, D>& a) {
  Vector<To, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = convert<To>(a[i]);
  return r;
}

template <class To, class T, int D>
MPM_HD Matrix<To, D> convert(const Matrix<T, D>& a) {
  Matrix<To, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = convert<To>(a[i][j]);
  return r;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
