#pragma once

#include "grid/status.h"
#include "kinematics/advance.h"
#include "transfer/arguments.h"
#include "transfer/cell_order.h"

// Each kernel exists once per instruction set, in a namespace named after it (see launchers.cpp).
#define MPM_CPU_KERNELS(KERNEL)              \
  KERNEL(activate, ActivateArguments)        \
  KERNEL(cell_order, CellOrderArguments)     \
  KERNEL(p2g, P2GArguments)                  \
  KERNEL(p2g_backward, P2GBackwardArguments) \
  KERNEL(scatter, ScatterArguments)          \
  KERNEL(gather, GatherArguments)            \
  KERNEL(g2p_advance, G2PAdvanceArguments)   \
  KERNEL(position_gradient, PositionGradientArguments)

// KERNEL for every scalar, dimension and kernel order that is compiled.
#define MPM_CPU_INSTANTIATE(name, Arguments)             \
  MPM_CPU_INSTANTIATE_ORDERS(name, Arguments, float, 2)  \
  MPM_CPU_INSTANTIATE_ORDERS(name, Arguments, float, 3)  \
  MPM_CPU_INSTANTIATE_ORDERS(name, Arguments, double, 2) \
  MPM_CPU_INSTANTIATE_ORDERS(name, Arguments, double, 3)
#define MPM_CPU_INSTANTIATE_ORDERS(name, Arguments, T, D) \
  template void name<2, T, D>(const Arguments<T, D>&);    \
  template void name<3, T, D>(const Arguments<T, D>&);
