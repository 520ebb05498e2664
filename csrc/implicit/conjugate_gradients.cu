#include "cuda/launch.cuh"
#include "implicit/arguments.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128, kSumThreads = 1024, kLanes = 16;  // lanes that share a slot

enum class Pass : int { start, curvature, step, turn };

// kLanes threads process the nodes of a slot, and sum the results in a fixed order.
template <class T, int D>
__global__ void __launch_bounds__(kThreads) cg_pass_kernel(const ConjugateGradientsArguments<T, D> a, Pass pass) {
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x, slot = thread / kLanes;
  const int lane = int(thread % kLanes), block = slot < a.max_blocks ? a.block[slot] : -1;
  double sum = 0;
  if (block >= 0) {
    const ConjugateGradients scene = a.scene[block / a.blocks_per_scene];
    for (int local = lane; local < kBlockNodes<D>; local += kLanes) {
      const int64_t node = slot * kBlockNodes<D> + local;
      if (a.mass[node] == T(0)) continue;  // its vectors stay zero
      if (pass == Pass::start) sum += cg_start(a, node);
      if (pass == Pass::curvature) sum += cg_curvature(a, node);
      if (pass == Pass::step) sum += cg_step(a, node, scene.step);
      if (pass == Pass::turn) cg_turn(a, node, scene);
    }
  }
  if (pass == Pass::turn) return;
#pragma unroll
  for (int step = kLanes / 2; step > 0; step /= 2) sum += __shfl_down_sync(~0u, sum, step, kLanes);
  if (block >= 0 && lane == 0) a.slots[slot] = sum;
}

// A thread block sums the slots of a scene in a fixed order.
template <class T, int D>
__global__ void __launch_bounds__(kSumThreads)
    cg_scene_kernel(const ConjugateGradientsArguments<T, D> a, CGPhase phase) {
  __shared__ double parts[kSumThreads];
  const int scene = blockIdx.x;
  if (phase != CGPhase::start && a.scene[scene].state != kSolving) {
    if (threadIdx.x == 0) a.scene[scene].step = a.scene[scene].turn = 0;
    return;
  }
  double sum = 0;
  for (int slot = threadIdx.x; slot < a.max_blocks; slot += kSumThreads)
    if (a.block[slot] >= 0 && a.block[slot] / a.blocks_per_scene == scene) sum += a.slots[slot];
  parts[threadIdx.x] = sum;
  __syncthreads();
  for (int step = kSumThreads / 2; step > 0; step /= 2) {
    if (threadIdx.x < step) parts[threadIdx.x] += parts[threadIdx.x + step];
    __syncthreads();
  }
  if (threadIdx.x == 0) advance_scene(a.scene[scene], phase, parts[0], double(a.relative[scene]));
}

#if CUDART_VERSION >= 13000
// One thread block.
template <class T, int D>
__global__ void cg_loop_kernel(const ConjugateGradientsArguments<T, D> a) {
  bool unfinished = false;
  for (int b = threadIdx.x; b < a.scenes; b += kSumThreads)
    unfinished = unfinished || (a.scene[b].state == kSolving && a.scene[b].iterations < a.max_iterations);
  unfinished = __syncthreads_or(unfinished);
  if (threadIdx.x == 0 && a.loop) cudaGraphSetConditional(a.loop, unfinished);
}
#else
template <class T, int D>
__global__ void cg_look_kernel(const ConjugateGradientsArguments<T, D> a) {
  const int b = int(blockIdx.x) * kThreads + int(threadIdx.x);
  if (b < a.scenes && a.scene[b].state == kSolving) atomicAdd(a.unfinished, 1);
}
#endif

template <class T, int D>
__global__ void cg_mirror_kernel(const ConjugateGradientsArguments<T, D> a) {
  const int group = int(blockIdx.x) * kThreads + int(threadIdx.x);
  if (group < a.image_groups) mirror_group(a, group);
}

template <class T, int D>
void run_pass(const ConjugateGradientsArguments<T, D>& a, Pass pass, Stream stream) {
  const int64_t threads = int64_t(a.max_blocks) * kLanes;
  launch(cg_pass_kernel<T, D>, unsigned((threads + kThreads - 1) / kThreads), kThreads, 0, stream, a, pass);
}

}  // namespace

template <class T, int D>
void cg_begin(const ConjugateGradientsArguments<T, D>& a, Stream stream) {
  if (a.max_blocks == 0 || a.scenes == 0) return;
  run_pass(a, Pass::start, stream);
  launch(cg_scene_kernel<T, D>, unsigned(a.scenes), kSumThreads, 0, stream, a, CGPhase::start);
}

template <class T, int D>
void cg_advance(const ConjugateGradientsArguments<T, D>& a, Stream stream) {
  if (a.max_blocks == 0 || a.scenes == 0) return;
  run_pass(a, Pass::curvature, stream);
  if (a.image_groups > 0)
    launch(cg_mirror_kernel<T, D>, unsigned((a.image_groups + kThreads - 1) / kThreads), kThreads, 0, stream, a);
  launch(cg_scene_kernel<T, D>, unsigned(a.scenes), kSumThreads, 0, stream, a, CGPhase::curvature);
  run_pass(a, Pass::step, stream);
  launch(cg_scene_kernel<T, D>, unsigned(a.scenes), kSumThreads, 0, stream, a, CGPhase::step);
  run_pass(a, Pass::turn, stream);
}

#if CUDART_VERSION >= 13000
template <class T, int D>
void cg_look(const ConjugateGradientsArguments<T, D>& a, Stream stream) {
  launch(cg_loop_kernel<T, D>, 1, kSumThreads, 0, stream, a);
}
#else
// Waits for the device.
template <class T, int D>
void cg_look(const ConjugateGradientsArguments<T, D>& a, Stream stream) {
  *a.unfinished_on_host = 0;
  if (a.max_blocks == 0 || a.scenes == 0) return;
  check(cudaMemsetAsync(a.unfinished, 0, sizeof(int), stream));
  launch(cg_look_kernel<T, D>, unsigned((a.scenes + kThreads - 1) / kThreads), kThreads, 0, stream, a);
  check(cudaMemcpyAsync(a.unfinished_on_host, a.unfinished, sizeof(int), cudaMemcpyDeviceToHost, stream));
  check(cudaStreamSynchronize(stream));
}
#endif

MPM_INSTANTIATE(cg_begin, ConjugateGradientsArguments)
MPM_INSTANTIATE(cg_advance, ConjugateGradientsArguments)
MPM_INSTANTIATE(cg_look, ConjugateGradientsArguments)

}  // namespace mpm::cuda
