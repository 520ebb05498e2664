#pragma once

#include "common/fields.h"
#include "common/pack.h"
#include "cpu/schedule.h"

// What the transfer kernels share: chunks of particles of one home block, groups of kLanes of them, and tiles, private
// copies of the nodes that the particles of one home touch.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

constexpr int kLanes = 8;     // of a pack of particles: cells hold about that many
constexpr int kChannels = 4;  // channels that are transferred together
template <class T>
using Lanes = Pack<T, kLanes>;
// Lanes where nothing depends on the cells: a register of values, if that is more.
template <class T>
constexpr int kWideLanes = kRegisterBytes / int(sizeof(T)) > kLanes ? kRegisterBytes / int(sizeof(T)) : kLanes;

// A slot that holds particles, and the slots of the blocks that these can touch: o as in activate.cpu.cpp.
template <class T, int D>
struct Home {
  int scene;
  int corner[D];  // first node of the block
  int slot[kColours<D>];

  Home(const Topology<T, D>& t, int own) {
    int block[D];
    scene = block_coordinates(t.geometry, t.block[own], block);
    for (int i = 0; i < D; i++) corner[i] = block[i] * kBlockWidth;
    for (int o = 0; o < kColours<D>; o++) {
      int other[D];
      bool inside = true;
      for (int i = 0; i < D; i++) {
        other[i] = block[i] + (o >> (D - 1 - i) & 1);
        inside = inside && other[i] < t.geometry.blocks[i];
      }
      slot[o] = inside ? t.table[block_index(t.geometry, scene, other)] : -1;
    }
  }
};

// Position of a cell in its block along an axis.
template <int D>
MPM_HD int cell_coordinate(int cell, int axis) {
  return cell >> 2 * (D - 1 - axis) & (kBlockWidth - 1);
}

struct Chunk {
  int slot, count;
  const int* id;          // particles, ascending
  const uint16_t* order;  // see Schedule
  const uint16_t* cell_end;
  bool sorted;

  template <class T, int D>
  Chunk(const Topology<T, D>& t, const ScheduleIn& s, int64_t chunk) {
    slot = s.chunk_slot[chunk];
    const int begin = s.chunk_begin[chunk], rest = t.offsets[slot + 1] - begin;
    count = rest < kChunk ? rest : kChunk;
    id = t.index + begin;
    order = s.order + begin;
    cell_end = s.cell_end + chunk * kBlockNodes<D>;
    sorted = s.chunk_sorted[chunk];
  }
  int by_cell(int i) const { return order[i] % kChunk; }  // the i-th particle in the order of cells
};

// Up to N particles; id repeats the first one beyond the count. Where they are `consecutive`, all lanes may be read and
// written, whatever the count.
template <int N>
struct GroupOf {
  static constexpr int kSize = N;
  int count;
  bool consecutive;
  int id[N];
#ifdef __AVX512VL__
  // Otherwise: runs of lanes whose particles lie one after another in memory. Particles that have changed places since
  // they were sorted are few, so most groups have one to three.
  int runs;
  uint16_t lanes[N];  // of each run, as bits
  int start[N];       // the particle that lane 0 would have in the run
#endif

  void find_runs() {
#ifdef __AVX512VL__
    unsigned first = 1;  // lanes that begin a run, as bits
    MPM_UNROLL for (int l = 1; l < N; l++)
      first |= unsigned(id[l] != id[l - 1] + 1) << l;
    const unsigned all = (1u << count) - 1;
    runs = 0;
    for (first &= all; first; first &= first - 1) {
      const int lane = __builtin_ctz(first);
      const unsigned later = first & (first - 1), end = later ? 1u << __builtin_ctz(later) : all + 1;
      lanes[runs] = uint16_t(end - (1u << lane));
      start[runs++] = id[lane] - lane;
    }
#endif
  }
};
using Group = GroupOf<kLanes>;

// Particles i, i + 1, ... of a chunk.
template <int N>
MPM_HD GroupOf<N> group_by_id(const Chunk& c, int i) {
  GroupOf<N> g;
  const int rest = c.count - i;
  g.count = rest < N ? rest : N;
  g.consecutive = rest >= N && c.id[i + N - 1] - c.id[i] == N - 1;
  if (rest >= N)
    __builtin_memcpy(g.id, c.id + i, sizeof(g.id));
  else
    for (int l = 0; l < N; l++) g.id[l] = c.id[i + (l < g.count ? l : 0)];
  if (!g.consecutive) g.find_runs();
  return g;
}

// Particles i, ..., end - 1 of a chunk in the order of cells. In a sorted chunk a group may write over the particles
// after it, which are written later.
MPM_HD Group group_by_cell(const Chunk& c, int i, int end) {
  Group g;
  g.count = end - i < kLanes ? end - i : kLanes;
  if (c.sorted && i + kLanes <= c.count) {
    g.consecutive = true;
    __builtin_memcpy(g.id, c.id + i, sizeof(g.id));
  } else {
    for (int l = 0; l < kLanes; l++) g.id[l] = c.id[c.by_cell(i + (l < g.count ? l : 0))];
    g.consecutive = g.count == kLanes && g.id[kLanes - 1] - g.id[0] == kLanes - 1;
    if (!g.consecutive) g.find_runs();
  }
  return g;
}

// One value of one particle.
template <class T>
MPM_HD T& at(const Field<T>& f, int64_t p, int i = 0, int j = 0) {
  return f.pointer[p * f.stride[0] + i * f.stride[1] + j * f.stride[2]];
}

template <class T, int N>
MPM_HD Pack<T, N> load_runs(const T* from, const GroupOf<N>& g) {
#ifdef __AVX512VL__
  Pack<T, N> r(0);
  for (int k = 0; k < g.runs; k++) r = r.with(from + g.start[k], g.lanes[k]);
  return r;
#else
  return Pack<T, N>::gather(from, g.id);
#endif
}

template <class T, int N>
MPM_HD Pack<T, N> load_row(const T* row, int64_t stride, const GroupOf<N>& g) {
  if (stride == 1) return g.consecutive ? Pack<T, N>::load(row + g.id[0]) : load_runs(row, g);
  T lanes[N];
  MPM_UNROLL for (int l = 0; l < N; l++)
    lanes[l] = row[g.id[l] * stride];
  return Pack<T, N>::load(lanes);
}

// Writes the lanes of the group only.
template <class T>
MPM_HD void store_row_exactly(const Lanes<T>& v, T* row, int64_t stride, const Group& g) {
  T lanes[kLanes];
  v.store(lanes);
  if (g.count == kLanes && stride == 1) {
    MPM_UNROLL for (int l = 0; l < kLanes; l++)
      row[g.id[l]] = lanes[l];
  } else {
    for (int l = 0; l < g.count; l++) row[g.id[l] * stride] = lanes[l];
  }
}

// May write over the particles after the group, see `group_by_cell`.
template <class T>
MPM_HD void store_row(const Lanes<T>& v, T* row, int64_t stride, const Group& g) {
  if (g.consecutive && stride == 1) return v.store(row + g.id[0]);
#ifdef __AVX512VL__
  if (stride == 1) {
    for (int k = 0; k < g.runs; k++) v.store(row + g.start[k], g.lanes[k]);
    return;
  }
#endif
  store_row_exactly(v, row, stride, g);
}

template <class T>
MPM_HD T* row_of(const Field<T>& f, int i = 0, int j = 0) {
  return f.pointer + i * f.stride[1] + j * f.stride[2];
}

template <class T, int N>
MPM_HD Pack<T, N> load(const Field<const T>& f, const GroupOf<N>& g, int i = 0, int j = 0) {
  return load_row(row_of(f, i, j), f.stride[0], g);
}
template <class T>
MPM_HD void store_exactly(const Lanes<T>& v, const Field<T>& f, const Group& g, int i = 0, int j = 0) {
  store_row_exactly(v, row_of(f, i, j), f.stride[0], g);
}
template <class T>
MPM_HD void store(const Lanes<T>& v, const Field<T>& f, const Group& g, int i = 0, int j = 0) {
  store_row(v, row_of(f, i, j), f.stride[0], g);
}

// N particles one after another in memory, of fields with unit stride: loads and stores without a question.
template <int N>
struct RunOf {
  static constexpr int kSize = N;
  int first;
};
using Run = RunOf<kLanes>;

template <class T, int N>
MPM_HD Pack<T, N> load_row(const T* row, int64_t, const RunOf<N>& r) {
  return Pack<T, N>::load(row + r.first);
}
template <class T>
MPM_HD void store_row(const Lanes<T>& v, T* row, int64_t, const Run& r) {
  v.store(row + r.first);
}
template <class T, int N>
MPM_HD Pack<T, N> load(const Field<const T>& f, const RunOf<N>& r, int i = 0, int j = 0) {
  return load_row(row_of(f, i, j), 1, r);
}

// Where the N components of a field begin. A store through a Field makes the compiler read its strides again.
template <class T, int N>
struct Rows {
  T* row[N] = {};  // null where the field is absent
  int64_t stride = 0;

  explicit Rows(const Field<T>& f, int inner = 1) : stride(f.stride[0]) {
    if (f.pointer)
      for (int k = 0; k < N; k++) row[k] = row_of(f, k / inner, k % inner);
  }
  MPM_HD explicit operator bool() const { return row[0]; }
};

// Whether all fields that are present have particles one after another.
template <class... Fields>
MPM_HD bool unit_stride(const Fields&... f) {
  return ((!f.pointer || f.stride[0] == 1) && ...);
}

// Nodes that the particles of one home touch, kChannels values each. Rows run along the last axis and are long enough
// to add four nodes anywhere.
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
  MPM_HD void for_runs(const Home<T, D>& home, const F& visit) {
    for (int row = 0; row < kRows; row++) {
      const int i = D == 3 ? row / kWidth : 0, j = row % kWidth;
      const int o = (D == 3 ? i / kBlockWidth * 4 : 0) + j / kBlockWidth * 2;
      const int inside = (i % kBlockWidth * kBlockWidth + j % kBlockWidth) * kBlockWidth;
      const int low = home.slot[o], high = home.slot[o + 1];
      if (low >= 0) visit(value + row * kRow, int64_t(low) * kBlockNodes<D> + inside, kBlockWidth);
      if (high >= 0)
        visit(value + row * kRow + kBlockWidth * kChannels, int64_t(high) * kBlockNodes<D> + inside, Order);
    }
  }

  void clear() { __builtin_memset(value, 0, sizeof(value)); }

  // Reads channels first, ..., first + count - 1 of the nodes; zero for the other channels and inactive blocks.
  void load_from(const NodeField<const T>& nodes, const Home<T, D>& home, int first, int count) {
    clear();
    const auto copy = [&]<int Channels>() {
      for_runs(home, [&](T* tile, int64_t row, int n) {
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

  void add_to(const NodeField<T>& nodes, const Home<T, D>& home, int first, int count) {
    for_runs(home, [&](T* tile, int64_t row, int n) {
      T* to = nodes.pointer + row * nodes.stride + first;
      if (count == kChannels && nodes.stride == kChannels)
        for (int k = 0; k < n * kChannels; k++) to[k] += tile[k];
      else
        for (int k = 0; k < n; k++)
          for (int c = 0; c < count; c++) to[k * nodes.stride + c] += tile[k * kChannels + c];
    });
  }
};

// Calls f(particle) for the particles that are not transferred.
template <class T, int D, class F>
void for_outside(const Topology<T, D>& t, const F& f) {
  for (int64_t i = t.offsets[t.max_blocks]; i < t.particles; i++) f(int64_t(t.index[i]));
}

// Calls f(next) once per thread, where next() hands out the homes of a schedule colour by colour.
template <int D, class F>
void parallel_homes(const ScheduleIn& s, int64_t particles, const F& f) {
  constexpr int64_t kHomes = 4, kParticles = 2048;  // that are worth a thread
  const int64_t homes = s.colour_start[kColours<D>];
  const int64_t by_homes = (homes + kHomes - 1) / kHomes, by_particles = (particles + kParticles - 1) / kParticles;
  parallel_phases<kColours<D>>(s.colour_start, by_homes < by_particles ? by_homes : by_particles, f);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
