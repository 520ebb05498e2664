#pragma once

#include "common/fields.h"
#include "common/pack.h"
#include "cpu/base_block.h"

// Chunks of particles of one base block, and groups of them in the lanes of packs with their loads and stores.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

constexpr int kLanes = 8;  // for a pack of particles: cells hold about that many
template <class T>
using Lanes = Pack<T, kLanes>;
// Lanes where nothing depends on the cells: a register of values, if that is more.
template <class T>
constexpr int kWideLanes = kRegisterBytes / int(sizeof(T)) > kLanes ? kRegisterBytes / int(sizeof(T)) : kLanes;

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
// written, for any count.
template <int N>
struct GroupOf {
  static constexpr int kSize = N;
  int count;
  bool consecutive;
  int id[N];
#ifdef __AVX512VL__
  // Otherwise: runs of lanes whose particles are contiguous in memory. Few particles have changed places since the last
  // sort, so most groups have one to three runs.
  int runs;
  uint16_t lanes[N];  // of each run, as bits
  int start[N];       // particle of lane 0 if the run extended to it
#endif

  void find_runs() {
#ifdef __AVX512VL__
    unsigned first = 1;  // first lanes of runs, as bits
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

// Particles with the given numbers.
template <int N>
MPM_HD GroupOf<N> group_of(const int* id, int count) {
  GroupOf<N> g;
  g.count = count < N ? count : N;
  g.consecutive = count >= N;
  MPM_UNROLL for (int l = 0; l < N; l++)
    g.id[l] = id[l < g.count ? l : 0];
  MPM_UNROLL for (int l = 1; l < N; l++)
    g.consecutive = g.consecutive & (g.id[l] == g.id[0] + l);
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

// Per scene: dt, or a multiple of it.
template <class T>
MPM_HD T time_step(const Field<const T>& scene_dt, double dt, int scene) {
  return scene_dt.pointer ? T(dt) * scene_dt.pointer[scene * scene_dt.stride[0]] : T(dt);
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
template <class T, int N>
MPM_HD void store_row_exactly(const Pack<T, N>& v, T* row, int64_t stride, const GroupOf<N>& g) {
  T lanes[N];
  v.store(lanes);
  if (g.count == N && stride == 1) {
    MPM_UNROLL for (int l = 0; l < N; l++)
      row[g.id[l]] = lanes[l];
  } else {
    for (int l = 0; l < g.count; l++) row[g.id[l] * stride] = lanes[l];
  }
}

// May write over the particles after the group, see `group_by_cell`.
template <class T, int N>
MPM_HD void store_row(const Pack<T, N>& v, T* row, int64_t stride, const GroupOf<N>& g) {
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

// N contiguous particles of fields with unit stride: loads and stores without a test.
template <int N>
struct RunOf {
  static constexpr int kSize = N;
  int first;
};

template <class T, int N>
MPM_HD Pack<T, N> load_row(const T* row, int64_t, const RunOf<N>& r) {
  return Pack<T, N>::load(row + r.first);
}
template <class T, int N>
MPM_HD void store_row(const Pack<T, N>& v, T* row, int64_t, const RunOf<N>& r) {
  v.store(row + r.first);
}
template <class T, int N>
MPM_HD Pack<T, N> load(const Field<const T>& f, const RunOf<N>& r, int i = 0, int j = 0) {
  return load_row(row_of(f, i, j), 1, r);
}

// The same with only the first `count` present.
template <int N>
struct PartOf {
  static constexpr int kSize = N;
  int first, count;
};

template <class T, int N>
MPM_HD Pack<T, N> load_row(const T* row, int64_t, const PartOf<N>& r) {
#ifdef __AVX512VL__
  return Pack<T, N>(0).with(row + r.first, (1u << r.count) - 1);
#else
  T lanes[N] = {};
  for (int l = 0; l < r.count; l++) lanes[l] = row[r.first + l];
  return Pack<T, N>::load(lanes);
#endif
}
template <class T, int N>
MPM_HD void store_row(const Pack<T, N>& v, T* row, int64_t, const PartOf<N>& r) {
#ifdef __AVX512VL__
  v.store(row + r.first, (1u << r.count) - 1);
#else
  for (int l = 0; l < r.count; l++) row[r.first + l] = v[l];
#endif
}

// First addresses of the N components of a field. A store through a Field makes the compiler read its strides again.
template <class T, int N>
struct FieldRows {
  T* row[N] = {};  // null where the field is absent
  int64_t stride = 0;

  explicit FieldRows(const Field<T>& f, int inner = 1) : stride(f.stride[0]) {
    if (f.pointer)
      for (int k = 0; k < N; k++) row[k] = row_of(f, k / inner, k % inner);
  }
  MPM_HD explicit operator bool() const { return row[0]; }
};

// Whether the particles of all present fields are contiguous.
template <class... Fields>
MPM_HD bool unit_stride(const Fields&... f) {
  return ((!f.pointer || f.stride[0] == 1) && ...);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
