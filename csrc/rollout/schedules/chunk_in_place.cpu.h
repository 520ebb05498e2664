#pragma once

#include "transfer/advance_chunk.cpu.h"
#include "transfer/own_nodes.cpu.h"

// Passes over the particles of chunks while an activation lasts: these stay in place, consecutive in memory, and may
// have left their base blocks.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Quadratic splines: the nodes of particles up to one cell outside of their base blocks never overlap for two blocks of
// one colour, and sums over the colours in turn have an order.
constexpr int kOrderInPlace = 2;

// Number of cells along an axis in which the particles of a base block may be.
constexpr int kNear = kBlockWidth + 2;

// Up to kLanes particles of one cell, by ascending numbers in the chunk.
struct GroupOfChunk {
  int first, count;
  bool loads_run, stores_run, whole;
  Group group;  // if they are not consecutive

  MPM_HD GroupOfChunk(const uint16_t* order, int rest, int particles)
      : first(order[0] % kChunk), count(rest < kLanes ? rest : kLanes) {
    stores_run = order[count - 1] % kChunk - first == count - 1;
    loads_run = stores_run && first + kLanes <= particles;
    whole = count == kLanes;
    if (loads_run && (whole || kMasks)) return;
    int id[kLanes];
    for (int l = 0; l < count; l++) id[l] = order[l] % kChunk;
    group = group_of<kLanes>(id, count);
  }

  template <class T>
  MPM_HD Lanes<T> load(const T* row) const {
    return loads_run ? Lanes<T>::load(row + first) : load_row(row, 1, group);
  }
  // put(function that stores the values of the group in a row)
  template <class T, class F>
  MPM_HD void store_by(const F& put) const {
    if (stores_run && whole) return put([&](const Lanes<T>& v, T* row) { v.store(row + first); });
#ifdef __AVX512VL__
    if (stores_run) return put([&](const Lanes<T>& v, T* row) { v.store(row + first, (1u << count) - 1); });
#endif
    put([&](const Lanes<T>& v, T* row) { store_row(v, row, 1, group); });
  }

 private:
#ifdef __AVX512VL__
  static constexpr bool kMasks = true;
#else
  static constexpr bool kMasks = false;
#endif
};

// The particles of a chunk, and loops over them. Those out of the block are last in the order of cells.
template <class T, int D>
struct ChunkInPlace {
  const Topology<T, D>& t;
  const ScheduleIn schedule;
  int begin = 0, count = 0;
  const uint16_t *order = nullptr, *cell_end = nullptr;

  explicit ChunkInPlace(const Topology<T, D>& topology) : t(topology), schedule(schedule_of(topology)) {}

  // f(chunk, the next one) for those of a base block; this is the former.
  template <class F>
  void for_chunks(int64_t b, const F& f) {
    const int64_t chunks = schedule.base_chunk[schedule.colour_start[kColours<D>]];
    for (int64_t c = schedule.base_chunk[b]; c < schedule.base_chunk[b + 1]; c++) {
      const Chunk chunk(t, schedule, c), next(t, schedule, c + 1 < chunks ? c + 1 : c);
      begin = int(chunk.id - t.index);
      count = chunk.count;
      order = chunk.order;
      cell_end = chunk.cell_end;
      f(c, next);
    }
  }

  // f(number in the chunk, pack of N particles from there on) for all packs.
  template <int N, class F>
  MPM_HD void for_packs(const F& f) const {
    int i = 0;
    for (; i + N <= count; i += N) f(i, RunOf<N>{begin + i});
    if (i < count) f(i, PartOf<N>{begin + i, count - i});
  }

  // f(group, index in the order of cells, cell, distances from the base node) for groups of particles in the block.
  template <class F>
  MPM_HD void for_groups(const FieldRows<T, D>& x, const BaseBlock<T, D>& base_block, const F& f) const {
    for (int cell = 0, i = 0; cell < kBlockNodes<D>; cell++) {
      int base[D];
      for (int a = 0; a < D; a++) base[a] = cell_coordinate<D>(cell, a);
      for (const int end = cell_end[cell]; i < end; i += kLanes) {
        const GroupOfChunk g(order + i, end - i, count);
        Lanes<T> distance[D];
        MPM_UNROLL for (int a = 0; a < D; a++)
          distance[a] =
              distance_in_cells(t.geometry, a, g.load(x.row[a] + begin), Lanes<T>(T(base_block.corner[a] + base[a])));
        f(g, i, base, distance);
      }
      i = cell_end[cell];
    }
  }

  // f(number in the chunk) for particles out of the block.
  template <class F>
  MPM_HD void for_out_of_block(const F& f) const {
    for (int k = cell_end[kBlockNodes<D> - 1]; k < count; k++) f(order[k] % kChunk);
  }

  // Base node of such a particle, and distances from it [cells].
  MPM_HD void locate(const FieldRows<T, D>& rows, int i, int base[D], T distance[D]) const {
    for (int a = 0; a < D; a++) {
      const T x = rows.row[a][begin + i], node = base_node<kOrderInPlace>(t.geometry, a, x);
      base[a] = int(node);
      distance[a] = distance_in_cells(t.geometry, a, x, node);
    }
  }
};

// Calls process(pass of a thread, base block, function that waits for the sums of earlier colours) for all base blocks;
// make(number of the thread, f) calls f with the pass.
template <class T, int D, class Make>
void for_base_blocks_in_turn(const Topology<T, D>& t, const Make& make) {
  const ScheduleIn s = schedule_of(t);
  PhaseCounter<kColours<D>> colours{s.colour_start};
  int taken = 0;
  parallel_base_blocks<D>(s, t.particles, [&](const auto& next) {
    auto pass = make(__atomic_fetch_add(&taken, 1, __ATOMIC_RELAXED));
    int colour = 0;
    for (int64_t b; (b = next()) >= 0;) {
      while (b >= s.colour_start[colour + 1]) colour++;
      pass.process(b, [&] { colours.wait_before(colour); });
      colours.finish(colour);
    }
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
