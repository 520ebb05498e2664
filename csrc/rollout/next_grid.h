#pragma once

#include "grid/fixed_point.h"
#include "grid/grid_update.h"
#include "grid/obstacle.h"
#include "grid/topology.h"

namespace mpm {

// The pass over the nodes between P2G and G2P of a call of many steps, on CUDA: grid update and contact in one. Rows of
// unused slots are left as they are, nodes are made ready for the next P2G, and the drift for the next G2P to count.
template <class T, int D>
struct NextGridArguments {
  GridUpdateArguments<T, D> update;
  FixedPoint fixed;     // of its nodes
  int near_blocks = 0;  // slots of the pool without the margin; of either those in use come first
  bool obstacles = false;
  ContactArguments<T, D> contact;    // its nodes unused
  NodeRow<T, D>* emptied = nullptr;  // the nodes, which become zero; null where mirrors read those of others
  const Drift* drift = nullptr;
  Drift* next_drift = nullptr;
  Drift* watched = nullptr;    // told of nodes that go so far that particles may leave the active blocks; or null
  int* items_taken = nullptr;  // which becomes zero; or null
  int64_t particles = 0;
};

}  // namespace mpm
