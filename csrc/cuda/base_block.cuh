#pragma once

#include "common/matrix.h"
#include "cuda/schedule.h"

// Position of a particle in its base block.
namespace mpm::cuda {

template <class T, int D>
__device__ int scene_of(const Topology<T, D>& t, int block) {
  return t.scenes > 1 ? block / t.geometry.blocks_per_scene : 0;
}

// Base node relative to the base block, and the distances from it. False for a particle outside its base block: its
// position is not that of the activation.
template <int Order, class T, int D>
__device__ bool locate_in_block(const Topology<T, D>& t, int scene, int base_block, const Vector<T, D>& x, int* base,
                                T* f) {
  const bool inside = locate<Order>(t.geometry, x.e, base, f);
  int block[D];
#pragma unroll
  for (int i = 0; i < D; i++) {
    block[i] = base[i] / kBlockWidth;
    base[i] %= kBlockWidth;
  }
  return inside && block_index(t.geometry, scene, block) == base_block;
}

// Slot of the block with the base node of a particle, anywhere, -1 where there is none; and the base node relative to
// it, and the distances from that.
template <int Order, class T, int D>
__device__ int locate_slot(const Topology<T, D>& t, int scene, const Vector<T, D>& x, int* base, T* f) {
  if (!locate<Order>(t.geometry, x.e, base, f)) return -1;
  int block[D];
#pragma unroll
  for (int i = 0; i < D; i++) {
    block[i] = base[i] / kBlockWidth;
    base[i] %= kBlockWidth;
  }
  return t.table[block_index(t.geometry, scene, block)];
}

// Coordinates of number i in a cube of a width.
template <int Width, int D>
__device__ void split(int i, int (&at)[D]) {
#pragma unroll
  for (int axis = D - 1; axis >= 0; axis--, i /= Width) at[axis] = i % Width;
}

// The neighbour, in the schedule, with a node that is counted from the first one of a base block.
template <int D>
__device__ int neighbour_with(const int (&node)[D]) {
  int neighbour = 0;
#pragma unroll
  for (int i = D - 1; i >= 0; i--) neighbour |= int(node[i] >= kBlockWidth) << (D - 1 - i);
  return neighbour;
}

// Blocks in the support of a base node, given relative to its own block: a bit for each of the neighbours in the
// schedule.
template <int Order, int D>
__device__ unsigned touched_blocks(const int* base) {
  unsigned touched = 1;
#pragma unroll
  for (int i = D - 1; i >= 0; i--)
    if (base[i] + Order >= kBlockWidth) touched |= touched << (1 << (D - 1 - i));
  return touched;
}

// From a block to the one a block further along the axes of o, as neighbours in the schedule.
template <class T, int D>
__device__ int further(const Geometry<T, D>& g, int o) {
  int way = 0;
#pragma unroll
  for (int i = 0; i < D; i++) way = way * g.blocks[i] + (o >> (D - 1 - i) & 1);
  return way;
}

// Particles of an item or a batch, counted from its first, that are outside their base block; in shared memory.
template <int Most>
struct OutOfBlockList {
  int count;
  uint16_t particle[Most];
};

// Base block of a thread block: its base nodes lie in [first, end), as numbers of type T.
template <class T, int D>
struct BaseBlock {
  int scene;
  T first[D], end[D];

  BaseBlock() = default;
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
  // Cell of x in the block, counted as its base node is, and the distances from that node. False for a particle outside
  // its base block: its position is not that of the activation.
  template <int Order>
  __device__ bool locate(const Geometry<T, D>& g, const Vector<T, D>& x, int& cell, T* f) const {
    bool inside = true;
    T place = T(0);
#pragma unroll
    for (int i = 0; i < D; i++) {  // no early return: each coordinate would wait for the previous one
      const T node = base_node<Order>(g, i, x[i]);
      inside = inside && node >= first[i] && node < end[i];  // false for NaN
      place = place * T(kBlockWidth) + (node - first[i]);
      f[i] = distance_in_cells(g, i, x[i], node);
    }
    cell = inside ? int(place) : kBlockNodes<D>;
    return inside;
  }
};

}  // namespace mpm::cuda
