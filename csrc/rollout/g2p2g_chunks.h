#pragma once

#include "grid/grid_update.h"
#include "heat/transfer.h"
#include "rollout/laws_p2g.h"
#include "transfer/advance.h"

// G2P of a substep and laws and P2G of the next one in one pass over the particles, on the CPU, while an activation
// lasts (G2P2G: Wang et al. 2020, "A massively parallel and scalable multi-GPU material point method"). Velocities and
// affine fields stay in the caches; the particles of a chunk stay in place, consecutive in memory.
namespace mpm {

template <class T, int D>
struct G2P2GChunksArguments {
  G2PAdvanceArguments<T, D> advance;  // x, F and J in place, with unit strides; v and C are written in the last pass
  LawsP2GArguments<T, D> to_nodes;    // at the new positions; without a reorder
  const NodeRow<T, D>* velocities = nullptr;  // node velocities of the previous substep
  NodeRow<T, D>* sums = nullptr;              // node sums of the next one
  bool follows = false;                       // whether laws and P2G follow
  bool fresh = false;                         // whether this is the first pass since the activation
  // With heat, whose node temperatures lie between: G2P of the velocities is in HeatG2PChunksArguments, and v and C are
  // its results. G2P of heat, in place; absent without heat.
  const HeatToParticlesArguments<T, D>* heat = nullptr;
  Field<T> volume_next{};  // present volumes at the end of the step
};

// G2P of the velocities, and P2G of heat, at the same positions.
template <class T, int D>
struct HeatG2PChunksArguments {
  G2PAdvanceArguments<T, D> advance;  // writes v and C alone
  const NodeRow<T, D>* velocities = nullptr;
  HeatToNodesArguments<T, D> to_nodes;
};

// Longest displacement of a node along an axis in the time step of its scene, as a multiple of dt; infinite if a
// velocity is not finite.
template <class T, int D>
struct LongestMoveArguments {
  const NodeRow<T, D>* nodes = nullptr;  // with velocities
  const int* block = nullptr;            // of each slot
  int64_t slots = 0, blocks_per_scene = 1;
  const T* scene_dt = nullptr;  // [scenes], or null
  T* longest = nullptr;
};

}  // namespace mpm
