#pragma once

#include "common/backend.h"
#include "grid/activate.h"
#include "grid/cell_order.h"
#include "grid/grid_update.h"
#include "grid/impulses.h"
#include "grid/obstacle.h"
#include "grid/status.h"
#include "grid/take.h"

#define MPM_GRID_KERNELS(PLAIN, ORDERED, SIZE)                 \
  SIZE(activate_workspace, ActivateArguments)                  \
  ORDERED(activate, ActivateArguments)                         \
  ORDERED(cell_order, CellOrderArguments)                      \
  PLAIN(grid_update, GridUpdateArguments)                      \
  PLAIN(grid_update_backward, GridUpdateBackwardArguments)     \
  PLAIN(contact, ContactArguments)                             \
  PLAIN(contact_backward, ContactArguments)                    \
  PLAIN(wall_impulses, WallImpulsesArguments)                  \
  PLAIN(wall_impulses_backward, WallImpulsesBackwardArguments) \
  PLAIN(contact_impulses, ContactImpulsesArguments)            \
  PLAIN(contact_impulses_backward, ContactImpulsesArguments)
MPM_BACKEND_KERNELS(MPM_GRID_KERNELS)

#if MPM_BACKEND == MPM_BACKEND_IS_cuda
namespace mpm::cuda {
void take(const TakeArguments& a, Stream stream);
}  // namespace mpm::cuda
#endif
