#include "grid/grid_update.h"

#include <type_traits>

#include "cpu/parallel.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

template <int D>
constexpr int64_t kGrain = 4096 / kBlockNodes<D>;  // slots below which a range is not split

// A slot that no face acts on, as a constant for the compiler, so that it vectorises over the nodes.
template <class T, int D>
MPM_HD SlotUpdate<T, D> free_of_walls(SlotUpdate<T, D> s) {
  s.active = true;
  s.walled = s.mirrored = false;
  return s;
}

template <class T, int D>
MPM_HD void update_nodes(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int64_t slot) {
  const NodeRow<T, D>* const from = a.nodes + slot * kBlockNodes<D>;
  NodeRow<T, D>* const to = a.updated + slot * kBlockNodes<D>;
#pragma GCC ivdep
  for (int local = 0; local < kBlockNodes<D>; local++) to[local] = update_node(a, s, local, from[local]);
}

// Whether the nodes of a slot have neither mass nor momentum, as most of the slots around a small scene.
template <class T, int D>
MPM_HD bool is_empty(const NodeRow<T, D>* nodes) {
  using Bits = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
  const T* const values = reinterpret_cast<const T*>(nodes);
  Bits any = 0;
  for (int k = 0; k < kBlockNodes<D> * (1 + D); k++) any |= __builtin_bit_cast(Bits, values[k]);
  return any == 0;
}

template <class T, int D>
MPM_HD void update_slot(const GridUpdateArguments<T, D>& a, int64_t slot) {
  if (!a.walls.mirrored && is_empty(a.nodes + slot * kBlockNodes<D>)) {  // images may have mass
    __builtin_memset(static_cast<void*>(a.updated + slot * kBlockNodes<D>), 0, kBlockNodes<D> * sizeof(NodeRow<T, D>));
    return;
  }
  const SlotUpdate<T, D> s = slot_update(a, int(slot));
  s.active && !s.walled && !s.mirrored ? update_nodes(a, free_of_walls(s), slot) : update_nodes(a, s, slot);
}

}  // namespace

template <class T, int D>
void grid_update(const GridUpdateArguments<T, D>& a) {
  parallel_ranges(a.max_blocks, kGrain<D>, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) update_slot(a, slot);
  });
}

template <class T, int D>
void grid_update_backward(const GridUpdateBackwardArguments<T, D>& a) {
  parallel_ranges(a.forward.max_blocks, kGrain<D>, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      const SlotUpdate<T, D> s = slot_update(a.forward, int(slot));
      const int64_t first = slot * kBlockNodes<D>;
      Vector<T, D> sum = zero_vector<T, D>(), change;
      for (int local = 0; local < kBlockNodes<D>; local++) {
        a.grad_nodes[first + local] = update_node_backward(a, s, local, first + local, change, NoImpulses());
        sum = sum + change;
      }
      if (a.change) a.change[slot] = sum;
    }
  });
}

MPM_INSTANTIATE(grid_update, GridUpdateArguments)
MPM_INSTANTIATE(grid_update_backward, GridUpdateBackwardArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
