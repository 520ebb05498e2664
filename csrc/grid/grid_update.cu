#include "cuda/programmatic_launch.cuh"
#include "grid/grid_update.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 256;
template <int D>
constexpr int kLanes = kBlockNodes<D> < 32 ? kBlockNodes<D> : 32;  // lanes of a warp that share a slot

template <class T, int D>
__global__ void __launch_bounds__(kThreads) grid_update_kernel(const GridUpdateArguments<T, D> a) {
  grid_dependency_sync();
  const int64_t node = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int slot = int(node / kBlockNodes<D>);
  if (slot >= a.max_blocks) return;
  a.updated[node] = update_node(a, slot_update(a, slot), int(node % kBlockNodes<D>), a.nodes[node]);
}

// A whole warp, or half of one in 2-D, works on a slot and sums over its nodes in a fixed order.
template <class T, int D>
__global__ void __launch_bounds__(kThreads) grid_update_backward_kernel(const GridUpdateBackwardArguments<T, D> a) {
  grid_dependency_sync();
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t slot = thread / kLanes<D>;
  const int lane = int(thread % kLanes<D>);
  Vector<T, D> sum = zero_vector<T, D>();
  if (slot < a.forward.max_blocks) {
    const SlotUpdate<T, D> s = slot_update(a.forward, int(slot));
#pragma unroll
    for (int local = lane; local < kBlockNodes<D>; local += kLanes<D>) {
      const int64_t node = slot * kBlockNodes<D> + local;
      Vector<T, D> change;
      a.grad_nodes[node] = update_node_backward(a, s, local, node, change, NoImpulses());
      sum = sum + change;
    }
  }
  if (!a.change) return;
#pragma unroll
  for (int i = 0; i < D; i++)
#pragma unroll
    for (int step = kLanes<D> / 2; step > 0; step /= 2)
      sum[i] += __shfl_down_sync(0xffffffffu, sum[i], step, kLanes<D>);
  if (slot < a.forward.max_blocks && lane == 0) a.change[slot] = sum;
}

unsigned blocks_for(int64_t max_blocks, int64_t threads_per_slot) {
  return unsigned((max_blocks * threads_per_slot + kThreads - 1) / kThreads);
}

}  // namespace

template <class T, int D>
void grid_update(const GridUpdateArguments<T, D>& a, Stream stream) {
  if (a.max_blocks == 0) return;
  launch_in_chain(grid_update_kernel<T, D>, blocks_for(a.max_blocks, kBlockNodes<D>), kThreads, 0, stream, a);
}

template <class T, int D>
void grid_update_backward(const GridUpdateBackwardArguments<T, D>& a, Stream stream) {
  if (a.forward.max_blocks == 0) return;
  launch_in_chain(grid_update_backward_kernel<T, D>, blocks_for(a.forward.max_blocks, kLanes<D>), kThreads, 0, stream,
                  a);
}

MPM_INSTANTIATE(grid_update, GridUpdateArguments)
MPM_INSTANTIATE(grid_update_backward, GridUpdateBackwardArguments)

}  // namespace mpm::cuda
