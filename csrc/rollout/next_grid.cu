#include "rollout/next_grid.h"

#include "cuda/fixed_point.cuh"
#include "cuda/programmatic_launch.cuh"
#include "grid/contact.h"

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

// A node of a slot, with its data that do not depend on P2G.
template <class T, int D>
struct Node {
  int slot, local;
  SlotUpdate<T, D> there;
  NodeTouch<T, D> touch;

  __device__ int64_t row() const { return int64_t(slot) * kBlockNodes<D> + local; }
  __device__ bool is_in_use() const { return there.active; }
  __device__ NodeRow<T, D> sums(const NextGridArguments<T, D>& a) const {
    return NodeRows<T, D>(a.update.nodes, a.fixed).at(row());
  }

  // Without its obstacles, which those alone need that have mass.
  __device__ void find(const NextGridArguments<T, D>& a, int at) {
    slot = at;
    there = slot_update(a.update, slot);
    touch.obstacle = NodeTouch<T, D>::none;
  }
  __device__ void find_obstacles(const NextGridArguments<T, D>& a) {
    touch = lone_touch(a.contact, there.scene, there.corner, local);
  }
};

template <class T, int D>
__device__ void watch(const NextGridArguments<T, D>& a, const SlotUpdate<T, D>& there, const NodeRow<T, D>& row) {
  if (a.watched && goes_far(a.update, there, row)) atomicOr(&a.watched->lost, Displacement::kLost);
}

// Returns whether the node meets several surfaces; it has its velocity before contact then.
template <bool Obstacles, class T, int D>
__device__ bool take_node(const NextGridArguments<T, D>& a, const Node<T, D>& node) {
  NodeRow<T, D> row = update_node(a.update, node.there, node.local, node.sums(a));
  bool several = false;
  if constexpr (Obstacles) {
    several = row.mass != T(0) && node.touch.obstacle == node.touch.several;
    if (row.mass != T(0) && node.touch.obstacle >= 0) row.value = node.touch.after(row.value);
  }
  if (!several) watch(a, node.there, row);
  a.update.updated[node.row()] = row;
  if (a.emptied) NodeRows<T, D>::empty(a.emptied, node.row(), a.fixed);
  return several;
}

// The slots of a thread, in strides of the grid, so that a mostly unused pool costs nothing: the used slots come first,
// and likewise those of the margin.
struct SlotsInStrides {
  int near, all, stride;

  template <class T, int D>
  __device__ explicit SlotsInStrides(const NextGridArguments<T, D>& a)
      : near(a.near_blocks), all(a.update.max_blocks), stride(int(gridDim.x) * kThreads / kBlockNodes<D>) {}
  template <int D>
  __device__ static int first() {
    return (int(blockIdx.x) * kThreads + int(threadIdx.x)) / kBlockNodes<D>;
  }
  __device__ int after(int slot, bool used) const {
    if (used) return slot + stride;
    return slot < near ? slot + (near - 1 - slot) / stride * stride + stride
                       : all;  // the next one may be of the margin
  }
};

// Contact of the nodes of a thread that meet several surfaces, from their stored velocities before that. By all threads
// of a warp.
template <class T, int D>
__device__ __noinline__ void add_contact(const NextGridArguments<T, D>& a, const SeveralNodes& several) {
  const SlotsInStrides slots(a);
  const int local = int(threadIdx.x) % kBlockNodes<D>;
  int slot = slots.first<D>();
  for (int turn = 0; any_of_warp(slot < slots.all); turn++) {
    NodeRow<T, D>* const stored = a.update.updated + (int64_t(slot) * kBlockNodes<D> + local);
    SlotUpdate<T, D> there;
    NodeRow<T, D> row{T(0), zero_vector<T, D>()};
    bool used = slot < slots.all;
    if (used) there = slot_update(a.update, slot), used = there.active;
    if (used && several.may_have(turn)) row = *stored;
    if (meet_several(several, turn, row.mass != T(0), a.contact, there.scene, there.corner, local, row.value))
      watch(a, there, row), *stored = row;
    if (slot < slots.all) slot = slots.after(slot, used);
  }
}

// Least number of blocks of a multiprocessor. Without obstacles the kernel waits for memory, and more threads hide that
// better than more loads of each thread.
template <bool Obstacles, class T>
constexpr int kLeastBlocks = Obstacles ? (sizeof(T) == 4 ? 2 : 1) : (sizeof(T) == 4 ? 5 : 3);

// The place of the first node of a thread, and the obstacle that touches it, are found during P2G.
template <bool Obstacles, class T, int D>
__global__ void __launch_bounds__(kThreads, kLeastBlocks<Obstacles, T>)
    next_grid_kernel(const __grid_constant__ NextGridArguments<T, D> a) {
  const SlotsInStrides slots(a);
  const int first = slots.first<D>();
  Node<T, D> node;
  node.local = int(threadIdx.x) % kBlockNodes<D>;
  int found = -1;
  if (a.particles > 0 && first < slots.all) {  // without particles the previous kernel is the activation
    found = first;
    node.find(a, found);
    if (Obstacles && node.is_in_use()) node.find_obstacles(a);
  }
  grid_dependency_sync();
  if (blockIdx.x == 0 && threadIdx.x == 0) {
    Displacement next = a.displacement->next(a.particles, a.out_of_block_cost);
    if (a.next_displacement->requested) next.lost = Displacement::kLost;
    *a.next_displacement = next;
    if (a.items_taken) *a.items_taken = 0;
  }
  SeveralNodes several;
  for (int slot = first, turn = 0; slot < slots.all; slot = slots.after(slot, node.is_in_use()), turn++) {
    if (slot != found) {
      node.find(a, slot);
      if (Obstacles && node.is_in_use() && node.sums(a).mass != T(0)) node.find_obstacles(a);
    }
    if (node.is_in_use() && take_node<Obstacles>(a, node)) several.add(turn);
  }
  if constexpr (Obstacles)
    if (any_of_warp(several.any())) add_contact(a, several);
}

}  // namespace

template <class T, int D>
void next_grid(const NextGridArguments<T, D>& a, Stream stream) {
  if (a.update.max_blocks == 0) return;
  // A thread for each node, or as many as fit, with some more to balance the load.
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
