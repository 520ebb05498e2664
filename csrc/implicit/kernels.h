#pragma once

#include "common/backend.h"
#include "implicit/arguments.h"

// tangent_scatter and tangent_gather: whichever of the two applies the tangents on a backend. cg_begin: x, r, p and the
// scalars from rhs. cg_advance: one iteration, with the product of the tangents in q. cg_look: number of scenes that
// are not done, on the host; with CUDA 13 the condition of the graph, on the device.
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#define MPM_TANGENT_KERNEL(ORDERED) ORDERED(tangent_scatter, TangentScatterArguments)
#else
#define MPM_TANGENT_KERNEL(ORDERED) ORDERED(tangent_gather, TangentGatherArguments)
#endif
#define MPM_IMPLICIT_KERNELS(PLAIN, ORDERED, SIZE) \
  MPM_TANGENT_KERNEL(ORDERED)                      \
  ORDERED(node_blocks, NodeBlocksArguments)        \
  PLAIN(cg_begin, ConjugateGradientsArguments)     \
  PLAIN(cg_advance, ConjugateGradientsArguments)   \
  PLAIN(cg_look, ConjugateGradientsArguments)
MPM_BACKEND_KERNELS(MPM_IMPLICIT_KERNELS)
