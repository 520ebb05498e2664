#pragma once

#include "common/backend.h"
#include "heat/patches.h"
#include "heat/solve.h"

#define MPM_HEAT_KERNELS(PLAIN, ORDERED, SIZE)         \
  SIZE(heat_workspace, HeatArguments)                  \
  ORDERED(heat_cg, HeatArguments)                      \
  SIZE(heat_operator_workspace, HeatOperatorArguments) \
  ORDERED(heat_operator, HeatOperatorArguments)        \
  ORDERED(heat_stencil, HeatOperatorArguments)         \
  PLAIN(heat_patches, PatchArguments)
MPM_BACKEND_KERNELS(MPM_HEAT_KERNELS)
