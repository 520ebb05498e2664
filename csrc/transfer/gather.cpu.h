#pragma once

#include "common/bspline.h"
#include "cpu/parallel.h"
#include "transfer/contribution.cpu.h"

// Nodes to particles: sums over the nodes of a cell for a pack of its particles, one axis after another (sum
// factorisation), so that the work is the nodes of a line, plus lines of a plane, plus planes.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Weights of a pack of particles in one cell, and their derivatives where needed.
template <int Order, class P, int D>
struct Weights {
  static constexpr int S = Order + 1;
  P f[D], w[D][S], dw[D][S], ddw[D][S];

  // For particles at distances f from their base nodes, in cells.
  MPM_HD Weights(const P distances[D], int derivatives) {
    MPM_UNROLL for (int a = 0; a < D; a++) {
      f[a] = distances[a];
      BSpline<Order>::weights(f[a], w[a]);
      if (derivatives > 0) BSpline<Order>::first_derivatives(f[a], dw[a]);
      if (derivatives > 1) BSpline<Order>::second_derivatives(f[a], ddw[a]);
    }
  }
};

// Σ N g, Σ N g k and Σ g ∂N over the axes from D − N on; k counts from the second node of an axis.
template <class P, int N>
struct Sums {
  P value, moment[N ? N : 1], gradient[N ? N : 1];
};

// From the sums line(k) over the axes after `Axis`.
template <int Order, int Axis, bool Moment, bool Gradient, class P, int D, class F>
MPM_HD Sums<P, D - Axis> sum_axis(const Weights<Order, P, D>& s, const F& line) {
  constexpr int N = D - Axis;
  Sums<P, N> r;
  P first;
  MPM_UNROLL for (int k = 0; k <= Order; k++) {
    const Sums<P, N - 1> next = line(k);
    const P& w = s.w[Axis][k];
    const P part = w * next.value;
    r.value = k ? r.value + part : part;
    if (Moment) {
      if (k == 0) first = part;
      if (k == 2) r.moment[0] = part - first;
      if (k == 3) r.moment[0] += P(2) * part;
      MPM_UNROLL for (int a = 1; a < N; a++)
        r.moment[a] = k ? r.moment[a] + w * next.moment[a - 1] : w * next.moment[a - 1];
    }
    if (Gradient) {
      const P slope = s.dw[Axis][k] * next.value;
      r.gradient[0] = k ? r.gradient[0] + slope : slope;
      MPM_UNROLL for (int a = 1; a < N; a++)
        r.gradient[a] = k ? r.gradient[a] + w * next.gradient[a - 1] : w * next.gradient[a - 1];
    }
  }
  return r;
}

// For one channel.
template <int Order, int Axis, bool Moment, bool Gradient, class T, int D>
MPM_HD Sums<Lanes<T>, D - Axis> sum_nodes(const Weights<Order, Lanes<T>, D>& s, const T* tile) {
  constexpr int stride = Tile<Order, T, D>::stride(Axis);
  return sum_axis<Order, Axis, Moment, Gradient>(s, [&](int k) {
    if constexpr (Axis + 1 < D) {
      return sum_nodes<Order, Axis + 1, Moment, Gradient>(s, tile + k * stride);
    } else {
      Sums<Lanes<T>, 0> node;
      node.value = Lanes<T>(tile[k * stride]);
      return node;
    }
  });
}

// Value Σ N g, moment Σ N g r and gradient Σ g ∂N of the first `Channels` channels, with distances r from the particle.
template <int Order, int Channels, bool Moment, bool Gradient, class T, int D>
MPM_HD void gather_channels(const Lanes<T> f[D], const T* tile, Sums<Lanes<T>, D> sums[Channels]) {
  using P = Lanes<T>;
  const Weights<Order, P, D> s(f, Gradient ? 1 : 0);
  MPM_UNROLL for (int c = 0; c < Channels; c++) {
    sums[c] = sum_nodes<Order, 0, Moment, Gradient>(s, tile + c);
    if (Moment) MPM_UNROLL
      for (int a = 0; a < D; a++) sums[c].moment[a] = sums[c].moment[a] - (f[a] - P(1)) * sums[c].value;
  }
}

// The form u = Σ_i N_i g_i · (value + slope k_i) + Σ_d ∂_d N_i g_i · gradient_d of node values g and a particle's
// contribution, over the axes from `Axis` on; its derivatives `du` by position along these; and psi_d = Σ_i N_i g_i ·
// gradient_d of the previous axes with its derivatives, from which the sums over the previous axes compute more of u.
template <class P, int D, int Axis>
struct Form {
  static constexpr int N = D - Axis;
  P u, du[N ? N : 1], psi[Axis ? Axis : 1], dpsi[Axis ? Axis : 1][N ? N : 1];
};

// Form at one node, of the first `Channels` channels.
template <int Channels, bool Gradient, class T, int D>
MPM_HD Form<Lanes<T>, D, D> form_at_node(const Contribution<Lanes<T>, D>& contribution, const T* node) {
  using P = Lanes<T>;
  Form<P, D, D> r;
  r.u = P(node[0]) * contribution.value[0];
  MPM_UNROLL for (int c = 1; c < Channels; c++)
    r.u += P(node[c]) * contribution.value[c];
  if (!Gradient) return r;
  MPM_UNROLL for (int d = 0; d < D; d++) {
    r.psi[d] = P(node[0]) * contribution.gradient[d][0];
    MPM_UNROLL for (int c = 1; c < Channels; c++)
      r.psi[d] += P(node[c]) * contribution.gradient[d][c];
  }
  return r;
}

// `contribution` holds the contribution at the first node of the axis.
template <int Order, int Axis, int Channels, bool Slope, bool Gradient, class T, int D>
MPM_HD Form<Lanes<T>, D, Axis> form(const Weights<Order, Lanes<T>, D>& s, Contribution<Lanes<T>, D> contribution,
                                    const T* tile) {
  using P = Lanes<T>;
  constexpr int N = D - Axis, stride = Tile<Order, T, D>::stride(Axis);
  Form<P, D, Axis> r;
  r.u = P(0);
  MPM_UNROLL for (int a = 0; a < N; a++)
    r.du[a] = P(0);
  MPM_UNROLL for (int d = 0; d < Axis; d++) {
    r.psi[d] = P(0);
    MPM_UNROLL for (int a = 0; a < N; a++)
      r.dpsi[d][a] = P(0);
  }
  const auto add = [&](int k) {
    Form<P, D, Axis + 1> line;
    if constexpr (Axis + 1 < D)
      line = form<Order, Axis + 1, Channels, Slope, Gradient>(s, contribution, tile + k * stride);
    else
      line = form_at_node<Channels, Gradient>(contribution, tile + k * stride);
    if (Slope) MPM_UNROLL
      for (int c = 0; c < Channels; c++) contribution.value[c] += contribution.slope[Axis][c];
    const P &w = s.w[Axis][k], &dw = s.dw[Axis][k];
    r.u += w * line.u;
    r.du[0] += dw * line.u;
    MPM_UNROLL for (int a = 1; a < N; a++)
      r.du[a] += w * line.du[a - 1];
    if (!Gradient) return;
    r.u += dw * line.psi[Axis];
    r.du[0] += s.ddw[Axis][k] * line.psi[Axis];
    MPM_UNROLL for (int a = 1; a < N; a++)
      r.du[a] += dw * line.dpsi[Axis][a - 1];
    MPM_UNROLL for (int d = 0; d < Axis; d++) {
      r.psi[d] += w * line.psi[d];
      r.dpsi[d][0] += dw * line.psi[d];
      MPM_UNROLL for (int a = 1; a < N; a++)
        r.dpsi[d][a] += w * line.dpsi[d][a - 1];
    }
  };
  if constexpr (Axis == 0 || (Gradient && Axis + 1 < D)) {  // loops reduce the code size
    _Pragma("GCC unroll 1") for (int k = 0; k <= Order; k++) add(k);
  } else {
    MPM_UNROLL for (int k = 0; k <= Order; k++)
      add(k);
  }
  return r;
}

// Adds the derivative of the form by the position, in cells; needs first derivatives of the weights, second with
// Gradient.
template <int Order, int Channels, bool Slope, bool Gradient, class T, int D>
MPM_HD void add_position_gradient(const Weights<Order, Lanes<T>, D>& s, const Contribution<Lanes<T>, D>& contribution,
                                  const T* tile, const Lanes<T> gathered[kChannels], Lanes<T> sum[D]) {
  const Form<Lanes<T>, D, 0> r = form<Order, 0, Channels, Slope, Gradient>(s, contribution, tile);
  MPM_UNROLL for (int a = 0; a < D; a++) {
    sum[a] += r.du[a];
    if (Slope)  // the distance of every node changes with the particle
        MPM_UNROLL
      for (int c = 0; c < Channels; c++) sum[a] = sum[a] - gathered[c] * contribution.slope[a][c];
  }
}

// Chunk by chunk: begin() returns for each thread a function of (base block, chunk, next chunk, tile), where the tile
// holds channels first, ..., first + count - 1.
template <int Order, class T, int D, class F>
void gather_chunks(const Topology<T, D>& t, const NodeField<const T>& nodes, int first, int count, const F& begin) {
  const ScheduleIn s = schedule_of(t);
  const int64_t chunks = s.base_chunk[s.colour_start[kColours<D>]];
  parallel_base_blocks<D>(s, t.particles, [&](const auto& next) {
    auto gather = begin();
    Tile<Order, T, D> tile;
    for (int64_t b; (b = next()) >= 0;) {
      const BaseBlock<T, D> base_block(t, s.base_slot[b]);
      tile.load_from(nodes, base_block, first, count);
      for (int64_t c = s.base_chunk[b]; c < s.base_chunk[b + 1]; c++)
        gather(base_block, Chunk(t, s, c), Chunk(t, s, c + 1 < chunks ? c + 1 : c), tile);
    }
  });
}

// visit(group, its first index in the order of cells, distances from the base node in cells, tile at the base node) for
// groups of particles of a cell.
template <int Order, class T, int D, class F>
MPM_HD void for_groups_of_cells(const Topology<T, D>& t, const Field<const T>& x, const BaseBlock<T, D>& base_block,
                                const Chunk& chunk, const Tile<Order, T, D>& tile, const F& visit) {
  for (int cell = 0, i = 0; cell < kBlockNodes<D>; cell++) {
    int base[D];
    for (int a = 0; a < D; a++) base[a] = cell_coordinate<D>(cell, a);
    for (const int end = chunk.cell_end[cell]; i < end; i += kLanes) {
      const Group g = group_by_cell(chunk, i, end);
      Lanes<T> f[D];
      MPM_UNROLL for (int a = 0; a < D; a++)
        f[a] = distance_in_cells(t.geometry, a, load(x, g, a), Lanes<T>(T(base_block.corner[a] + base[a])));
      const T* at = tile.value + tile.at(base);
      // Most cells have one group: node values that the compiler keeps for a second one would be spilled to the stack.
      asm volatile("" : "+r"(at));
      visit(g, i, f, at);
    }
    i = chunk.cell_end[cell];
  }
}

// visit(group, distances from the base node in cells, scene, tile at the base node) for groups of particles of a cell;
// the tile holds channels first, ..., first + count - 1.
template <int Order, class T, int D, class F>
void gather_groups(const Topology<T, D>& t, const Field<const T>& x, const NodeField<const T>& nodes, int first,
                   int count, const F& visit) {
  const auto gather = [&](const BaseBlock<T, D>& base_block, const Chunk& chunk, const Chunk&,
                          const Tile<Order, T, D>& tile) {
    for_groups_of_cells(t, x, base_block, chunk, tile, [&](const Group& g, int, const Lanes<T> f[D], const T* at) {
      visit(g, f, base_block.scene, at);
    });
  };
  gather_chunks<Order>(t, nodes, first, count, [&] { return gather; });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
