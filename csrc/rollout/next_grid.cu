#include "rollout/next_grid.h"

#include "cuda/chain.cuh"
#include "cuda/fixed_point.cuh"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 256;
constexpr float kFar = 0.9f;  // cells in a step: particles go less than one

template <class T, int D>
__device__ bool goes_far(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, const NodeRow<T, D>& row) {
  const T dt = a.scene_dt ? T(a.dt) * a.scene_dt[s.scene] : T(a.dt), cells = dt * a.geometry.inverse_dx;
  bool near = true;
#pragma unroll
  for (int i = 0; i < D; i++) near = near && fabs(cells * row.value[i]) < T(kFar);  // false for NaN
  return !near;
}

// A node of a slot; false where the slot is not in use.
template <bool Obstacles, class T, int D>
__device__ bool take_node(const NextGridArguments<T, D>& a, int slot, int local) {
  const SlotUpdate<T, D> s = slot_update(a.update, slot);
  if (!s.active) return false;
  const int64_t node = int64_t(slot) * kBlockNodes<D> + local;
  NodeRow<T, D> row = update_node(a.update, s, local, NodeRows<T, D>(a.update.nodes, a.fixed).at(node));
  if constexpr (Obstacles) {
    const ContactSlot<T, D> there = contact_slot(a.contact, slot);
    if (there.active)
      row.value = after_obstacles(a.contact, there, a.contact.obstacles, node_position(a.contact, there.corner, local),
                                  row.value);
  }
  if (a.watched && goes_far(a.update, s, row)) atomicOr(&a.watched->lost, Drift::kLost);
  a.update.updated[node] = row;
  if (a.emptied) NodeRows<T, D>::empty(a.emptied, node, a.fixed);
  return true;
}

// In strides of the grid, so that a pool that is mostly unused costs nothing.
template <bool Obstacles, class T, int D>
__global__ void __launch_bounds__(kThreads) next_grid_kernel(const NextGridArguments<T, D> a) {
  wait_for_kernel_before();
  constexpr int slots = kThreads / kBlockNodes<D>;  // at a time
  const int first = int(blockIdx.x) * slots + int(threadIdx.x) / kBlockNodes<D>, stride = int(gridDim.x) * slots,
            local = int(threadIdx.x) % kBlockNodes<D>;
  if (blockIdx.x == 0 && threadIdx.x == 0) {
    *a.next_drift = a.drift->next(a.particles, a.strays_of_activation);
    if (a.items_taken) *a.items_taken = 0;
  }
  for (int slot = first; slot < a.near_blocks; slot += stride)
    if (!take_node<Obstacles>(a, slot, local)) break;
  for (int slot = a.near_blocks + first; slot < a.update.max_blocks; slot += stride)
    if (!take_node<Obstacles>(a, slot, local)) break;
}

}  // namespace

template <class T, int D>
void next_grid(const NextGridArguments<T, D>& a, Stream stream) {
  if (a.update.max_blocks == 0) return;
  // A node for each thread, or for each that fits, and some more of them to go round.
  const unsigned most = 4 * unsigned(2048 / kThreads * device_attribute(cudaDevAttrMultiProcessorCount));
  const unsigned blocks =
      std::min(grid_size((int64_t(a.update.max_blocks) * kBlockNodes<D> + kThreads - 1) / kThreads), most);
  if (a.obstacles)
    launch_in_chain(next_grid_kernel<true, T, D>, blocks, kThreads, 0, stream, a);
  else
    launch_in_chain(next_grid_kernel<false, T, D>, blocks, kThreads, 0, stream, a);
}

MPM_INSTANTIATE(next_grid, NextGridArguments)

}  // namespace mpm::cuda
