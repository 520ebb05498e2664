#pragma once

#include <type_traits>

#include "common/fields.h"
#include "common/pack.h"
#include "cpu/base_block.h"

// Private copies of the nodes in the support of one base block.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

constexpr int kChannels = 4;  // channels that are transferred together

// Nodes in the support of one base block, kChannels values each. Rows run along the last axis and are long enough to
// add four nodes anywhere.
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

  // visit(row, its first node in the pool, that kBlockWidth nodes further along the last axis); -1 in inactive blocks
  template <class F>
  MPM_HD static void for_rows(const BaseBlock<T, D>& base_block, const F& visit) {
    for (int row = 0; row < kRows; row++) {
      const int i = D == 3 ? row / kWidth : 0, j = row % kWidth;
      const int o = (D == 3 ? i / kBlockWidth * 4 : 0) + j / kBlockWidth * 2;
      const int inside = (i % kBlockWidth * kBlockWidth + j % kBlockWidth) * kBlockWidth;
      const auto node = [&](int slot) { return slot < 0 ? -1 : int64_t(slot) * kBlockNodes<D> + inside; };
      visit(row, node(base_block.slot[o]), node(base_block.slot[o + 1]));
    }
  }

  // visit(tile values, first node in the pool, nodes) for every run of nodes in an active block, `nodes` a constant
  template <class F>
  MPM_HD void for_runs(const BaseBlock<T, D>& base_block, const F& visit) {
    for_rows(base_block, [&](int row, int64_t low, int64_t high) {
      if (low >= 0) visit(value + row * kRow, low, std::integral_constant<int, kBlockWidth>());
      if (high >= 0) visit(value + row * kRow + kBlockWidth * kChannels, high, std::integral_constant<int, Order>());
    });
  }

  void clear() { __builtin_memset(value, 0, sizeof(value)); }

  // Reads channels first, ..., first + count - 1 of the nodes; zero for the other channels and inactive blocks.
  void load_from(const NodeField<const T>& nodes, const BaseBlock<T, D>& base_block, int first, int count) {
    const auto copy = [&]<int Channels>() {
      load_channels<Channels>({nodes.pointer + first, nodes.stride}, base_block);
    };
    if (count == 1) copy.template operator()<1>();
    if (count == 2) copy.template operator()<2>();
    if (count == 3) copy.template operator()<3>();
    if (count == 4) copy.template operator()<4>();
  }

  void add_to(const NodeField<T>& nodes, const BaseBlock<T, D>& base_block, int first, int count) {
    const bool whole = count == kChannels && nodes.stride == kChannels;
    for_runs(base_block, [&](const T* tile, int64_t node, auto n) {
      T* to = nodes.pointer + node * nodes.stride + first;
      if (whole) {
        if constexpr (n == 3) {  // of cubic splines, no pack
          for (int k = 0; k < n * kChannels; k++) to[k] += tile[k];
        } else {
          using Run = Pack<T, n * kChannels>;
          (Run::load(to) + Run::load(tile)).store(to);
        }
      } else {
        for (int k = 0; k < n; k++)
          for (int c = 0; c < count; c++) to[k * nodes.stride + c] += tile[k * kChannels + c];
      }
    });
  }

 private:
  template <int Channels>
  void load_channels(const NodeField<const T>& nodes, const BaseBlock<T, D>& base_block) {
#ifdef __AVX512VL__
    if constexpr (sizeof(T) == 4)
      if (nodes.stride == kChannels) {
        constexpr unsigned channels = ((1u << Channels) - 1) * 0x1111, order = (1u << Order * kChannels) - 1;
        using Half = Pack<T, kRow / 2>;
        return for_rows(base_block, [&](int row, int64_t low, int64_t high) {
          const auto load = [&](int64_t node, unsigned lanes) {
            return node < 0 ? Half(0) : Half(0).with(nodes.pointer + node * kChannels, lanes);
          };
          load(low, channels).store(value + row * kRow);
          load(high, channels & order).store(value + row * kRow + kRow / 2);
        });
      }
#endif
    clear();
    for_runs(base_block, [&](T* tile, int64_t node, auto n) {
      const T* from = nodes.pointer + node * nodes.stride;
      for (int k = 0; k < n; k++) __builtin_memcpy(tile + k * kChannels, from + k * nodes.stride, Channels * sizeof(T));
    });
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
