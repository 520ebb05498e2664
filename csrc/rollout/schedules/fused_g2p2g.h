#pragma once

#include "transfer/advance.h"
#include "transfer/arguments.h"

// G2P of a substep and P2G of the next one in one kernel, on CUDA, while an activation lasts (G2P2G: Wang et al. 2020,
// "A massively parallel and scalable multi-GPU material point method"). Velocities and affine fields of particles, half
// of the memory traffic of a substep, stay in registers.
namespace mpm {

// P2G updates F or J of the particles, which the call owns, in place. G2P reads the nodes of `advance`, P2G adds to
// those of `p2g`.
template <class T, int D>
struct G2P2GArguments {
  P2GArguments<T, D> p2g;
  LateDeformation<T, D> late;
  G2PAdvanceArguments<T, D> advance;  // with the counters of displaced particles
  OwnRows own;
  const int* copy = nullptr;   // number of the copy with the particles
  int* items_taken = nullptr;  // items after the first one of each thread block, zeroed before
};

}  // namespace mpm
