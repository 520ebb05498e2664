#pragma once

#include "common/safe_root.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Distance of a point from the surface of a box around the origin with the given edge lengths, negative inside, NaN
// where a coordinate is.
template <class T, int D>
MPM_HD T box_distance(const Vector<T, D>& x, const Vector<T, D>& size) {
  T squared = T(0), most = T(0), sum = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T depth = abs(x[i]) - T(0.5) * size[i];  // behind the faces of the axis, negative inside
    const T outside = select(depth > T(0), depth, T(0));
    squared = squared + outside * outside;
    most = i == 0 ? depth : select(depth > most, depth, most);
    sum = sum + depth;
  }
  return select(sum == sum, safe_root(squared) + select(most < T(0), most, T(0)), sum);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
