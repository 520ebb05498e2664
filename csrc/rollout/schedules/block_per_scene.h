#pragma once

#include "grid/grid_update.h"
#include "grid/obstacle.h"
#include "transfer/advance.h"
#include "transfer/arguments.h"

// Substeps of scenes that each fit on one multiprocessor, on CUDA: a thread block computes all substeps of a scene in a
// call, with the nodes in shared memory, and scenes do not wait for each other.
namespace mpm {

// Largest sizes in bytes, for float: of a particle, and of a block with its cells.
constexpr int64_t kMostSceneRow = 96, kMostSceneBlock = 1600;

// Errors of a scene, and their first substeps; zeroed before a call.
struct SceneErrors {
  int step;  // 1 + the substep of the first error, or 0
  int outside, first_outside, not_finite, first_not_finite;
  int full, wanted;  // 1 + the first substep without room for its blocks, or 0; number of missing blocks
};

// The fields of the particles are those of `p2g` and `advance`, updated in place. The activation is that of the first
// substep.
template <class T, int D>
struct BlockPerSceneArguments {
  P2GArguments<T, D> p2g;
  G2PAdvanceArguments<T, D> advance;
  GridUpdateArguments<T, D> update;
  ContactArguments<T, D> contact;
  bool obstacles = false;
  int scenes = 1;
  int64_t steps = 0;
  double time = 0, dt = 0;       // of obstacles, for scenes without separate clocks
  double* scene_time = nullptr;  // [scenes], advanced in each substep
  const T* scene_dt = nullptr;   // [scenes]
  char* rows = nullptr;          // for scenes that exceed shared memory
  char* blocks = nullptr;        // [spare_blocks], for scenes that grow beyond it
  int spare_blocks = 0;
  int* blocks_taken = nullptr;    // number used, zero before the call
  SceneErrors* errors = nullptr;  // [scenes]
};

// Writes the errors of the scenes to the status of the activation.
struct BlockPerSceneStatusArguments {
  int scenes = 1, max_blocks = 0;
  int64_t steps = 0;
  const SceneErrors* errors = nullptr;
  const int* activated = nullptr;  // [1 + scenes, 8] after the activation
  int* status = nullptr;
  const int64_t* id = nullptr;  // [P] or null
  int64_t id_stride = 0;
};

}  // namespace mpm
