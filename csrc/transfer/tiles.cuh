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

constexpr int kTileThreads = 256;

// Calls f(scene, block, node, row of the node) for a row of nodes along the last axis, number i of all slots, where its
// block is one of the scenes.
template <class T, int D, class F>
__device__ void at_row_of_nodes(const Topology<T, D>& t, int i, const F& f) {
  constexpr int rows = kBlockNodes<D> / kBlockWidth;
  const int slot = i / rows;
  if (slot >= t.max_blocks || t.block[slot] < 0) return;
  int block[D], node[D] = {};
  const int scene = block_coordinates(t.geometry, t.block[slot], block);
  if (scene >= t.scenes) return;
#pragma unroll
  for (int axis = D - 2, rest = i % rows; axis >= 0; axis--, rest /= kBlockWidth) node[axis] = rest % kBlockWidth;
  f(scene, block, node, int64_t(i) * kBlockWidth);
}

// Thread blocks of kTileThreads for `each` threads to a row of nodes.
template <class T, int D>
unsigned blocks_for_rows(const Topology<T, D>& t, int each) {
  const int64_t threads = int64_t(t.max_blocks) * (kBlockNodes<D> / kBlockWidth) * each;
  return unsigned((threads + kTileThreads - 1) / kTileThreads);
}

}  // namespace mpm::cuda
