#pragma once

#include "common/fields.h"
#include "common/host_device.h"
#include "grid/topology.h"

// Particles that a call of many substeps owns, on CUDA. There are two copies of what they keep from step to step, one
// behind the other. P2G after an activation takes them from one to the other, in the order of its items, so that those
// of an item are neighbours in memory until the next activation. Given tensors are the first copy of the first P2G.
namespace mpm {

struct OwnRows {
  int rows = 0;                  // of a copy; 0 where nobody owns the particles
  const Drift* drift = nullptr;  // tells whether there is a new activation; null where there is in any case

  bool is_mostly_idle() const { return drift != nullptr; }
  MPM_HD bool is_due(int64_t particles) const { return !drift || !drift->lasts(particles); }
  // Of a row of either copy.
  MPM_HD int place(int row) const { return row >= rows ? row - rows : row; }
  MPM_HD int in_other_copy(int row, int place) const { return row >= rows ? place : place + rows; }
};

// Of P2G, which moves the particles.
template <class T, int D>
struct Settling : OwnRows {
  bool given = false;                     // whether they are in given tensors
  Field<T> x, mass, volume, residual;     // of both copies, as all fields are; no residual where there is none
  Field<const T> residual_before;         // where they move from
  int* origin = nullptr;                  // the places in the given tensors
  int *copy = nullptr, *index = nullptr;  // which copy the particles are in; their rows, in the order of items
};

// Of G2P, which reads and writes velocities by the place in a copy; or in the given tensors, at the end of the call.
template <class T>
struct GivingBack : OwnRows {
  const int* origin = nullptr;
  int columns = 0;  // of the history
  Field<const T> history;
  Field<T> history_next;
};

}  // namespace mpm
