#pragma once

#include "common/bspline.h"
#include "cpu/parallel.h"
#include "cpu/transpose.h"
#include "transfer/contribution.cpu.h"

// Particles to nodes, for up to kChannels channels. The particles of a cell share their nodes, so that their
// contributions are summed in registers before they are added to the tile of the base block.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Particles of a chunk, ready to be summed.
template <int Order, class T, int D, bool Slope, bool Gradient>
struct Contributions {
  static constexpr int S = Order + 1;
  static constexpr int kSlope = kChannels, kGradient = kChannels * (Slope ? 1 + D : 1);
  static constexpr int kFields = kGradient + (Gradient ? kChannels * D : 0);
  static constexpr int kPadded = (kFields + kLanes - 1) / kLanes * kLanes;
  static constexpr int kLine = kChunk + 16;  // not a power of two, so that the arrays do not share cache sets
  static constexpr int kPlanes = D == 3 ? S : 1, kSlopeLine = Gradient ? kLine : 1;
  alignas(64) T row[kChunk][kPadded];  // value about the second node, slopes, gradients
  // For the lines of nodes along the last axis: products of the other axes, and with one derivative.
  alignas(64) T line[kPlanes][S][kLine];
  alignas(64) T slope_x[kPlanes][S][D == 3 ? kSlopeLine : 1], slope_y[kPlanes][S][kSlopeLine];
  alignas(64) T weight[S][kLine], slope[S][kSlopeLine];  // of the last axis

  template <int N>
  void put(int i, const Pack<T, N> f[D], const Contribution<Pack<T, N>, D>& contribution) {
    using P = Pack<T, N>;
    P field[kPadded];
    MPM_UNROLL for (int c = 0; c < kChannels; c++) {
      field[c] = contribution.value[c];
      MPM_UNROLL for (int a = 0; a < D; a++) {
        if (Slope) field[kSlope + a * kChannels + c] = contribution.slope[a][c];
        if (Slope) field[c] += contribution.slope[a][c];
        if (Gradient) field[kGradient + a * kChannels + c] = contribution.gradient[a][c];
      }
    }
    MPM_UNROLL for (int k = kFields; k < kPadded; k++)
      field[k] = P(0);
    store_transposed<kPadded>(field, row[i], kPadded);
    P w[D][S], dw[D][S];
    MPM_UNROLL for (int a = 0; a < D; a++) {
      BSpline<Order>::weights(f[a], w[a]);
      if (Gradient) BSpline<Order>::first_derivatives(f[a], dw[a]);
    }
    MPM_UNROLL for (int k = 0; k < S; k++) {
      w[D - 1][k].store(&weight[k][i]);
      if (Gradient) dw[D - 1][k].store(&slope[k][i]);
      MPM_UNROLL for (int m = 0; m < kPlanes; m++) {
        const P& x = D == 3 ? w[0][m] : P(1);
        (x * w[D - 2][k]).store(&line[m][k][i]);
        if (Gradient) (x * dw[D - 2][k]).store(&slope_y[m][k][i]);
        if (Gradient && D == 3) (dw[0][m] * w[D - 2][k]).store(&slope_x[m][k][i]);
      }
    }
  }
};

// Four nodes along the last axis, kChannels values each.
template <class T>
using FourNodes = Pack<T, 4 * kChannels>;

// The same kChannels values at four nodes.
template <class T>
MPM_HD FourNodes<T> repeat(const T* channels) {
  FourNodes<T> r;
#ifdef __AVX512F__
  MPM_UNROLL for (int k = 0; k < r.kParts; k++)
    if constexpr (sizeof(T) == 4)
      r.part[k] = _mm512_maskz_broadcast_f32x4(__mmask16(-1), _mm_loadu_ps(channels));
    else
      r.part[k] = _mm512_maskz_broadcast_f64x4(__mmask8(-1), _mm256_loadu_pd(channels));
#elif defined(__AVX2__)
  MPM_UNROLL for (int k = 0; k < r.kParts; k++)
    if constexpr (sizeof(T) == 4)
      r.part[k] = _mm256_broadcast_ps(reinterpret_cast<const __m128*>(channels));
    else
      r.part[k] = _mm256_loadu_pd(channels);
#else
  T lanes[4 * kChannels];
  MPM_UNROLL for (int k = 0; k < 4; k++)
    __builtin_memcpy(lanes + k * kChannels, channels, sizeof(T) * kChannels);
  r = FourNodes<T>::load(lanes);
#endif
  return r;
}

// Value k in all channels of node k, zero beyond S nodes.
template <int S, class T>
MPM_HD FourNodes<T> spread(const T* value, int stride) {
  using Row = FourNodes<T>;
  Row r(0);
  MPM_UNROLL for (int k = 0; k < S; k++) {
    Mask<T, 4 * kChannels> node;
    MPM_UNROLL for (int l = 0; l < 4 * kChannels; l++)
      node.part[l / Row::kWidth][l % Row::kWidth] = l / kChannels == k ? -1 : 0;
    r = select(node, Row(value[k * stride]), r);
  }
  return r;
}

// At node k of an axis, given the value at the second one.
template <class P>
MPM_HD P at_node(int k, const P& value, const P& slope) {
  return k == 0 ? value - slope : k == 1 ? value : k == 2 ? value + slope : value + P(k - 1) * slope;
}

// Adds the particles order[0 .. count) of one cell to the tile at its base node.
template <int Order, class T, int D, bool Slope, bool Gradient>
void sum_cell(const Contributions<Order, T, D, Slope, Gradient>& g, const uint16_t* order, int count, T* tile) {
  using Row = FourNodes<T>;
  using G = Contributions<Order, T, D, Slope, Gradient>;
  constexpr int S = Order + 1, kPlanes = G::kPlanes;
  constexpr int kTileX = D == 3 ? Tile<Order, T, D>::stride(0) : 0, kTileY = Tile<Order, T, D>::stride(D - 2);
  static constexpr T kOffset[4] = {-1, 0, 1, 2};
  const Row offset = spread<4>(kOffset, 1);
  Row sum[kPlanes][S];
  MPM_UNROLL for (int i = 0; i < kPlanes; i++) MPM_UNROLL
    for (int j = 0; j < S; j++) sum[i][j] = Row::load(tile + i * kTileX + j * kTileY);
  for (int n = 0; n < count; n++) {
    const int p = order[n] % kChunk;
    const T* row = g.row[p];
    const auto slope = [&](int axis) { return repeat(row + G::kSlope + axis * kChannels); };
    const auto gradient = [&](int axis) { return repeat(row + G::kGradient + axis * kChannels); };
    const Row w = spread<S>(&g.weight[0][p], G::kLine);
    Row value = repeat(row), slope_x, slope_y, gradient_x, gradient_y;
    if (Slope) value += offset * slope(D - 1);
    value = w * value;
    if (Gradient) value += spread<S>(&g.slope[0][p], G::kLine) * gradient(D - 1);
    if (Slope) slope_y = w * slope(D - 2);
    if (Gradient) gradient_y = w * gradient(D - 2);
    if constexpr (D == 3) {
      if (Slope) slope_x = w * slope(0);
      if (Gradient) gradient_x = w * gradient(0);
    }
    MPM_UNROLL for (int i = 0; i < kPlanes; i++) {
      const Row plane = Slope && D == 3 ? at_node(i, value, slope_x) : value;
      MPM_UNROLL for (int j = 0; j < S; j++) {
        sum[i][j] += Row(g.line[i][j][p]) * (Slope ? at_node(j, plane, slope_y) : plane);
        if (Gradient) sum[i][j] += Row(g.slope_y[i][j][p]) * gradient_y;
        if constexpr (Gradient && D == 3) sum[i][j] += Row(g.slope_x[i][j][p]) * gradient_x;
      }
    }
  }
  MPM_UNROLL for (int i = 0; i < kPlanes; i++) MPM_UNROLL
    for (int j = 0; j < S; j++) sum[i][j].store(tile + i * kTileX + j * kTileY);
}

// Numbers of N cells in the form of a Schedule.
template <int N>
struct EntriesOf {
  typedef uint16_t Value __attribute__((vector_size(N * sizeof(uint16_t))));
};

template <int N>
MPM_HD typename EntriesOf<N>::Value entries_of(const uint16_t* order, int count) {
  typename EntriesOf<N>::Value entry = {};
  if (count >= N)
    __builtin_memcpy(&entry, order, sizeof(entry));
  else
    for (int l = 0; l < count; l++) entry[l] = order[l];
  return entry;
}

// Distances of the particles of a group, with given cells, from their base nodes.
template <class T, int D, int N>
MPM_HD void distances(const Topology<T, D>& t, const BaseBlock<T, D>& base_block,
                      const typename EntriesOf<N>::Value& entry, const Pack<T, N> x[D], Pack<T, N> f[D]) {
  using Integers = typename RegisterOf<float, N>::Integer;
  using Values = typename RegisterOf<T, N>::Value;
  const Integers cell = __builtin_convertvector(entry / kChunk, Integers);
  MPM_UNROLL for (int a = 0; a < D; a++) {
    const Integers coordinate = cell >> 2 * (D - 1 - a) & (kBlockWidth - 1);  // cell_coordinate() of each
    const Values base = __builtin_convertvector(coordinate + base_block.corner[a], Values);
    Pack<T, N> node;
    __builtin_memcpy(&node, &base, sizeof(node));
    f[a] = distance_in_cells(t.geometry, a, x[a], node);
  }
}

// Cells in an order in which neighbours along the last axis, whose rows overlap shifted, are not consecutive: a load
// must not wait for a store that covers it in part.
template <int D>
MPM_HD int nth_cell(int n) {
  return n % (kBlockNodes<D> / kBlockWidth) * kBlockWidth + n / (kBlockNodes<D> / kBlockWidth);
}

// Sums the particles of a chunk, in the order of a Schedule, cell by cell.
template <int Order, class T, int D, bool Slope, bool Gradient>
void sum_cells(const Contributions<Order, T, D, Slope, Gradient>& contributions, const uint16_t* order,
               const uint16_t* cell_end, Tile<Order, T, D>& tile) {
  for (int n = 0; n < kBlockNodes<D>; n++) {
    const int cell = nth_cell<D>(n), begin = cell ? cell_end[cell - 1] : 0, end = cell_end[cell];
    if (begin == end) continue;
    int base[D];
    for (int a = 0; a < D; a++) base[a] = cell_coordinate<D>(cell, a);
    sum_cell(contributions, order + begin, end - begin, tile.value + tile.at(base));
  }
}

// Adds channels first, ..., first + count - 1, chunk by chunk. begin() returns for each thread a function of (base
// block, chunk, contributions, tile), which adds a chunk to the tile.
template <int Order, bool Slope, bool Gradient, class T, int D, class F>
void scatter_chunks(const Topology<T, D>& t, const NodeField<T>& nodes, int first, int count, const F& begin) {
  const ScheduleIn s = schedule_of(t);
  PhaseCounter<kColours<D>> colours{s.colour_start};
  parallel_base_blocks<D>(s, t.particles, [&](const auto& next) {
    auto add = begin();
    Contributions<Order, T, D, Slope, Gradient> contributions;
    Tile<Order, T, D> tile;
    int colour = 0;
    for (int64_t b; (b = next()) >= 0;) {
      const BaseBlock<T, D> base_block(t, s.base_slot[b]);
      tile.clear();
      for (int64_t c = s.base_chunk[b]; c < s.base_chunk[b + 1]; c++) add(base_block, c, contributions, tile);
      while (b >= s.colour_start[colour + 1]) colour++;
      colours.wait_before(colour);
      tile.add_to(nodes, base_block, first, count);
      colours.finish(colour);
    }
  });
}

// The same where give(group, f, scene) returns the contributions of a group.
template <int Order, bool Slope, bool Gradient, class T, int D, class F>
void scatter_channels(const Topology<T, D>& t, const Field<const T>& x, const NodeField<T>& nodes, int first, int count,
                      const F& give) {
  const ScheduleIn s = schedule_of(t);
  const auto add = [&](const BaseBlock<T, D>& base_block, int64_t c, auto& contributions, auto& tile) {
    constexpr int N = kWideLanes<T>;
    const Chunk chunk(t, s, c);
    for (int i = 0; i < chunk.count; i += N) {
      const GroupOf<N> g = group_by_id<N>(chunk, i);
      Pack<T, N> position[D], f[D];
      MPM_UNROLL for (int a = 0; a < D; a++)
        position[a] = load(x, g, a);
      distances(t, base_block, entries_of<N>(chunk.order + i, g.count), position, f);
      contributions.put(i, f, give(g, f, base_block.scene));
    }
    sum_cells(contributions, chunk.order, chunk.cell_end, tile);
  };
  scatter_chunks<Order, Slope, Gradient>(t, nodes, first, count, [&] { return add; });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
