#include "grid/contact.h"

#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "cpu/parallel.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 64;  // slots below which a range is not split

// What the nodes of a slot meet where obstacles rest. It is found once, and again when the slot has another block.
template <class T, int D>
class KnownSlot {
 public:
  // False where the obstacles of the scene move.
  bool find(const ContactArguments<T, D>& a, int slot) {
    const int block = a.block[slot];
    if (block == block_) return true;
    touches_.clear(), surfaces_.clear();
    block_ = kNone;
    if (block >= 0) {
      int corner[D];
      if (!obstacles_rest(a, block_coordinates(a.geometry, block, corner))) return false;
      find_nodes(SlotPoses<T, D>(a, slot));
    }
    block_ = block;
    return true;
  }

  void apply(const ContactArguments<T, D>& a, int slot) {
    const int64_t first = int64_t(slot) * kBlockNodes<D>;
    for (int local = 0; local < kBlockNodes<D>; local++)
      store_node(a.result, first + local, load_node<T, D>(a.velocity, a.stride, first + local));
    for (const auto& [local, touch] : touches_)
      if (has_mass(a, first + local)) change(a, first + local, touch);
    for (auto& [local, met] : surfaces_) {
      if (!has_mass(a, first + local)) continue;
      if (!met) met = search(SlotPoses<T, D>(a, slot), local);
      change(a, first + local, *met);
    }
  }

 private:
  static constexpr int kNone = -2;  // unused slots have block −1

  // The surfaces of nodes that meet several are searched once these nodes have mass.
  void find_nodes(const SlotPoses<T, D>& poses) {
    for (int local = 0; local < kBlockNodes<D> && poses.s.near; local++) {
      const NodeTouch<T, D> touch = touch_of_node(poses, node_position(poses.a, poses.s.corner, local));
      if (touch.obstacle >= 0) touches_.emplace_back(local, touch);
      if (touch.obstacle == touch.several) surfaces_.emplace_back(local, std::nullopt);
    }
  }
  static MetSurfaces<T, D> search(const SlotPoses<T, D>& poses, int local) {
    MetSurfaces<T, D> met;
    find_met(true, poses, node_position(poses.a, poses.s.corner, local), met);
    return met;
  }
  template <class Met>
  static void change(const ContactArguments<T, D>& a, int64_t node, const Met& met) {
    store_node(a.result, node, met.after(load_node<T, D>(a.velocity, a.stride, node)));
  }

  int block_ = kNone;
  std::vector<std::pair<int, NodeTouch<T, D>>> touches_;                    // nodes that meet one surface
  std::vector<std::pair<int, std::optional<MetSurfaces<T, D>>>> surfaces_;  // and several
};

// The known slots of a call of many substeps, made where they are missing; null in other calls.
template <class T, int D>
KnownSlot<T, D>* known_slots(const ContactArguments<T, D>& a) {
  using Slots = std::vector<KnownSlot<T, D>>;
  if (!a.known) return nullptr;
  auto& owner = *static_cast<std::shared_ptr<void>*>(a.known);
  if (!owner) owner = std::make_shared<Slots>();
  Slots& slots = *static_cast<Slots*>(owner.get());
  if (slots.size() < size_t(a.max_blocks)) slots.resize(size_t(a.max_blocks));
  return slots.data();
}

}  // namespace

template <class T, int D>
void contact(const ContactArguments<T, D>& a) {
  KnownSlot<T, D>* const known = known_slots(a);
  parallel_ranges(a.max_blocks, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      if (known && known[slot].find(a, int(slot)))
        known[slot].apply(a, int(slot));
      else
        slot_contact<1>(a, int(slot), 0);
    }
  });
}

template <class T, int D>
void contact_backward(const ContactArguments<T, D>& a) {
  parallel_ranges(a.max_blocks, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++)
      slot_contact_backward<1>(a, int(slot), 0, [](T x) { return x; }, NoImpulses());
  });
}

MPM_INSTANTIATE(contact, ContactArguments)
MPM_INSTANTIATE(contact_backward, ContactArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
