#include "rollout/plan.op.h"

#include <tuple>

// Plans of calls of `substeps`, without particles, for every device, also one without compiled kernels.
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
namespace mpm {
namespace {

using Plan = std::tuple<int64_t, int64_t, int64_t, int64_t, std::string>;

#define MPM_INT(name) ", int " #name
#define MPM_BOOL(name) ", bool " #name
constexpr char kSchema[] = "plan_substeps(int schedule" MPM_PLAN_FACTS(
    MPM_INT, MPM_BOOL) ") -> (int schedule, int max_blocks, int steps, int order, str reasons)";
#undef MPM_INT
#undef MPM_BOOL

// Largest number of steps of a call. Calls of a requested schedule have nearly equal numbers, so that the last one has
// enough steps for it.
int64_t steps_of_call(const PlanFacts& f, int64_t most, bool forced) {
  if (f.path_bytes > 0) most = std::min(most, std::max<int64_t>(kMostPathBytes / f.path_bytes, 1));
  if (f.steps <= most || !forced) return std::min(f.steps, most);
  const int64_t calls = (f.steps + most - 1) / most;
  return (f.steps + calls - 1) / calls;
}

// A line "name: reason" for each other schedule.
std::string reasons_against(const PlanFacts& f, Schedule chosen, bool forced) {
  std::string text;
  for (const ScheduleEntry& s : kSchedules) {
    if (s.schedule == chosen) continue;
    std::string reason = s.unsupported(f);
    if (reason.empty() && forced) reason = std::string(kSchedules[chosen].name) + " was requested";
    if (reason.empty()) reason = s.unprofitable(f);
    if (reason.empty()) reason = std::string(kSchedules[chosen].name) + " is faster";
    text += std::string(text.empty() ? "" : "\n") + s.name + ": " + reason;
  }
  return text;
}

Plan plan(int64_t schedule, PlanFacts f) {
  check_schedule(schedule);
  const bool forced = schedule != kChoose;
  const Order order = order_for(f);
  const PlannedPool pool = pool_for(f);
  f.steps = steps_of_call(f, pool.steps, forced);
  if (pool.blocks >= 0) f.max_blocks = std::max(f.max_blocks, pool.blocks);
  const Schedule chosen = forced ? Schedule(schedule) : choose_schedule(f);
  if (forced) check_supported(chosen, f);
  return {chosen, pool.blocks, f.steps, order, reasons_against(f, chosen, forced)};
}

#define MPM_INT(name) , int64_t name
#define MPM_BOOL(name) , bool name
#define MPM_SET(name) facts.name = name;
Plan plan_substeps(int64_t schedule MPM_PLAN_FACTS(MPM_INT, MPM_BOOL)) {
  PlanFacts facts;
  MPM_PLAN_FACTS(MPM_SET, MPM_SET)
  return plan(schedule, facts);
}

}  // namespace
}  // namespace mpm

STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) { m.def(mpm::kSchema); }
STABLE_TORCH_LIBRARY_IMPL(torch_mpm, CompositeExplicitAutograd, m) {
  m.impl("plan_substeps", TORCH_BOX(&mpm::plan_substeps));
}
#endif
