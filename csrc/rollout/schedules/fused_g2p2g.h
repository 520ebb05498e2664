#pragma once

#include "transfer/advance.h"
#include "transfer/arguments.h"

// G2P of a substep and P2G of the next one in one kernel, on CUDA, while an activation lasts (G2P2G: Wang et al. 2020,
// "A massively parallel and scalable multi-GPU material point method"). Velocities and affine fields of particles, half
// of what a substep reads and writes, stay in registers.
namespace mpm {

// F or J of the particles, which the call owns and which all move in place, is left to P2G. G2P reads the nodes of
// `advance`, P2G adds to those of `p2g`.
template <class T, int D>
struct G2P2GArguments {
  P2GArguments<T, D> p2g;
  LateDeformation<T, D> late;
  G2PAdvanceArguments<T, D> advance;  // its drift counts where particles go
  OwnRows own;
  const int* copy = nullptr;   // which one the particles are in
  int* items_taken = nullptr;  // by thread blocks beyond their first one, zeroed before
};

}  // namespace mpm
