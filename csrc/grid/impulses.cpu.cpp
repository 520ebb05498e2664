#include "grid/impulses.h"

#include <algorithm>

#include "cpu/parallel.h"
#include "cpu/slot_sums.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 64;  // slots below which a range is not split

// Each slot has its own sums, which are added in the order of the slots, for any number of threads.
template <class T, int D, class SlotImpulses>
void add_up_impulses(const Geometry<T, D>& geometry, int max_blocks, const int* block, const ImpulseArguments<D>& a,
                     const SlotImpulses& slot_impulses) {
  const int numbers = a.numbers();
  parallel_ranges(max_blocks, kGrain, [&](int64_t begin, int64_t end) {
    std::fill(a.slots + begin * numbers, a.slots + end * numbers, 0.0);
    for (int64_t slot = begin; slot < end; slot++)
      slot_impulses(int(slot), [&](int, int boundary, const ImpulseSum<D>& sum) {
        std::copy_n(sum.e, kImpulse<D>, a.slots + slot * numbers + boundary * kImpulse<D>);
      });
  });
  add_up(a.slot_sums(max_blocks, geometry.blocks_per_scene, block));
}

}  // namespace

template <class T, int D>
void wall_impulses(const WallImpulsesArguments<T, D>& a) {
  add_up_impulses(a.update.geometry, a.update.max_blocks, a.update.block, a.impulse,
                  [&](int slot, auto&& put) { slot_wall_impulses<1>(a, slot, 0, put); });
}

template <class T, int D>
void contact_impulses(const ContactImpulsesArguments<T, D>& a) {
  add_up_impulses(a.contact.geometry, a.contact.max_blocks, a.contact.block, a.impulse,
                  [&](int slot, auto&& put) { slot_contact_impulses<1>(a, slot, 0, put); });
}

template <class T, int D>
void wall_impulses_backward(const WallImpulsesBackwardArguments<T, D>& a) {
  parallel_ranges(a.update.forward.max_blocks, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      const SlotUpdate<T, D> s = slot_update(a.update.forward, int(slot));
      const int64_t first = slot * kBlockNodes<D>;
      Vector<T, D> sum = zero_vector<T, D>(), change;
      for (int local = 0; local < kBlockNodes<D>; local++) {
        a.update.grad_nodes[first + local] =
            update_node_backward(a.update, s, local, first + local, change, ImpulsesOfRows<T, D>{a});
        sum = sum + change;
      }
      if (a.update.change) a.update.change[slot] = sum;
    }
  });
}

template <class T, int D>
void contact_impulses_backward(const ContactImpulsesArguments<T, D>& a) {
  parallel_ranges(a.contact.max_blocks, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++)
      slot_contact_backward<1>(a.contact, int(slot), 0, [](T x) { return x; }, ImpulsesOfNodes<T, D>{a});
  });
}

MPM_INSTANTIATE(wall_impulses, WallImpulsesArguments)
MPM_INSTANTIATE(wall_impulses_backward, WallImpulsesBackwardArguments)
MPM_INSTANTIATE(contact_impulses, ContactImpulsesArguments)
MPM_INSTANTIATE(contact_impulses_backward, ContactImpulsesArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
