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
  bool follows = false;               // laws and P2G
  bool affine = false;                // whether P2G uses the affine fields
  bool fresh = false;                 // whether this is the first pass since the activation
  uint16_t* order = nullptr;          // [particles + 8] of each chunk, its particles by cell, strays last
  uint16_t* cell_end = nullptr;       // [chunks, kBlockNodes] as in the schedule
};

// The largest component of the velocities of some nodes; not finite if one is not.
template <class T, int D>
struct LargestSpeedArguments {
  const NodeRow<T, D>* nodes = nullptr;
  int64_t count = 0;
  T* largest = nullptr;
};

}  // namespace mpm
