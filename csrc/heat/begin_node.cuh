#pragma once

#include "heat/blocks.cuh"
#include "heat/local.h"

// The averages and the boundaries of a node, before the solve.
namespace mpm::cuda {

// Clears entry i of `count`, and those that follow it by multiples of that.
template <class T>
MPM_HD void clear(const HeatCleared<T>& cleared, int64_t i, int64_t count) {
  for (; i < cleared.size; i += count) cleared.memory[i] = T(0);
}

template <class T, int D>
MPM_HD void begin_node(const HeatNodesArguments<T, D>& a, int64_t i) {
  heat_mean(a.means, i);
  if (i < nodes_of(a.topology)) at_node<heat_boundaries<T, D>>(a.topology, a, i);
  clear(a.means.cleared, i, a.means.nodes);
}

}  // namespace mpm::cuda
