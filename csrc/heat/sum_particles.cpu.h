#pragma once

#include <type_traits>

#include "cpu/parallel.h"
#include "heat/cell.h"
#include "transfer/own_nodes.cpu.h"
#include "transfer/scatter.cpu.h"

// H applied in one pass: four rows of cells of a base block are in the lanes of packs, which add up the particles of
// each cell without sums over lanes. Base blocks add their tiles colour by colour, so that every sum has the same order
// for any number of threads.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// One value at each node in the support of a base block; rows along the last axis.
template <int Order, class T, int D>
struct ScalarTile {
  static constexpr int kWidth = kBlockWidth + Order, kRow = 2 * kBlockWidth;
  static constexpr int kRows = D == 3 ? kWidth * kWidth : kWidth;
  alignas(64) T value[kRows * kRow];

  void clear() { __builtin_memset(value, 0, sizeof(value)); }

  // Place of the first node of a cell, and those of the nodes that are further along the axes from there.
  static int first_of(int cell) {
    return offset(D == 3 ? cell_coordinate<D>(cell, 0) : 0, cell_coordinate<D>(cell, D - 2),
                  cell_coordinate<D>(cell, D - 1));
  }
  static constexpr int offset(int i, int j, int k) { return (i * kWidth + j) * kRow + k; }

  // visit(tile values, node row of the pool, nodes) for every run of nodes in an active block, `nodes` a constant
  template <class F>
  MPM_HD void for_runs(const BaseBlock<T, D>& base_block, const F& visit) {
    for (int row = 0; row < kRows; row++) {
      const int i = D == 3 ? row / kWidth : 0, j = row % kWidth;
      const int o = (D == 3 ? i / kBlockWidth * 4 : 0) + j / kBlockWidth * 2;
      const int inside = (i % kBlockWidth * kBlockWidth + j % kBlockWidth) * kBlockWidth;
      const int low = base_block.slot[o], high = base_block.slot[o + 1];
      if (low >= 0)
        visit(value + row * kRow, int64_t(low) * kBlockNodes<D> + inside, std::integral_constant<int, kBlockWidth>());
      if (high >= 0)
        visit(value + row * kRow + kBlockWidth, int64_t(high) * kBlockNodes<D> + inside,
              std::integral_constant<int, Order>());
    }
  }
  void load_from(const T* nodes, const BaseBlock<T, D>& base_block) {
    clear();
    for_runs(base_block, [&](T* tile, int64_t row, auto n) { __builtin_memcpy(tile, nodes + row, n * sizeof(T)); });
  }
  void add_to(T* nodes, const BaseBlock<T, D>& base_block) {
    for_runs(base_block, [&](const T* tile, int64_t row, auto n) {
      T sums[n];
      __builtin_memcpy(sums, nodes + row, sizeof(sums));
      for (int k = 0; k < n; k++) sums[k] += tile[k];
      __builtin_memcpy(nodes + row, sums, sizeof(sums));
    });
  }
};

constexpr int kRowsOfCells = 4, kCells = kRowsOfCells * kBlockWidth;
template <class T>
using Cells = Pack<T, kCells>;
template <class T>
using RowOfCells = Pack<T, kBlockWidth>;

// from[index[l]] in lane l.
template <class T>
MPM_HD Cells<T> take(const T* from, const int* index) {
#ifdef __AVX512F__
  if constexpr (sizeof(T) == 4) {
    const __m512i at = _mm512_loadu_si512(index);
    const __m512 r = _mm512_mask_i32gather_ps(_mm512_setzero_ps(), __mmask16(-1), at, from, 4);
    return Cells<T>::load(reinterpret_cast<const T*>(&r));
  }
#endif
  return Cells<T>::gather(from, index);
}

// The same for integers, from the places first[l] + n of lanes with n < count[l]; zero in the others.
MPM_HD void take(const int* from, const int* first, const int* count, int n, int* to) {
#ifdef __AVX512F__
  const __m512i nth = _mm512_set1_epi32(n), at = _mm512_add_epi32(_mm512_loadu_si512(first), nth);
  const __mmask16 lanes = _mm512_cmplt_epi32_mask(nth, _mm512_loadu_si512(count));
  _mm512_storeu_si512(to, _mm512_mask_i32gather_epi32(_mm512_setzero_si512(), lanes, at, from, 4));
#else
  for (int l = 0; l < kCells; l++) to[l] = n < count[l] ? from[first[l] + n] : 0;
#endif
}

// Four rows one after another.
template <class T>
MPM_HD Cells<T> load_rows(const T* const row[kRowsOfCells], int offset) {
  if constexpr (Cells<T>::kParts == 1) {
    using V = typename RegisterOf<T, kBlockWidth>::Value;
    V r[kRowsOfCells];
    MPM_UNROLL for (int k = 0; k < kRowsOfCells; k++)
      __builtin_memcpy(&r[k], row[k] + offset, sizeof(V));
    const auto low = __builtin_shufflevector(r[0], r[1], 0, 1, 2, 3, 4, 5, 6, 7);
    const auto high = __builtin_shufflevector(r[2], r[3], 0, 1, 2, 3, 4, 5, 6, 7);
    Cells<T> all;
    all.part[0] = __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    return all;
  } else {
    T lanes[kCells];
    MPM_UNROLL for (int k = 0; k < kRowsOfCells; k++)
      RowOfCells<T>::load(row[k] + offset).store(lanes + k * kBlockWidth);
    return Cells<T>::load(lanes);
  }
}

template <class T>
MPM_HD void add_to_rows(const Cells<T>& sums, T* const row[kRowsOfCells], int offset) {
  T lanes[kCells];
  sums.store(lanes);
  MPM_UNROLL for (int k = 0; k < kRowsOfCells; k++) {
    T* const to = row[k] + offset;
    (RowOfCells<T>::load(to) + RowOfCells<T>::load(lanes + k * kBlockWidth)).store(to);
  }
}

// The particles of a chunk: distances from the base nodes [cells], and scaled conductance; and their numbers in the
// order of cells.
template <int Order, class T, int D>
struct Conductors {
  static constexpr int kLine = kChunk + 16;
  alignas(64) T f[D][kLine], conductance[kLine];
  int number[kLine];

  void set(const Topology<T, D>& t, const Field<const T>& x, const Field<const T>& of,
           const BaseBlock<T, D>& base_block, const Chunk& chunk) {
    constexpr int N = kWideLanes<T>;
    const bool direct = unit_stride(x, of);
    for (int i = 0; i < chunk.count; i++) number[i] = chunk.by_cell(i);
    for (int i = 0; i < chunk.count; i += N) {
      const GroupOf<N> g = group_by_id<N>(chunk, i);
      direct&& g.consecutive ? put(t, x, of, base_block, chunk, i, RunOf<N>{g.id[0]})
                             : put(t, x, of, base_block, chunk, i, g);
    }
  }

 private:
  template <class G>
  MPM_HD void put(const Topology<T, D>& t, const Field<const T>& x, const Field<const T>& of,
                  const BaseBlock<T, D>& base_block, const Chunk& chunk, int i, const G& g) {
    constexpr int N = G::kSize;
    Pack<T, N> position[D], distance[D];
    MPM_UNROLL for (int a = 0; a < D; a++)
      position[a] = load(x, g, a);
    distances(t, base_block, entries_of<N>(chunk.order + i, chunk.count - i), position, distance);
    MPM_UNROLL for (int a = 0; a < D; a++)
      distance[a].store(f[a] + i);
    scaled_conductance<Order>(load(of, g), t.geometry.inverse_dx).store(conductance + i);
  }
};

// Adds the particles of a chunk in rows of cells to the tile `sum`; returns Σ κ V |∇u|².
template <HeatSum Sum, int Order, class T, int D>
T sum_rows(const Chunk& chunk, const Conductors<Order, T, D>& particles, const int* rows, int row_count,
           ScalarTile<Order, T, D>& u, ScalarTile<Order, T, D>& sum, const int* e) {
  using P = Cells<T>;
  using Tile = ScalarTile<Order, T, D>;
  constexpr int kNodes = kSupportNodes<Order, D>, S = Order + 1;
  alignas(64) int first[kCells], count[kCells], index[kCells];
  T counts[kCells];
  const T* from_row[kRowsOfCells];
  T* to_row[kRowsOfCells];
  int most = 0;
  for (int k = 0; k < kRowsOfCells; k++) {
    const int row = rows[k < row_count ? k : 0], cell = row * kBlockWidth;
    const int place = Tile::first_of(cell);
    from_row[k] = u.value + place;
    to_row[k] = sum.value + place;
    for (int i = 0; i < kBlockWidth; i++) {
      const int l = k * kBlockWidth + i, begin = cell + i ? chunk.cell_end[cell + i - 1] : 0;
      first[l] = begin;
      count[l] = k < row_count ? chunk.cell_end[cell + i] - begin : 0;
      counts[l] = T(count[l]);
      most = count[l] > most ? count[l] : most;
    }
  }
  const P of_cell = P::load(counts);
  P from[kNodes], to[kNodes], power(0);
  if (Sum == HeatSum::product) {
    MPM_UNROLL for (int n = 0; n < kNodes; n++)
      from[n] = load_rows(from_row, Tile::offset(n / (S * S), n / S % S, n % S));
    to_differences<Order, D>(from);
  }
  for (int n = 0; n < kNodes; n++) to[n] = P(0);
  for (int n = 0; n < most; n++) {
    take(particles.number, first, count, n, index);
    P f[D];
    MPM_UNROLL for (int a = 0; a < D; a++)
      f[a] = take(particles.f[a], index);
    const P conductance = select(P(n) < of_cell, take(particles.conductance, index), P(0));
    power += add_particle<Sum, Order, P, D>(f, conductance, from, to, e);
  }
  if (Sum == HeatSum::product) to_nodes<Order, D>(to);
  const auto filled = P(0) < of_cell;  // NaN at nodes stays out of cells without particles
  for (int k = 0; k < S; k++)          // outside, since the rows of consecutive k overlap
      MPM_UNROLL
    for (int n = 0; n < kNodes / S; n++)
      add_to_rows(select(filled, to[n * S + k], P(0)), to_row, Tile::offset(n / S, n % S, k));
  power = select(filled, power, P(0));
  T total = power[0];
  for (int l = 1; l < kCells; l++) total += power[l];
  return total;
}

// Prefetches the cache lines of some components of particles from .. to - 1 of a chunk.
template <class T>
MPM_HD void prefetch_rows(const Field<const T>& x, int components, const Chunk& chunk, int from, int to) {
  constexpr int line = 64 / int(sizeof(T));
  for (int i = from; i < to && i < chunk.count; i += line)
    for (int a = 0; a < components; a++) __builtin_prefetch(row_of(x, a) + chunk.id[i] * x.stride[0], 0, 2);
}

// The rows of cells with particles of a chunk, those with the fullest cells first, so that rows that are summed
// together have about as many particles. Returns their number.
template <int D>
int rows_with_particles(const Chunk& chunk, int rows[kBlockNodes<D> / kBlockWidth]) {
  int most[kBlockNodes<D> / kBlockWidth], count = 0;
  for (int cell = 0, before = 0; cell < kBlockNodes<D>; cell += kBlockWidth) {
    int fullest = 0;
    for (int i = cell; i < cell + kBlockWidth; before = chunk.cell_end[i++])
      fullest = chunk.cell_end[i] - before > fullest ? chunk.cell_end[i] - before : fullest;
    if (fullest == 0) continue;
    int k = count++;
    for (; k > 0 && most[k - 1] < fullest; k--) most[k] = most[k - 1], rows[k] = rows[k - 1];
    most[k] = fullest;
    rows[k] = cell / kBlockWidth;
  }
  return count;
}

// Adds a particle that has left its base block while its activation lasts; returns κ V |∇u|².
template <HeatSum Sum, int Order, class T, int D>
T sum_out_of_block(const Topology<T, D>& t, int scene, const Field<const T>& x, const Field<const T>& conductance,
                   int64_t p, const T* nodes, T* out, const int* e) {
  constexpr int kNodes = kSupportNodes<Order, D>, S = Order + 1;
  int base[D];
  T f[D];
  for (int a = 0; a < D; a++) {
    const T position = at(x, p, a), node = base_node<Order>(t.geometry, a, position);
    base[a] = int(node);
    f[a] = distance_in_cells(t.geometry, a, position, node);
  }
  const NodesOf<Order, T, D> own(t, scene, base);
  T from[kNodes], to[kNodes] = {};
  if (Sum == HeatSum::product) {
    for (int n = 0; n < kNodes; n++) from[n] = nodes[own.row[n / S][n % S]];
    to_differences<Order, D>(from);
  }
  const T scaled = scaled_conductance<Order>(at(conductance, p), t.geometry.inverse_dx);
  const T power = add_particle<Sum, Order, T, D>(f, scaled, from, to, e);
  if (Sum == HeatSum::product) to_nodes<Order, D>(to);
  for (int n = 0; n < kNodes; n++) out[own.row[n / S][n % S]] += to[n];
  return power;
}

// Adds a sum over the particles of every base block of an active scene to the nodes; finish(slot, Σ κ V |∇u|²) per base
// block.
template <HeatSum Sum, int Order, class T, int D, class Wanted, class Finish>
void sum_particles(const Topology<T, D>& t, const Field<const T>& x, const Field<const T>& conductance, const T* nodes,
                   T* out, const Wanted& wanted, const Finish& finish, const int* e = nullptr) {
  const ScheduleIn s = schedule_of(t);
  const int64_t chunks = s.base_chunk[s.colour_start[kColours<D>]];
  PhaseCounter<kColours<D>> colours{s.colour_start};
  parallel_base_blocks<D>(s, t.particles, [&](const auto& next) {
    ScalarTile<Order, T, D> u, sum;
    Conductors<Order, T, D> particles;
    int colour = 0;
    for (int64_t b; (b = next()) >= 0;) {
      const int slot = s.base_slot[b];
      const BaseBlock<T, D> base_block(t, slot);
      while (b >= s.colour_start[colour + 1]) colour++;
      if (!wanted(base_block.scene)) {
        colours.finish(colour);
        continue;
      }
      if (Sum == HeatSum::product) u.load_from(nodes, base_block);
      sum.clear();
      double power = 0;
      for (int64_t c = s.base_chunk[b]; c < s.base_chunk[b + 1]; c++) {
        const Chunk chunk(t, s, c), after(t, s, c + 1 < chunks ? c + 1 : c);
        particles.set(t, x, conductance, base_block, chunk);
        int rows[kBlockNodes<D> / kBlockWidth];
        const int count = rows_with_particles<D>(chunk, rows);
        for (int k = 0; k < count; k += kRowsOfCells) {
          const int begin = after.count * k / count, end = after.count * (k + kRowsOfCells) / count;
          prefetch_rows(x, D, after, begin, end);
          prefetch_rows(conductance, 1, after, begin, end);
          power += double(sum_rows<Sum, Order>(chunk, particles, rows + k, count - k, u, sum, e));
        }
      }
      colours.wait_before(colour);
      sum.add_to(out, base_block);
      for (int64_t c = s.base_chunk[b]; c < s.base_chunk[b + 1]; c++) {
        const Chunk chunk(t, s, c);
        for (int i = chunk.cell_end[kBlockNodes<D> - 1]; i < chunk.count; i++)
          power += double(sum_out_of_block<Sum, Order>(t, base_block.scene, x, conductance, chunk.id[chunk.by_cell(i)],
                                                       nodes, out, e));
      }
      finish(slot, power);
      colours.finish(colour);
    }
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
