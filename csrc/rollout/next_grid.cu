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
  LoneNode<T, D> contact;

  __device__ int64_t row() const { return int64_t(slot) * kBlockNodes<D> + local; }
  __device__ bool is_in_use() const { return there.active; }
  __device__ NodeRow<T, D> sums(const NextGridArguments<T, D>& a) const {
    return NodeRows<T, D>(a.update.nodes, a.fixed).at(row());
  }

  // Without its obstacles, which those alone need that have mass.
  __device__ void find(const NextGridArguments<T, D>& a, int at) {
    slot = at;
    there = slot_update(a.update, slot);
    contact.touch.obstacle = NodeTouch<T, D>::none;
  }
  __device__ void find_obstacles(const NextGridArguments<T, D>& a) {
    contact.find(a.contact, there.scene, there.corner, local);
  }
};

// By all threads of a warp, also of nodes that are not used.
template <bool Obstacles, class T, int D>
__device__ void take_node(bool used, const NextGridArguments<T, D>& a, const Node<T, D>& node) {
  NodeRow<T, D> row{T(0), zero_vector<T, D>()};
  if (used) row = update_node(a.update, node.there, node.local, node.sums(a));
  if constexpr (Obstacles) node.contact.apply(row.mass != T(0), a.contact, node.local, row.value);
  if (!used) return;
  if (a.watched && goes_far(a.update, node.there, row)) atomicOr(&a.watched->lost, Displacement::kLost);
  a.update.updated[node.row()] = row;
  if (a.emptied) NodeRows<T, D>::empty(a.emptied, node.row(), a.fixed);
}

// In strides of the grid, so that a mostly unused pool costs nothing: the used slots come first, and likewise those of
// the margin. The place of the first node of a thread, and the obstacle that touches it, are found during P2G.
template <bool Obstacles, class T, int D>
__global__ void __launch_bounds__(kThreads) next_grid_kernel(const __grid_constant__ NextGridArguments<T, D> a) {
  constexpr int slots = kThreads / kBlockNodes<D>;  // at a time
  const int first = int(blockIdx.x) * slots + int(threadIdx.x) / kBlockNodes<D>, stride = int(gridDim.x) * slots;
  Node<T, D> node;
  node.local = int(threadIdx.x) % kBlockNodes<D>;
  int found = -1;
  if (a.particles > 0 && first < a.update.max_blocks) {  // without particles the previous kernel is the activation
    found = first;
    node.find(a, found);
    if (Obstacles && node.is_in_use()) node.find_obstacles(a);
  }
  grid_dependency_sync();
  if (blockIdx.x == 0 && threadIdx.x == 0) {
    *a.next_displacement = a.displacement->next(a.particles);
    if (a.items_taken) *a.items_taken = 0;
  }
  for (int slot = first; any_of_warp(slot < a.update.max_blocks); slot += stride) {
    const bool exists = slot < a.update.max_blocks;
    if (exists && slot != found) {
      node.find(a, slot);
      if (Obstacles && node.is_in_use() && node.sums(a).mass != T(0)) node.find_obstacles(a);
    }
    const bool used = exists && node.is_in_use();
    take_node<Obstacles>(used, a, node);
    if (used) continue;
    if (slot < a.near_blocks)
      slot += (a.near_blocks - 1 - slot) / stride * stride;  // the next one may be of the margin
    else
      slot = a.update.max_blocks;
  }
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
