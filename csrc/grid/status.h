#pragma once

#include "common/host_device.h"

// The status tensor, int32 [1 + B, 8], which `activate` returns and passes from step to step. Row 0 counts the
// particles of all scenes, row 1 + b those of scene b; a particle of an invalid scene counts in row 0 only. First means
// first in time, separately for each row: once entries 1-4 and 6 of a row report a problem, later activations do not
// change them.
namespace mpm {

enum Status : int {
  kBlocksWanted = 0,       // of row 0: largest number of active blocks wanted by any activation so far
  kOutsideCount = 1,       // particles whose support leaves the grid
  kOutsideFirst = 2,       // lowest index of those, -1 for none
  kNonFiniteCount = 3,     // particles with a NaN or Inf position
  kNonFiniteFirst = 4,     // lowest index of those, -1 for none
  kActivations = 5,        // of row 0: activations so far
  kProblemActivation = 6,  // 0-based activation of the first problem (for row 0 also overflow), -1 for none
  kBlocksNow = 7,          // of row 0: active blocks wanted by this activation
  kStatusSize = 8,
};

// Entries of the rows of scenes: the id of the particle at kOutsideFirst or kNonFiniteFirst, or its index without ids;
// 0 without such a particle.
enum SceneStatus : int { kOutsideId = 0, kNonFiniteId = 7 };

inline namespace TORCH_MPM_ISA {

// A row after the previous activation, or before the first one.
MPM_HD void copy_status(const int* previous, int* row) {
  constexpr int fresh[kStatusSize] = {0, 0, -1, 0, -1, 0, -1, 0};
  for (int i = 0; i < kStatusSize; i++) row[i] = previous ? previous[i] : fresh[i];
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
