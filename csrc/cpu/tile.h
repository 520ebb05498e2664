#pragma once

#include "common/fields.h"
#include "cpu/base_block.h"

// Private copies of the nodes that the particles of one base block touch.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

constexpr int kChannels = 4;  // channels that are transferred together

// Nodes that the particles of one base block touch, kChannels values each. Rows run along the last axis and are long
// enough to add four nodes anywhere.
template <int Order, class T, int D>
struct Tile {
  static constexpr int kWidth = kBlockWidth + Order, kRow = 2 * kBlockWidth * kChannels;
  static constexpr int kRows = D == 3 ? kWidth * kWidth : kWidth;
  alignas(64) T value[kRows * kRow];

  static constexpr int stride(int axis) { return axis == D - 1 ? kChannels : axis == D - 2 ? kRow : kWidth * kRow; }
  static int at(const int node[D]) {
    int r = 0;
    for (int i = 0; i < D; i++) r += node[i] * stride(i);
    return r;
  }

  // visit(tile values, node row of the pool, nodes) for every run of nodes in an active block
  template <class F>
  MPM_HD void for_runs(const BaseBlock<T, D>& base_block, const F& visit) {
    for (int row = 0; row < kRows; row++) {
      const int i = D == 3 ? row / kWidth : 0, j = row % kWidth;
      const int o = (D == 3 ? i / kBlockWidth * 4 : 0) + j / kBlockWidth * 2;
      const int inside = (i % kBlockWidth * kBlockWidth + j % kBlockWidth) * kBlockWidth;
      const int low = base_block.slot[o], high = base_block.slot[o + 1];
      if (low >= 0) visit(value + row * kRow, int64_t(low) * kBlockNodes<D> + inside, kBlockWidth);
      if (high >= 0)
        visit(value + row * kRow + kBlockWidth * kChannels, int64_t(high) * kBlockNodes<D> + inside, Order);
    }
  }

  void clear() { __builtin_memset(value, 0, sizeof(value)); }

  // Reads channels first, ..., first + count - 1 of the nodes; zero for the other channels and inactive blocks.
  void load_from(const NodeField<const T>& nodes, const BaseBlock<T, D>& base_block, int first, int count) {
    clear();
    const auto copy = [&]<int Channels>() {
      for_runs(base_block, [&](T* tile, int64_t row, int n) {
        const T* from = nodes.pointer + row * nodes.stride + first;
        for (int k = 0; k < n; k++)
          __builtin_memcpy(tile + k * kChannels, from + k * nodes.stride, Channels * sizeof(T));
      });
    };
    if (count == 1) copy.template operator()<1>();
    if (count == 2) copy.template operator()<2>();
    if (count == 3) copy.template operator()<3>();
    if (count == 4) copy.template operator()<4>();
  }

  void add_to(const NodeField<T>& nodes, const BaseBlock<T, D>& base_block, int first, int count) {
    for_runs(base_block, [&](T* tile, int64_t row, int n) {
      T* to = nodes.pointer + row * nodes.stride + first;
      if (count == kChannels && nodes.stride == kChannels)
        for (int k = 0; k < n * kChannels; k++) to[k] += tile[k];
      else
        for (int k = 0; k < n; k++)
          for (int c = 0; c < count; c++) to[k * nodes.stride + c] += tile[k * kChannels + c];
    });
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
