#pragma once

#include "common/backend.h"
#include "rollout/plan.h"

// The schedule that a call asks for, as ops check it.
namespace mpm {

inline void check_schedule(int64_t schedule) {
  STD_TORCH_CHECK(schedule >= kChoose && schedule < int64_t(std::size(kSchedules)), "schedule must be -1 to ",
                  std::size(kSchedules) - 1, ", got ", schedule);
}

inline void check_supported(Schedule schedule, const PlanFacts& facts) {
  const ScheduleEntry& s = kSchedules[schedule];
  const std::string reason = s.unsupported(facts);
  STD_TORCH_CHECK(reason.empty(), "schedule must be one that can take the steps, got ", s.name, ": ", reason);
}

// The one that is asked for, or that is chosen.
inline Schedule schedule_of(int64_t wanted, const PlanFacts& facts) {
  check_schedule(wanted);
  if (wanted == kChoose) return choose_schedule(facts);
  check_supported(Schedule(wanted), facts);
  return Schedule(wanted);
}

}  // namespace mpm
