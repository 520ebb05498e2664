#include "rollout/accumulate.h"

#include "cuda/programmatic_launch.cuh"
#include "cuda/slot_sums.cuh"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 256;

unsigned blocks_for(int64_t count) { return unsigned((count + kThreads - 1) / kThreads); }

// One thread adds the same element of all addends, so that two may have the same sum.
template <class T, int D>
__global__ void __launch_bounds__(kThreads) accumulate_kernel(const AccumulateArguments<T, D> a) {
  grid_dependency_sync();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  for (int k = 0; k < a.addends; k++)
    if (i < a.addend[k].size) a.addend[k].sum[i] += a.addend[k].term[i];
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) advance_clocks_kernel(const AdvanceClocksArguments<T, D> a) {
  const int64_t b = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (b < a.scenes) a.time[b] += a.dt * double(a.scene_dt[b]);
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) add_scaled_kernel(const AddScaledArguments<T, D> a) {
  grid_dependency_sync();
  const int64_t p = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (p >= a.count) return;
#pragma unroll
  for (int i = 0; i < D; i++) {
    const T first = a.first.pointer ? a.first.pointer[p * a.first.stride[0] + i * a.first.stride[1]] : T(0);
    const T second = a.second.pointer[p * a.second.stride[0] + i * a.second.stride[1]];
    a.to.pointer[p * a.to.stride[0] + i * a.to.stride[1]] = first + T(a.share) * second;
  }
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) accumulate_slots_kernel(const AccumulateSlotsArguments<T, D> a) {
  const int64_t slot = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (slot >= a.max_blocks) return;
  const int64_t block = a.block[slot];
  if (block < 0 || block >= a.block_count) return;
  for (int i = 0; i < D; i++) a.sum[block * D + i] += a.value[slot * D + i];
}

}  // namespace

template <class T, int D>
void accumulate(const AccumulateArguments<T, D>& a, Stream stream) {
  if (a.longest > 0) launch_in_chain(accumulate_kernel<T, D>, blocks_for(a.longest), kThreads, 0, stream, a);
}

template <class T, int D>
void advance_clocks(const AdvanceClocksArguments<T, D>& a, Stream stream) {
  if (a.scenes > 0) launch(advance_clocks_kernel<T, D>, blocks_for(a.scenes), kThreads, 0, stream, a);
}

template <class T, int D>
void add_scaled(const AddScaledArguments<T, D>& a, Stream stream) {
  if (a.count > 0) launch_in_chain(add_scaled_kernel<T, D>, blocks_for(a.count), kThreads, 0, stream, a);
}

template <class T, int D>
void accumulate_slots(const AccumulateSlotsArguments<T, D>& a, Stream stream) {
  if (a.max_blocks > 0) launch(accumulate_slots_kernel<T, D>, blocks_for(a.max_blocks), kThreads, 0, stream, a);
}

template <class T, int D>
void sum_slots(const SumSlotsArguments<T, D>& a, Stream stream) {
  add_up(a.sums, stream);
}

MPM_INSTANTIATE(accumulate, AccumulateArguments)
MPM_INSTANTIATE(advance_clocks, AdvanceClocksArguments)
MPM_INSTANTIATE(add_scaled, AddScaledArguments)
MPM_INSTANTIATE(accumulate_slots, AccumulateSlotsArguments)
MPM_INSTANTIATE(sum_slots, SumSlotsArguments)

}  // namespace mpm::cuda
