#pragma once

#include "common/backend.h"
#include "rollout/accumulate.h"
#include "rollout/g2p2g_chunks.h"
#include "rollout/laws_p2g.h"
#include "rollout/next_grid.h"
#include "rollout/schedules/block_per_scene.h"
#include "rollout/segment_clock.h"
#include "rollout/survey.h"
#include "rollout/thermal_laws_backward.h"

#define MPM_ROLLOUT_KERNELS(PLAIN, ORDERED, SIZE)   \
  PLAIN(survey, SurveyArguments)                    \
  PLAIN(accumulate, AccumulateArguments)            \
  PLAIN(advance_clocks, AdvanceClocksArguments)     \
  PLAIN(add_scaled, AddScaledArguments)             \
  PLAIN(accumulate_slots, AccumulateSlotsArguments) \
  PLAIN(sum_slots, SumSlotsArguments)
MPM_BACKEND_KERNELS(MPM_ROLLOUT_KERNELS)

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#define MPM_SORTED_CPU_KERNELS(PLAIN, ORDERED, SIZE) \
  ORDERED(laws_p2g, LawsP2GArguments)                \
  PLAIN(g2p2g_chunks, G2P2GChunksArguments)          \
  PLAIN(heat_g2p_chunks, HeatG2PChunksArguments)     \
  PLAIN(longest_move, LongestMoveArguments)          \
  PLAIN(permute, PermuteArguments)
MPM_BACKEND_KERNELS(MPM_SORTED_CPU_KERNELS)
#endif

#define MPM_THERMAL_LAWS_KERNELS(PLAIN, ORDERED, SIZE)           \
  PLAIN(begin_thermal_laws, ThermalLawsArguments)                \
  PLAIN(end_thermal_laws, ThermalLawsArguments)                  \
  PLAIN(end_thermal_laws_backward, ThermalLawsBackwardArguments) \
  PLAIN(begin_thermal_laws_backward, ThermalLawsBackwardArguments)
MPM_BACKEND_KERNELS(MPM_THERMAL_LAWS_KERNELS)

#if MPM_BACKEND == MPM_BACKEND_IS_cuda
namespace mpm::cuda {
// times[k + 1] = times[k] + dt, on the device.
void add_up_times(double* times, double first, double dt, int64_t count, Stream stream);
void block_per_scene_status(const BlockPerSceneStatusArguments& a, Stream stream);
void segment_clock(const SegmentClockArguments& a, Stream stream);
// The bits of the largest absolute value of `count` numbers; zero where there is none.
void find_largest(const Field<const float>& numbers, int64_t count, int* bits, Stream stream);
template <class T, int D>
void next_grid(const NextGridArguments<T, D>& a, Stream stream);
}  // namespace mpm::cuda
#endif
