#pragma once

#include "common/backend.h"
#include "grid/kernels.h"
#include "rollout/accumulate.h"
#include "rollout/survey.h"

#define MPM_ROLLOUT_KERNELS(PLAIN, ORDERED, SIZE) \
  PLAIN(survey, SurveyArguments)                  \
  PLAIN(accumulate, AccumulateArguments)          \
  PLAIN(accumulate_slots, AccumulateSlotsArguments)
MPM_BACKEND_KERNELS(MPM_ROLLOUT_KERNELS)

#if MPM_BACKEND == MPM_BACKEND_IS_cuda
namespace mpm::cuda {
// times[k + 1] = times[k] + dt, on the device.
void add_up_times(double* times, double first, double dt, int64_t count, Stream stream);
// Both in one pass over the nodes; the result is that of the grid update, and that of contact is unused.
template <class T, int D>
void grid_update_and_contact(const GridUpdateArguments<T, D>& a, const ContactArguments<T, D>& contact, Stream stream);
}  // namespace mpm::cuda
#endif
