#pragma once

#include "common/host_device.h"

// The status tensor, int32 [1 + B, 8], that `activate` returns and hands from step to step. Row 0 counts the particles
// of all scenes, row 1 + b those of scene b; a particle whose scene is none of these counts in row 0 alone. First means
// first in time, for each row by itself: once entries 1-4 and 6 of a row tell of a problem, later activations leave
// them.
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

// Of the rows of scenes: the id of the particle at kOutsideFirst or kNonFiniteFirst, its index where there are no ids;
// 0 where there is no such particle.
enum SceneStatus : int { kOutsideId = 0, kNonFiniteId = 7 };

inline namespace TORCH_MPM_ISA {

// A row as the previous activation left it, or as it is before the first.
MPM_HD void copy_status(const int* previous, int* row) {
  constexpr int fresh[kStatusSize] = {0, 0, -1, 0, -1, 0, -1, 0};
  for (int i = 0; i < kStatusSize; i++) row[i] = previous ? previous[i] : fresh[i];
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
