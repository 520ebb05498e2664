#pragma once

#include "grid/grid_update.h"
#include "grid/obstacle.h"
#include "transfer/advance.h"
#include "transfer/arguments.h"

// Substeps of scenes that are small enough to stay on one multiprocessor each, on CUDA: a thread block takes a scene
// through all substeps of a call, its nodes in shared memory, and nobody waits for other scenes.
namespace mpm {

// Bytes at most, of float: of a particle, and of a block with its cells.
constexpr int64_t kMostResidentRow = 96, kMostResidentBlock = 1600;

// What went wrong in a scene, and when it did first; zeroed before a call.
struct SceneTrouble {
  int step;  // 1 + the substep, or 0
  int outside, first_outside, not_finite, first_not_finite;
  int full, wanted;  // 1 + the substep whose blocks had no room, or 0, and how many they were
};

// The fields of the particles are those that `p2g` and `advance` read, and move in place. The activation is that of the
// first substep.
template <class T, int D>
struct ResidentArguments {
  P2GArguments<T, D> p2g;
  G2PAdvanceArguments<T, D> advance;
  GridUpdateArguments<T, D> update;
  ContactArguments<T, D> contact;
  bool obstacles = false;
  int scenes = 1;
  int64_t steps = 0;
  double time = 0, dt = 0;       // of obstacles, where scenes have no time of their own
  double* scene_time = nullptr;  // [scenes], goes on with each substep
  const T* scene_dt = nullptr;   // [scenes]
  char* rows = nullptr;          // for scenes that shared memory does not hold, or not any more
  char* blocks = nullptr;        // [spare_blocks], for those that reach more blocks
  int spare_blocks = 0;
  int* blocks_taken = nullptr;      // of these, zero before the call
  SceneTrouble* trouble = nullptr;  // [scenes]
};

// Tells what went wrong in the status of the activation.
struct ResidentStatusArguments {
  int scenes = 1, max_blocks = 0;
  int64_t steps = 0;
  const SceneTrouble* trouble = nullptr;
  const int* activated = nullptr;  // [1 + scenes, 8] after the activation
  int* status = nullptr;
  const int64_t* id = nullptr;  // [P] or null
  int64_t id_stride = 0;
};

}  // namespace mpm
