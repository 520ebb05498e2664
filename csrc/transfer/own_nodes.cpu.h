#pragma once

#include "grid/grid_update.h"
#include "transfer/gather.cpu.h"
#include "transfer/scatter.cpu.h"

// Transfers of one particle, in any block, between its own fields and the nodes of the pool.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Rows of the pool with the nodes of one particle, in any block; line l has those that differ in the last axis.
template <int Order, class T, int D>
struct NodesOf {
  static constexpr int S = Order + 1, kLines = D == 3 ? S * S : S;
  int64_t row[kLines][S];

  NodesOf(const Topology<T, D>& t, int scene, const int base[D]) {
    int block[D][S], inside[D][S];  // index increments of nodes along an axis, in the table and in a block
    for (int a = D - 1, blocks = 1, nodes = 1; a >= 0; blocks *= t.geometry.blocks[a--], nodes *= kBlockWidth)
      for (int k = 0; k < S; k++) {
        block[a][k] = (base[a] + k) / kBlockWidth * blocks;
        inside[a][k] = (base[a] + k) % kBlockWidth * nodes;
      }
    const int* const table = t.table + int64_t(scene) * t.geometry.blocks_per_scene;
    for (int l = 0; l < kLines; l++) {
      const int i = l / S, j = l % S;
      const int first = block[D - 2][j] + (D == 3 ? block[0][i] : 0);
      const int local = inside[D - 2][j] + (D == 3 ? inside[0][i] : 0);
      for (int k = 0; k < S; k++)
        row[l][k] = int64_t(table[first + block[D - 1][k]]) * kBlockNodes<D> + local + inside[D - 1][k];
    }
  }
};

// Channels of one node side by side.
template <class T>
using Node = Pack<T, kChannels>;

template <class T, int D>
MPM_HD Node<T> load_node(const NodeRow<T, D>& row) {
  if constexpr (sizeof(row) == sizeof(Node<T>)) return Node<T>::load(&row.mass);
  T channels[kChannels] = {};
  __builtin_memcpy(channels, &row, sizeof(row));
  return Node<T>::load(channels);
}

template <class T, int D>
MPM_HD void add_to_node(NodeRow<T, D>& row, const Node<T>& sum) {
  if constexpr (sizeof(row) == sizeof(sum)) return (load_node(row) + sum).store(&row.mass);
  row.mass += sum[0];
  for (int i = 0; i < D; i++) row.value[i] += sum[1 + i];
}

// Rows of kChannels sums of nodes.
template <class T>
struct ChannelRow {
  T value[kChannels];
};

template <class T>
MPM_HD Node<T> load_node(const ChannelRow<T>& row) {
  return Node<T>::load(row.value);
}

template <class T>
MPM_HD void add_to_node(ChannelRow<T>& row, const Node<T>& sum) {
  (load_node(row) + sum).store(row.value);
}

// As sum_nodes, for one particle, all channels at once.
template <int Order, int Axis, bool Gradient, class Row, class T, int D>
MPM_HD Sums<Node<T>, D - Axis> sum_own_nodes(const Weights<Order, Node<T>, D>& s, const Row* rows,
                                             const NodesOf<Order, T, D>& nodes, int line = 0) {
  return sum_axis<Order, Axis, true, Gradient>(s, [&](int k) {
    if constexpr (Axis + 1 < D) {
      return sum_own_nodes<Order, Axis + 1, Gradient>(s, rows, nodes, nodes.S * line + k);
    } else {
      Sums<Node<T>, 0> node;
      node.value = load_node(rows[nodes.row[line][k]]);
      return node;
    }
  });
}

// Result of gather_channels, about the particle.
template <int Order, bool Gradient, class Row, class T, int D>
MPM_HD Sums<Node<T>, D> gather_own_nodes(const T f[D], const Row* rows, const NodesOf<Order, T, D>& nodes) {
  Node<T> distance[D];
  MPM_UNROLL for (int a = 0; a < D; a++)
    distance[a] = Node<T>(f[a]);
  const Weights<Order, Node<T>, D> s(distance, Gradient ? 1 : 0);
  Sums<Node<T>, D> sums = sum_own_nodes<Order, 0, Gradient>(s, rows, nodes);
  MPM_UNROLL for (int a = 0; a < D; a++)
    sums.moment[a] = sums.moment[a] - (distance[a] - Node<T>(1)) * sums.value;
  return sums;
}

// Sums of `Count` channels of a node from `First` on, each by itself.
template <int First, bool Gradient, class T, int D, int Count>
MPM_HD void split_channels(const Sums<Node<T>, D>& all, Sums<T, D> (&one)[Count]) {
  for (int c = 0; c < Count; c++) {
    one[c].value = all.value[First + c];
    for (int a = 0; a < D; a++) {
      one[c].moment[a] = all.moment[a][First + c];
      if (Gradient) one[c].gradient[a] = all.gradient[a][First + c];
    }
  }
}

// As sum_cell, for particle p.
template <int Order, bool Gradient, class Row, class T, int D>
MPM_HD void add_to_own_nodes(const Contributions<Order, T, D, true, Gradient>& g, int p, Row* rows,
                             const NodesOf<Order, T, D>& nodes) {
  using G = Contributions<Order, T, D, true, Gradient>;
  constexpr int S = Order + 1;
  const T* const row = g.row[p];
  const auto slope = [&](int axis) { return Node<T>::load(row + G::kSlope + axis * kChannels); };
  const auto gradient = [&](int axis) { return Node<T>::load(row + G::kGradient + axis * kChannels); };
  for (int l = 0; l < nodes.kLines; l++) {
    const int i = D == 3 ? l / S : 0, j = l % S;
    Node<T> value = at_node(j, Node<T>::load(row), slope(D - 2));
    if (D == 3) value = at_node(i, value, slope(0));
    const Node<T> weight(g.line[i][j][p]);
    const Node<T> first = weight * value, last = weight * slope(D - 1);
    Node<T> along(0), across(0);
    if constexpr (Gradient) {
      along = weight * gradient(D - 1);
      across = Node<T>(g.slope_y[i][j][p]) * gradient(D - 2);
      if constexpr (D == 3) across += Node<T>(g.slope_x[i][j][p]) * gradient(0);
    }
    for (int k = 0; k < S; k++) {
      Node<T> sum = Node<T>(g.weight[k][p]) * (at_node(k, first, last) + across);
      if constexpr (Gradient) sum += Node<T>(g.slope[k][p]) * along;
      add_to_node(rows[nodes.row[l][k]], sum);
    }
  }
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
