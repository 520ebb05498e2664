#pragma once

#include <cmath>
#include <cstdint>

#include "common/host_device.h"

// Clocks of scenes with time steps of their own: the choice of dt between two segments of a run, and the time after it.
namespace mpm {

// Columns of the row of a scene.
enum SegmentClock : int {
  kNow = 0,          // time [s]
  kEnd = 1,          // final time [s]
  kLatest = 2,       // dt of the latest choice [s], zero without one
  kStep = 3,         // dt of the substeps [s]: kLatest or slightly less, so that equal substeps end at kEnd
  kLeft = 4,         // number of substeps until kEnd, at most the number that the call allows
  kSubsteps = 5,     // number of substeps so far
  kLargestCfl = 6,   // largest ratio of dt to the stability limit
  kSegmentStep = 7,  // dt of the substeps of this segment [s], zero for a scene that pauses
  kSegmentClockSize = 8,
};

struct SegmentClockArguments {
  int64_t scenes = 0;
  const double* clock = nullptr;  // [scenes, kSegmentClockSize], as `next`
  const double* rate = nullptr;   // [scenes], 1/dt of the stability limit [1/s]; null to choose nothing
  int64_t rate_stride = 1;
  double cfl = 0, longest = 0;  // dt is at most cfl/rate and `longest` [s]
  double most = 0;              // largest number of substeps of a scene
  bool choose = true;           // otherwise only the ratio of dt to the limit is computed
  int64_t substeps = 0;         // of the segment, for scenes with more substeps left; or kAllLeft
  double* next = nullptr;
};

constexpr int64_t kAllLeft = -1;

inline namespace TORCH_MPM_ISA {

// Tolerance in the number of substeps, below which no additional one is computed.
constexpr double kCountTolerance = 1e-9;

MPM_HD void count_cfl(double* c, double rate) {
  const double share = c[kStep] * rate;
  if (share > c[kLargestCfl]) c[kLargestCfl] = share;  // false for NaN
}

// A latest dt between half of the longest and the longest is kept (torch_mpm/step/stability.py, `chosen_dt`).
MPM_HD void choose_step(const SegmentClockArguments& a, double* c, double rate) {
  const double limit = a.cfl / rate, longest = limit < a.longest ? limit : a.longest, span = c[kEnd] - c[kNow];
  c[kLeft] = 0;
  if (!(span > 0) || !std::isfinite(span) || !(longest > 0) || !(c[kSubsteps] < a.most)) return;
  const bool kept = longest / 2 <= c[kLatest] && c[kLatest] <= longest;
  const double latest = kept ? c[kLatest] : longest;
  const double left = ceil(span / latest * (1 - kCountTolerance)), allowed = a.most - c[kSubsteps];
  c[kLatest] = latest;
  c[kLeft] = left > 1 ? left : 1;
  c[kStep] = span / c[kLeft];
  if (c[kLeft] > allowed) c[kLeft] = allowed;
  count_cfl(c, rate);
}

MPM_HD void take_segment(const SegmentClockArguments& a, double* c) {
  const double count = a.substeps == kAllLeft ? c[kLeft] : c[kLeft] > double(a.substeps) ? double(a.substeps) : 0;
  const bool arrives = count > 0 && count * c[kStep] >= (c[kEnd] - c[kNow]) * (1 - kCountTolerance);
  c[kSegmentStep] = count > 0 ? c[kStep] : 0;
  c[kSubsteps] += count;
  c[kNow] = arrives ? c[kEnd] : c[kNow] + count * c[kStep];
}

MPM_HD void next_segment(const SegmentClockArguments& a, int64_t scene) {
  double* const c = a.next + scene * kSegmentClockSize;
  const double* const before = a.clock + scene * kSegmentClockSize;
  MPM_UNROLL for (int k = 0; k < kSegmentClockSize; k++)
    c[k] = before[k];
  if (a.rate) {
    const double rate = a.rate[scene * a.rate_stride];
    if (c[kSubsteps] > 0) count_cfl(c, rate);
    if (a.choose) choose_step(a, c, rate);
  }
  take_segment(a, c);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
