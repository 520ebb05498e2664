#pragma once

#include "common/backend.h"
#include "implicit/arguments.h"

// cg_begin: x, r, p and the scalars from rhs. cg_advance: one iteration, with the product of the tangents in q.
// cg_look: how many scenes are not done, on the host.
#define MPM_IMPLICIT_KERNELS(PLAIN, ORDERED, SIZE)  \
  ORDERED(tangent_scatter, TangentScatterArguments) \
  ORDERED(node_blocks, NodeBlocksArguments)         \
  PLAIN(cg_begin, ConjugateGradientsArguments)      \
  PLAIN(cg_advance, ConjugateGradientsArguments)    \
  PLAIN(cg_look, ConjugateGradientsArguments)
MPM_BACKEND_KERNELS(MPM_IMPLICIT_KERNELS)
