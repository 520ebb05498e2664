#pragma once

#include "common/fields.h"
#include "common/host_device.h"
#include "grid/topology.h"

// Particles owned by a call of many substeps, on CUDA. Two copies of their fields are stored, one behind the other. P2G
// after an activation moves them from one to the other, in the order of its items, so that those of an item are
// neighbours in memory until the next activation. Given tensors are the first copy of the first P2G.
namespace mpm {

struct OwnRows {
  int rows = 0;                                // rows of a copy; 0 without owned particles
  const Displacement* displacement = nullptr;  // states whether there is a new activation; null where there always is

  bool is_mostly_idle() const { return displacement != nullptr; }
  MPM_HD bool is_due(int64_t particles) const { return !displacement || !displacement->lasts(particles); }
  // For a row of either copy.
  MPM_HD int place(int row) const { return row >= rows ? row - rows : row; }
  MPM_HD int in_other_copy(int row, int place) const { return row >= rows ? place : place + rows; }
};

// For P2G, which moves the particles.
template <class T, int D>
struct ReorderOnScatter : OwnRows {
  bool given = false;                     // whether they are in given tensors
  Field<T> x, mass, volume, residual;     // of both copies, as all fields are; no residual where there is none
  Field<const T> residual_before;         // source
  int* origin = nullptr;                  // their places in the given tensors
  int *copy = nullptr, *index = nullptr;  // the copy with the particles; their rows, in the order of items
};

// For G2P, which reads and writes velocities by the place in a copy; or in the given tensors, at the end of the call.
template <class T>
struct RestoreOrder : OwnRows {
  const int* origin = nullptr;
  int columns = 0;  // for the history
  Field<const T> history;
  Field<T> history_next;
};

}  // namespace mpm
