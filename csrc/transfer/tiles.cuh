#pragma once

#include "cuda/schedule.h"
#include "transfer/tiles.h"

// The tiles that have a node.
namespace mpm::cuda {

// Calls f(slot, before) for the base blocks with particles that may reach a block of a scene, itself among them; before
// has the bits of the axes along which they lie before it, that of axis i is D - 1 - i.
template <class T, int D, class F>
__device__ void for_base_blocks(const Topology<T, D>& t, int scene, const int (&block)[D], const F& f) {
#pragma unroll
  for (int before = 0; before < 1 << D; before++) {
    int base[D];
    bool exists = true;
#pragma unroll
    for (int axis = 0; axis < D; axis++) {
      base[axis] = block[axis] - (before >> (D - 1 - axis) & 1);
      exists = exists && base[axis] >= 0;
    }
    const int slot = exists ? t.table[block_index(t.geometry, scene, base)] : -1;
    if (slot >= 0 && t.offsets[slot + 1] > t.offsets[slot]) f(slot, before);
  }
}

// Number of the row of a tile, along the last axis, that has a row of nodes of a block; -1 where it has none.
template <int Width, int D>
__device__ int row_of_tile(const int (&node)[D], int before) {
  int row = 0;
  bool has = true;
#pragma unroll
  for (int axis = 0; axis < D - 1; axis++) {
    const int at = node[axis] + (before >> (D - 1 - axis) & 1) * kBlockWidth;
    has = has && at < Width;
    row = row * Width + at;
  }
  return has ? row : -1;
}

}  // namespace mpm::cuda
