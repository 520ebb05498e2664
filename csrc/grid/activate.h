#pragma once

#include "common/fields.h"
#include "common/host_device.h"
#include "grid/topology.h"

namespace mpm {

constexpr int kAbsent = -1;

template <class T, int D>
struct ActivateArguments {
  Geometry<T, D> geometry;
  int scenes = 1;
  int max_blocks = 0;
  int margin_blocks = 0;  // slots more, for blocks around those with particles that no particle touches yet
  int64_t particles = 0;
  bool deterministic = false;
  Field<const T> x;
  const int* scene = nullptr;  // [P] or null for one scene; kAbsent of a particle that is not there
  int64_t scene_stride = 0;
  const int64_t* id = nullptr;  // [P] or null
  int64_t id_stride = 0;
  const int* previous_status = nullptr;  // [1 + scenes, 8] or null
  int *table = nullptr, *block = nullptr, *offsets = nullptr, *index = nullptr, *schedule = nullptr, *status = nullptr;
  int64_t schedule_size = 0;
  const int* origin = nullptr;  // where the particles came from, whose numbers the status tells then; or null
  int64_t* breaks = nullptr;    // on the CPU: how often one does not follow the one before it in memory, in the order
                                // of cells; or null
  int* used_slots = nullptr;    // on the CPU: told how many slots have a block; or null
  // On CUDA: rows of each of two copies of x and origin, and which one counts; or null. Then the index has rows.
  const int* copy = nullptr;
  int copy_rows = 0;
  void* workspace = nullptr;  // bytes asked for by activate_workspace()
  bool fresh = true;          // whether the table and the workspace are not those of an earlier call as they were left
  int64_t workspace_size = 0;
  const Drift* drift = nullptr;   // since the activation in these tensors; null for a new one in any case
  int most_of_item = 0;           // on CUDA: particles of an item; 0 for as many as usual
  const Drift* missed = nullptr;  // where a particle may have been missed a step ago
  Drift* next_drift = nullptr;    // told where there is no room for all blocks around those with particles; or null

  MPM_HD int slots() const { return max_blocks + margin_blocks; }
};

}  // namespace mpm
