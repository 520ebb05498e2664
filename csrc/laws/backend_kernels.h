#pragma once

#include "common/backend.h"
#include "laws/arguments.h"
#include "laws/decompositions.h"
#include "laws/principal_kernels.h"
#include "laws/quartic_kernels.h"

#define MPM_LAW_KERNELS(PLAIN, ORDERED, SIZE)                        \
  PLAIN(svd, SVDArguments)                                           \
  PLAIN(polar, PolarArguments)                                       \
  PLAIN(material_stress, StressArguments)                            \
  PLAIN(material_stress_backward, StressBackwardArguments)           \
  PLAIN(material_scalar, ScalarArguments)                            \
  PLAIN(material_energy_backward, EnergyBackwardArguments)           \
  PLAIN(principal_update, PrincipalUpdateArguments)                  \
  PLAIN(principal_backward, PrincipalBackwardArguments)              \
  PLAIN(principal_scalar, PrincipalScalarArguments)                  \
  PLAIN(principal_energy_backward, PrincipalEnergyBackwardArguments) \
  PLAIN(return_map, ReturnMapArguments)                              \
  PLAIN(return_map_backward, ReturnMapBackwardArguments)             \
  PLAIN(sand_scalar, SandScalarArguments)
MPM_BACKEND_KERNELS(MPM_LAW_KERNELS)
