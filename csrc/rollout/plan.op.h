#pragma once

#include "common/backend.h"
#include "rollout/plan.h"

// Checks of the schedule argument of ops.
namespace mpm {

inline void check_schedule(int64_t schedule) {
  STD_TORCH_CHECK(schedule >= kChoose && schedule < int64_t(std::size(kSchedules)), "schedule must be -1 to ",
                  std::size(kSchedules) - 1, ", got ", schedule);
}

inline void check_supported(Schedule schedule, const PlanFacts& facts) {
  const ScheduleEntry& s = kSchedules[schedule];
  const std::string reason = s.unsupported(facts);
  STD_TORCH_CHECK(reason.empty(), "schedule must be one that supports the call, got ", s.name, ": ", reason);
}

// The requested schedule, or the chosen one.
inline Schedule schedule_of(int64_t wanted, const PlanFacts& facts) {
  check_schedule(wanted);
  if (wanted == kChoose) return choose_schedule(facts);
  check_supported(Schedule(wanted), facts);
  return Schedule(wanted);
}

}  // namespace mpm
