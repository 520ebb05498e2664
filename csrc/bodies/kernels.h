#pragma once

#include "bodies/free_bodies.h"
#include "common/backend.h"

#define MPM_BODIES_KERNELS(PLAIN, ORDERED, SIZE)   \
  SIZE(free_bodies_workspace, FreeBodiesArguments) \
  PLAIN(free_bodies, FreeBodiesArguments)
MPM_BACKEND_KERNELS(MPM_BODIES_KERNELS)
