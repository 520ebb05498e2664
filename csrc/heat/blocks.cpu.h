#pragma once

#include "cpu/base_block.h"
#include "cpu/parallel.h"

// Loops over the blocks of the scenes, and their nodes.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// visit(scene, corner, slot) of each slot with a block of the scenes.
template <class T, int D, class F>
void for_blocks(const Topology<T, D>& t, const F& visit) {
  constexpr int64_t grain = 64;  // slots below which a range is not split
  parallel_ranges(t.max_blocks, grain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      const int block = t.block[slot];
      if (block < 0 || block / t.geometry.blocks_per_scene >= t.scenes) continue;
      const BaseBlock<T, D> base(t, int(slot));
      visit(base.scene, base.corner, slot);
    }
  });
}

// visit(scene, node) of the nodes of these blocks.
template <class T, int D, class F>
void for_nodes(const Topology<T, D>& t, const F& visit) {
  for_blocks(t, [&](int scene, const int (&)[D], int64_t slot) {
    for (int64_t i = slot * kBlockNodes<D>; i < (slot + 1) * kBlockNodes<D>; i++) visit(scene, i);
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
