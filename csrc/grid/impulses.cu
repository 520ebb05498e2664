#include "grid/impulses.h"

#include "cuda/slot_sums.cuh"
#include "grid/slot_lanes.cuh"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

struct Place {
  int64_t slot;
  int lane;
};

__device__ Place place() {
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  return {thread / kSlotLanes, int(thread % kSlotLanes)};
}

// The sum over the lanes of a slot is stored for the slot, if there is a work space, or added to that of the scene.
template <int D>
__device__ void put(const ImpulseArguments<D>& a, int64_t slot, int lane, int scene, int boundary,
                    const ImpulseSum<D>& sum) {
  const int first = boundary * kImpulse<D>;
#pragma unroll
  for (int i = 0; i < kImpulse<D>; i++) {
    const double total = SumLanes()(sum.e[i]);
    if (lane > 0) continue;
    if (a.slots)
      a.slots[slot * a.boundaries * kImpulse<D> + first + i] = total;
    else if (total != 0)  // NaN too
      atomicAdd(a.sum + scene * a.scene_stride + first + i, total);
  }
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) wall_impulses_kernel(const WallImpulsesArguments<T, D> a) {
  const auto [slot, lane] = place();
  if (slot >= a.update.max_blocks) return;
  slot_wall_impulses<kSlotLanes>(a, int(slot), lane,
                                 [&, slot = slot, lane = lane](int scene, int face, const auto& sum) {
                                   put(a.impulse, slot, lane, scene, face, sum);
                                 });
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads)
    contact_impulses_kernel(const __grid_constant__ ContactImpulsesArguments<T, D> a) {
  const auto [slot, lane] = place();
  if (slot >= a.contact.max_blocks) return;
  slot_contact_impulses<kSlotLanes>(
      a, int(slot), lane,
      [&, slot = slot, lane = lane](int scene, int k, const auto& sum) { put(a.impulse, slot, lane, scene, k, sum); });
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) wall_impulses_backward_kernel(const WallImpulsesBackwardArguments<T, D> a) {
  const auto [slot, lane] = place();
  if (slot >= a.update.forward.max_blocks) return;
  const SlotUpdate<T, D> s = slot_update(a.update.forward, int(slot));
  Vector<T, D> sum = zero_vector<T, D>(), change;
  for (int local = lane; local < kBlockNodes<D>; local += kSlotLanes) {
    const int64_t node = slot * kBlockNodes<D> + local;
    a.update.grad_nodes[node] = update_node_backward(a.update, s, local, node, change, ImpulsesOfRows<T, D>{a});
    sum = sum + change;
  }
  if (!a.update.change) return;
#pragma unroll
  for (int i = 0; i < D; i++) sum[i] = SumLanes()(sum[i]);
  if (lane == 0) a.update.change[slot] = sum;
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads)
    contact_impulses_backward_kernel(const __grid_constant__ ContactImpulsesArguments<T, D> a) {
  const auto [slot, lane] = place();
  if (slot >= a.contact.max_blocks) return;
  slot_contact_backward<kSlotLanes>(a.contact, int(slot), lane, SumLanes(), ImpulsesOfNodes<T, D>{a});
}

unsigned blocks_for(int64_t max_blocks) { return unsigned((max_blocks * kSlotLanes + kThreads - 1) / kThreads); }

// Launches `kernel`, and adds up its sums of the slots.
template <class Kernel, class Arguments, class T, int D>
void run(Kernel* kernel, const Arguments& arguments, const ImpulseArguments<D>& a, const Geometry<T, D>& geometry,
         int max_blocks, const int* block, Stream stream) {
  if (max_blocks == 0 || a.scenes == 0) return;
  if (a.slots) check(cudaMemsetAsync(a.slots, 0, size_t(max_blocks) * size_t(a.numbers()) * sizeof(double), stream));
  launch(kernel, blocks_for(max_blocks), kThreads, 0, stream, arguments);
  if (a.slots) add_up(a.slot_sums(max_blocks, geometry.blocks_per_scene, block), stream);
}

}  // namespace

template <class T, int D>
void wall_impulses(const WallImpulsesArguments<T, D>& a, Stream stream) {
  run(wall_impulses_kernel<T, D>, a, a.impulse, a.update.geometry, a.update.max_blocks, a.update.block, stream);
}

template <class T, int D>
void contact_impulses(const ContactImpulsesArguments<T, D>& a, Stream stream) {
  run(contact_impulses_kernel<T, D>, a, a.impulse, a.contact.geometry, a.contact.max_blocks, a.contact.block, stream);
}

template <class T, int D>
void wall_impulses_backward(const WallImpulsesBackwardArguments<T, D>& a, Stream stream) {
  if (a.update.forward.max_blocks == 0) return;
  launch(wall_impulses_backward_kernel<T, D>, blocks_for(a.update.forward.max_blocks), kThreads, 0, stream, a);
}

template <class T, int D>
void contact_impulses_backward(const ContactImpulsesArguments<T, D>& a, Stream stream) {
  if (a.contact.max_blocks == 0) return;
  launch(contact_impulses_backward_kernel<T, D>, blocks_for(a.contact.max_blocks), kThreads, 0, stream, a);
}

MPM_INSTANTIATE(wall_impulses, WallImpulsesArguments)
MPM_INSTANTIATE(wall_impulses_backward, WallImpulsesBackwardArguments)
MPM_INSTANTIATE(contact_impulses, ContactImpulsesArguments)
MPM_INSTANTIATE(contact_impulses_backward, ContactImpulsesArguments)

}  // namespace mpm::cuda
