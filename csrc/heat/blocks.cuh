#pragma once

#include "grid/topology.h"

// Work at the nodes and slots of the blocks of the scenes, for loops with a thread each.
namespace mpm::cuda {

// The scene of a slot, -1 where it has no block of the scenes; and the first node of the block.
template <class T, int D>
MPM_HD int scene_of_slot(const Topology<T, D>& t, int64_t slot, int (&corner)[D]) {
  const int block = t.block[slot];
  if (block < 0) return -1;
  const int scene = block_coordinates(t.geometry, block, corner);
  MPM_UNROLL for (int i = 0; i < D; i++)
    corner[i] *= kBlockWidth;
  return scene < t.scenes ? scene : -1;
}

template <class T, int D>
MPM_HD int64_t nodes_of(const Topology<T, D>& t) {
  return int64_t(t.max_blocks) * kBlockNodes<D>;
}

// Calls work(a, scene, i) at a node of a block of the scenes.
template <auto work, class T, int D, class Arguments>
MPM_HD void at_node(const Topology<T, D>& t, const Arguments& a, int64_t i) {
  int corner[D];
  const int scene = scene_of_slot(t, i / kBlockNodes<D>, corner);
  if (scene >= 0) work(a, scene, i);
}

// Calls work(a, scene, corner, slot) for the block of a slot.
template <auto work, class T, int D, class Arguments>
MPM_HD void at_slot(const Topology<T, D>& t, const Arguments& a, int64_t slot) {
  int corner[D];
  const int scene = scene_of_slot(t, slot, corner);
  if (scene >= 0) work(a, scene, corner, slot);
}

}  // namespace mpm::cuda
