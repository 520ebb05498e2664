#pragma once

#include "common/matrix.h"
#include "grid/geometry.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Lattice index along an axis of a node of the block whose first node has the indices `corner`, the last axis fastest.
template <int D>
MPM_HD int lattice_index(const int corner[D], int axis, int local) {
  return corner[axis] + ((local >> 2 * (D - 1 - axis)) & (kBlockWidth - 1));  // kBlockWidth is 4
}

template <int D>
MPM_HD Vector<int, D> lattice_node(const int corner[D], int local) {
  Vector<int, D> node;
  MPM_UNROLL for (int i = 0; i < D; i++)
    node[i] = lattice_index<D>(corner, i, local);
  return node;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
