#pragma once

#include "common/fields.h"
#include "grid/topology.h"

namespace mpm {

// The particles by base block, and within a block (or a part of a crowded one) by the cell of their base node,
// otherwise in the order of the index tensor.
template <class T, int D>
struct CellOrderArguments {
  Topology<T, D> topology;
  Field<const T> x;
  int* order = nullptr;  // [P], those outside the grid last
};

}  // namespace mpm
