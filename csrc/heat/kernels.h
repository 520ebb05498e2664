#pragma once

#include "common/backend.h"
#include "heat/backward.h"
#include "heat/patches.h"
#include "heat/solve.h"
#include "heat/transfer.h"
#include "transfer/advance.h"

#define MPM_HEAT_KERNELS(PLAIN, ORDERED, SIZE)         \
  SIZE(heat_workspace, HeatArguments)                  \
  ORDERED(heat_cg, HeatArguments)                      \
  SIZE(heat_operator_workspace, HeatOperatorArguments) \
  ORDERED(heat_operator, HeatOperatorArguments)        \
  ORDERED(heat_stencil, HeatOperatorArguments)         \
  PLAIN(heat_patches, PatchArguments)
MPM_BACKEND_KERNELS(MPM_HEAT_KERNELS)

#define MPM_HEAT_TRANSFER_KERNELS(PLAIN, ORDERED, SIZE) \
  PLAIN(heat_volumes, HeatVolumesArguments)             \
  ORDERED(heat_to_nodes, HeatToNodesArguments)          \
  PLAIN(heat_nodes, HeatNodesArguments)                 \
  ORDERED(heat_surface, HeatSurfaceArguments)           \
  PLAIN(heat_hold, HeatHoldArguments)                   \
  ORDERED(heat_to_particles, HeatToParticlesArguments)
MPM_BACKEND_KERNELS(MPM_HEAT_TRANSFER_KERNELS)

#define MPM_HEAT_SIMPLE_KERNELS(PLAIN, ORDERED, SIZE) \
  ORDERED(heat_simple_step, HeatSimpleArguments)      \
  PLAIN(heat_finish, HeatFinishArguments)
MPM_BACKEND_KERNELS(MPM_HEAT_SIMPLE_KERNELS)

#define MPM_HEAT_CPU_KERNELS(PLAIN, ORDERED, SIZE) \
  PLAIN(heat_find_slots, HeatSlotsArguments)       \
  PLAIN(heat_layers, HeatLayersArguments)
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
MPM_BACKEND_KERNELS(MPM_HEAT_CPU_KERNELS)
#endif

// On CUDA alone.
#define MPM_HEAT_CUDA_KERNELS(PLAIN, ORDERED, SIZE)                   \
  ORDERED(heat_advance, HeatAdvanceArguments)                         \
  ORDERED(heat_exchange, HeatExchangeArguments)                       \
  ORDERED(heat_exchange_and_surface, HeatExchangeAndSurfaceArguments) \
  ORDERED(heat_pack, HeatPackArguments)
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
MPM_BACKEND_KERNELS(MPM_HEAT_CUDA_KERNELS)
#endif

#define MPM_HEAT_BACKWARD_KERNELS(PLAIN, ORDERED, SIZE)                             \
  ORDERED(heat_to_particles_backward, HeatToParticlesBackwardArguments)             \
  PLAIN(heat_term_backward, HeatTermBackwardArguments)                              \
  PLAIN(heat_numbers_backward, HeatNumbersBackwardArguments)                        \
  PLAIN(heat_held_backward, HeatHeldBackwardArguments)                              \
  PLAIN(heat_surface_temperature_backward, HeatSurfaceTemperatureBackwardArguments) \
  PLAIN(heat_nodes_backward, HeatNodesBackwardArguments)                            \
  PLAIN(heat_layers_backward, HeatLayersBackwardArguments)                          \
  PLAIN(heat_surface_row_backward, HeatSurfaceRowBackwardArguments)                 \
  ORDERED(heat_to_nodes_backward, HeatToNodesBackwardArguments)
MPM_BACKEND_KERNELS(MPM_HEAT_BACKWARD_KERNELS)
