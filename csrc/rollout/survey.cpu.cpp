#include "rollout/survey.h"
#include "cpu/parallel.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 1024;  // particles below which a range is not split

// Numbers that are not negative are in the order of their bits.
void raise(double* place, double value) {
  auto* const bits = reinterpret_cast<int64_t*>(place);
  int64_t wanted, now = __atomic_load_n(bits, __ATOMIC_RELAXED);
  __builtin_memcpy(&wanted, &value, sizeof(value));
  while (now < wanted && !__atomic_compare_exchange_n(bits, &now, wanted, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
}

void count(double* place, double more) {
  auto* const bits = reinterpret_cast<int64_t*>(place);
  int64_t wanted, now = __atomic_load_n(bits, __ATOMIC_RELAXED);
  do {
    double value;
    __builtin_memcpy(&value, &now, sizeof(value));
    value += more;
    __builtin_memcpy(&wanted, &value, sizeof(value));
  } while (!__atomic_compare_exchange_n(bits, &now, wanted, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
}

}  // namespace

// Neighbours in memory are mostly of one scene: what they have in common is written where the scene changes.
template <class T, int D>
void survey(const SurveyArguments<T, D>& a) {
  if (a.scenes == 0) return;
  parallel_ranges(a.particles, kGrain, [&](int64_t begin, int64_t end) {
    double rate = 0, speed = 0, wrong = 0;
    int last = 0;
    const auto write = [&]() {
      double* const row = a.result + last * int64_t(kSurveySize);
      raise(row + kRate, rate);
      raise(row + kSpeed, speed);
      if (wrong > 0) count(row + kWrong, wrong);
      rate = speed = wrong = 0;
    };
    for (int64_t p = begin; p < end; p++) {
      const int scene = scene_of(a, p);
      if (scene != last) write(), last = scene;
      const Surveyed<T> s = survey_particle(a, p, scene);
      if (double(s.rate) > rate) rate = double(s.rate);
      if (double(s.speed) > speed) speed = double(s.speed);
      wrong += s.wrong;
    }
    write();
  });
}

MPM_INSTANTIATE(survey, SurveyArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
