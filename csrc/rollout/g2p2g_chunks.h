#pragma once

#include "grid/grid_update.h"
#include "rollout/laws_p2g.h"
#include "transfer/advance.h"

// G2P of a substep and laws and P2G of the next one in one pass over the particles, on the CPU, while an activation
// lasts (G2P2G: Wang et al. 2020, "A massively parallel and scalable multi-GPU material point method"). Velocities and
// affine fields stay in the caches, and the particles of a chunk where they are in memory, one after another.
namespace mpm {

template <class T, int D>
struct G2P2GChunksArguments {
  G2PAdvanceArguments<T, D> advance;  // x, F and J in place, with unit strides; v and C are written if nothing follows
  LawsP2GArguments<T, D> to_nodes;    // of the positions that G2P has found; rearranges nothing
  const NodeRow<T, D>* velocities = nullptr;  // rows of the pool before
  NodeRow<T, D>* sums = nullptr;              // and after
  bool follows = false;                       // laws and P2G
  bool fresh = false;  // whether this is the first pass since the activation, which has left particles in order
};

// The longest way along an axis that nodes go in the time step of their scene, as a multiple of dt; infinite if one is
// not finite.
template <class T, int D>
struct LongestMoveArguments {
  const NodeRow<T, D>* nodes = nullptr;  // with velocities
  const int* block = nullptr;            // of each slot
  int64_t slots = 0, blocks_per_scene = 1;
  const T* scene_dt = nullptr;  // [scenes], or null
  T* longest = nullptr;
};

}  // namespace mpm
