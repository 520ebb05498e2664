#pragma once

#include "common/backend.h"
#include "implicit/arguments.h"

// tangent_scatter and tangent_gather: where a backend applies the tangents.
// cg_begin: x, r, p and the scalars from rhs. cg_advance: one iteration, with the product of the tangents in q.
// cg_look: how many scenes are not done, on the host; with CUDA 13 whether a graph goes on, which the device finds out.
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
