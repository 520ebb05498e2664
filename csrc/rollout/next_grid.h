#pragma once

#include "grid/fixed_point.h"
#include "grid/grid_update.h"
#include "grid/obstacle.h"
#include "grid/topology.h"

namespace mpm {

// The pass over the nodes between P2G and G2P of a call of many steps, on CUDA: grid update and contact in one. Rows of
// unused slots are unchanged; the nodes of the next P2G and the counters of the next G2P are cleared.
template <class T, int D>
struct NextGridArguments {
  GridUpdateArguments<T, D> update;
  FixedPoint fixed;     // of its nodes
  int near_blocks = 0;  // slots of the pool without the margin; the used ones of each part come first
  bool obstacles = false;
  ContactArguments<T, D> contact;    // without its nodes
  NodeRow<T, D>* emptied = nullptr;  // nodes to clear; null if mirrors read the nodes of other blocks
  const Displacement* displacement = nullptr;
  Displacement* next_displacement = nullptr;
  Displacement* watched = nullptr;  // kLost if nodes move so far that particles may leave the active blocks; or null
  int* items_taken = nullptr;       // counter to clear; or null
  int64_t particles = 0;
  int out_of_block_cost = kOutOfBlockCost;
};

}  // namespace mpm
