#pragma once

#include "common/backend.h"
#include "transfer/advance.h"
#include "transfer/arguments.h"

namespace mpm {
inline StressForm stress_form_of(int64_t form) {
  STD_TORCH_CHECK(form == int64_t(StressForm::mls) || form == int64_t(StressForm::gradient),
                  "stress_form must be 0 (MLS) or 1 (B-spline gradient), got ", form);
  return StressForm(form);
}
}  // namespace mpm

#define MPM_TRANSFER_KERNELS(PLAIN, ORDERED, SIZE)           \
  ORDERED(p2g, P2GArguments)                                 \
  ORDERED(p2g_backward, P2GBackwardArguments)                \
  ORDERED(scatter, ScatterArguments)                         \
  ORDERED(gather, GatherArguments)                           \
  ORDERED(position_gradient, PositionGradientArguments)      \
  ORDERED(g2p_advance, G2PAdvanceArguments)                  \
  ORDERED(g2p_advance_backward, G2PAdvanceBackwardArguments) \
  PLAIN(advance, AdvanceArguments)                           \
  PLAIN(advance_backward, AdvanceBackwardArguments)
MPM_BACKEND_KERNELS(MPM_TRANSFER_KERNELS)
