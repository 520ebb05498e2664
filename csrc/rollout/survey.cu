#include "cuda/launch.cuh"
#include "rollout/survey.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

// Numbers that are not negative are in the order of their bits.
__device__ void raise(double* place, double value) {
  auto* const bits = reinterpret_cast<long long*>(place);
  const long long wanted = __double_as_longlong(value);
  if (*const_cast<volatile long long*>(bits) < wanted) atomicMax(bits, wanted);
}

// Neighbours in memory are mostly of one scene: a warp of one writes once.
template <class T, int D>
__global__ void __launch_bounds__(kThreads) survey_kernel(const __grid_constant__ SurveyArguments<T, D> a) {
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int scene = scene_of(a, p < a.particles ? p : a.particles - 1);
  double rate = 0, speed = 0;
  bool wrong = false;
  if (p < a.particles) {
    const Surveyed<T> s = survey_particle(a, p, scene);
    rate = double(s.rate), speed = double(s.speed), wrong = s.wrong;
  }
  double* const row = a.result + scene * int64_t(kSurveySize);
  int together;
  __match_all_sync(~0u, scene, &together);
  if (together) {
    for (int step = 16; step > 0; step /= 2) {
      rate = fmax(rate, __shfl_xor_sync(~0u, rate, step));
      speed = fmax(speed, __shfl_xor_sync(~0u, speed, step));
    }
    const int wrongs = __popc(__ballot_sync(~0u, wrong));
    if (threadIdx.x % 32 > 0) return;
    if (wrongs > 0) atomicAdd(row + kWrong, double(wrongs));
  } else if (wrong) {
    atomicAdd(row + kWrong, 1.0);
  }
  raise(row + kRate, rate);
  raise(row + kSpeed, speed);
}

}  // namespace

template <class T, int D>
void survey(const SurveyArguments<T, D>& a, Stream stream) {
  if (a.particles == 0 || a.scenes == 0) return;
  launch(survey_kernel<T, D>, unsigned((a.particles + kThreads - 1) / kThreads), kThreads, 0, stream, a);
}

MPM_INSTANTIATE(survey, SurveyArguments)

}  // namespace mpm::cuda
