#pragma once

// Entries of the status tensor (int32 [8]) that `activate` returns and hands from step to step. First means first in
// time: once entries 1-4 and 6 tell of a problem, later activations leave them.
namespace mpm {

enum Status : int {
  kBlocksWanted = 0,       // largest number of active blocks wanted by any activation so far
  kOutsideCount = 1,       // particles whose support leaves the grid
  kOutsideFirst = 2,       // lowest index of those, -1 for none
  kNonFiniteCount = 3,     // particles with a NaN or Inf position
  kNonFiniteFirst = 4,     // lowest index of those, -1 for none
  kActivations = 5,        // activations so far
  kProblemActivation = 6,  // 0-based activation of the first problem (outside, not finite, overflow), -1 for none
  kBlocksNow = 7,          // active blocks wanted by this activation
  kStatusSize = 8,
};

}  // namespace mpm
