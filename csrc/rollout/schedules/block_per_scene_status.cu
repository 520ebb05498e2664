#include <climits>

#include "cuda/launch.cuh"
#include "grid/status.h"
#include "rollout/kernels.h"

// The status after a call, equal to that after activations of all its substeps.
namespace mpm::cuda {
namespace {

constexpr int kThreads = 256;

__device__ void write_errors(const BlockPerSceneStatusArguments& a, const SceneErrors& t, int row, int before) {
  int* const status = a.status + row * int64_t(kStatusSize);
  status[kProblemActivation] = before + t.step - 1;
  const auto write = [&](int particles, int p, int count, int first, int id) {
    if (particles == 0) return;
    status[count] = particles;
    status[first] = p;
    if (row > 0) status[id] = a.id ? int(a.id[p * a.id_stride]) : p;
  };
  write(t.outside, t.first_outside, kOutsideCount, kOutsideFirst, kOutsideId);
  write(t.not_finite, t.first_not_finite, kNonFiniteCount, kNonFiniteFirst, kNonFiniteId);
}

// By one thread: row 0 reports the first activation with an error in any scene.
__device__ void write_all_errors(const BlockPerSceneStatusArguments& a, int before) {
  SceneErrors all{INT_MAX, 0, INT_MAX, 0, INT_MAX, INT_MAX, 0};
  for (int b = 0; b < a.scenes; b++) {
    const SceneErrors& t = a.errors[b];
    all.wanted += t.wanted;
    if (t.full > 0) all.full = ::min(all.full, t.full);
    if (t.step == 0 || t.step > all.step) continue;
    if (t.step < all.step) all = {t.step, 0, INT_MAX, 0, INT_MAX, all.full, all.wanted};
    if (t.outside > 0) all.outside += t.outside, all.first_outside = ::min(all.first_outside, t.first_outside);
    if (t.not_finite > 0)
      all.not_finite += t.not_finite, all.first_not_finite = ::min(all.first_not_finite, t.first_not_finite);
  }
  if (a.status[kProblemActivation] < 0 && all.step < INT_MAX) write_errors(a, all, 0, before);
  if (all.wanted == 0) return;
  const int full = before + all.full - 1;
  if (a.status[kProblemActivation] < 0 || full < a.status[kProblemActivation]) a.status[kProblemActivation] = full;
  a.status[kBlocksWanted] = ::max(a.status[kBlocksWanted], a.max_blocks + all.wanted);
}

__global__ void __launch_bounds__(kThreads) block_per_scene_status_kernel(const BlockPerSceneStatusArguments a) {
  const int before = a.activated[kActivations] - 1;
  for (int64_t row = threadIdx.x; row <= a.scenes; row += kThreads) {
    const int64_t start = row * kStatusSize;
    copy_status(a.activated + start, a.status + start);
    if (row == 0) continue;
    const SceneErrors& t = a.errors[row - 1];
    if (t.step > 0 && a.status[start + kProblemActivation] < 0) write_errors(a, t, int(row), before);
  }
  __syncthreads();
  if (threadIdx.x > 0) return;
  a.status[kActivations] += int(a.steps) - 1;
  write_all_errors(a, before);
}

}  // namespace

void block_per_scene_status(const BlockPerSceneStatusArguments& a, Stream stream) {
  launch(block_per_scene_status_kernel, 1, kThreads, 0, stream, a);
}

}  // namespace mpm::cuda
