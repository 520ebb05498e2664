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
  int margin_blocks = 0;  // further slots, for blocks around those with particles that no particle touches yet
  int64_t particles = 0;
  bool deterministic = false;
  Field<const T> x;
  const int* scene = nullptr;  // [P] or null for one scene; kAbsent for an absent particle
  int64_t scene_stride = 0;
  const int64_t* id = nullptr;  // [P] or null
  int64_t id_stride = 0;
  const int* previous_status = nullptr;  // [1 + scenes, 8] or null
  int *table = nullptr, *block = nullptr, *offsets = nullptr, *index = nullptr, *schedule = nullptr, *status = nullptr;
  int64_t schedule_size = 0;
  const int* origin = nullptr;  // places of the particles before a reorder, reported by the status; or null
  int64_t* breaks = nullptr;    // on the CPU: number of particles, in the order of cells, that do not follow their
                                // predecessor in memory; or null
  int* used_slots = nullptr;    // on the CPU: number of slots with a block; or null
  // On CUDA: rows of each of two copies of x and origin, and the number of the current one; or null. With copies the
  // index contains rows.
  const int* copy = nullptr;
  int copy_rows = 0;
  void* workspace = nullptr;  // its size is that of activate_workspace()
  bool fresh = true;          // whether the table and the workspace are new, not those of an earlier call
  int64_t workspace_size = 0;
  const Displacement* displacement = nullptr;  // since the activation in these tensors; null to force a new one
  int out_of_block_cost = kOutOfBlockCost;
  int most_of_item = 0;                  // on CUDA: particles of an item; 0 for the default
  const Displacement* missed = nullptr;  // states whether the previous step may have missed a particle
  Displacement* next_displacement =
      nullptr;  // kLost if there is no room for all blocks around those with particles; or null

  MPM_HD int slots() const { return max_blocks + margin_blocks; }
};

}  // namespace mpm
