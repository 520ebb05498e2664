#include <climits>
#include <cub/block/block_scan.cuh>
#include <cub/device/device_radix_sort.cuh>

#include "cuda/barrier.cuh"
#include "cuda/base_block.cuh"
#include "cuda/programmatic_launch.cuh"
#include "grid/activate.h"
#include "grid/status.h"

// Finds the active blocks and groups the particles by base block, without any count on the host.
//   classify   base block and rank of every particle, number of particles and touched neighbours of every block
//   slots      numbers the active blocks in the order of the table (one-pass scan)
//   offsets    first particle and work items of every slot (one-pass scan)
//   place      the index tensor, base blocks and neighbours, unused slots, status
// One kernel does all of this if there are few tiles, or if an activation may last several steps; often it only finds
// that the activation still lasts.
// The scans pass over tiles of the table; of a large table only over tiles with active blocks, which `classify` marks
// and `list_tiles` lists in their order. Their writes are cleared before the next activation.
// Deterministic mode replaces the ranks, which depend on the order of atomics, by the order of memory.
namespace mpm::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kManyTiles = 512;  // number of tiles from which a list is worth two more kernels
// Every kSampling-th thread block counts the base blocks met by its warps. More than 7/5 per warp on average, and the
// gathers are faster in the order of memory than block by block.
constexpr int kSampling = 64;
__device__ bool is_scattered(int groups, int warps) { return 5 * groups > 7 * warps; }
using Packed = unsigned long long;

// Zeroed before each activation.
struct Counters {
  int tile[2];  // tiles handed out by each scan
  int tail;     // particles that are not transferred
  int wanted;   // blocks that particles touch
  int margin;   // blocks around those
  int transferred, items;
  int groups, warps;  // of the thread blocks sampled
};

// Skipped particles, zeroed before each activation. The lowest index is stored as the largest complement, so that zero
// means none.
struct Skipped {
  int count, first;
};
struct ParticleErrors {
  Skipped outside, not_finite;
};

// `count` becomes the first position in the index tensor, or -1 minus the position from its end for particles that are
// not transferred. Bit o of `touched`: the neighbour one block further along the axes of o, the last axis being bit 0
// of o.
struct BlockCount {
  int count, touched;
};

struct Workspace {
  Counters* counters;
  ParticleErrors* errors;               // [1 + scenes] of all particles, and of each scene
  Packed *slot_states, *offset_states;  // one per tile of the scans
  unsigned char* marked;                // [tiles], in whole vectors; null where there are few
  int64_t zeroed;                       // bytes from the start before each activation, and
  int64_t zeroed_once;                  // before the first one
  BlockCount* block_counts;             // [table]
  int *listed, *list;                   // number of tiles with active blocks, and their numbers
  int tiles;
  int *key, *rank;               // [P] table index (-1 outside) and rank among its particles
  int *slot, *slot_sorted, *id;  // [P], for the stable sort; slot_sorted is the index before it, too
  void* sort;
  size_t sort_size;
  int64_t size;
};

int bits_for(int max_blocks) {
  int bits = 1;
  while (max_blocks >> bits) bits++;
  return bits;
}

template <class T, int D>
Workspace lay_out(const ActivateArguments<T, D>& a) {
  const int64_t table = int64_t(a.scenes) * a.geometry.blocks_per_scene, tiles = (table + kThreads - 1) / kThreads;
  Workspace w{};
  w.tiles = int(tiles);
  char* const start = static_cast<char*>(a.workspace);
  const auto take = [&](int64_t bytes) {
    char* p = start + w.size;
    w.size += (bytes + 255) / 256 * 256;
    return p;
  };
  w.counters = reinterpret_cast<Counters*>(take(sizeof(Counters)));
  w.errors = reinterpret_cast<ParticleErrors*>(take((1 + int64_t(a.scenes)) * sizeof(ParticleErrors)));
  w.slot_states = reinterpret_cast<Packed*>(take(tiles * sizeof(Packed)));
  w.offset_states = reinterpret_cast<Packed*>(take(tiles * sizeof(Packed)));
  if (tiles > kManyTiles) w.marked = reinterpret_cast<unsigned char*>(take(tiles));
  w.zeroed = w.size;
  if (w.marked) {
    w.listed = reinterpret_cast<int*>(take(sizeof(int)));
    w.list = reinterpret_cast<int*>(take(tiles * sizeof(int)));
  }
  w.block_counts = reinterpret_cast<BlockCount*>(take(table * sizeof(BlockCount)));
  w.zeroed_once = w.size;
  w.key = reinterpret_cast<int*>(take(a.particles * sizeof(int)));
  w.rank = reinterpret_cast<int*>(take(a.particles * sizeof(int)));
  if (a.deterministic) {
    w.slot = reinterpret_cast<int*>(take(a.particles * sizeof(int)));
    w.slot_sorted = reinterpret_cast<int*>(take(a.particles * sizeof(int)));
    w.id = reinterpret_cast<int*>(take(a.particles * sizeof(int)));
    check(cub::DeviceRadixSort::SortPairs(nullptr, w.sort_size, w.slot, w.slot_sorted, w.id, a.index, int(a.particles),
                                          0, bits_for(a.slots())));
    w.sort = take(int64_t(w.sort_size));
  }
  return w;
}

// Counts a skipped particle in row 0 and in the row of its scene, unless an earlier activation has reported in that
// row: a lost scene costs atomics only once.
template <class T, int D>
__device__ void report(const ActivateArguments<T, D>& a, ParticleErrors* errors, bool finite, int scene, int row) {
  const int p = a.origin ? a.origin[row] : row;
  const auto count_in = [&](int row) {
    if (a.previous_status && a.previous_status[row * int64_t(kStatusSize) + kProblemActivation] >= 0) return;
    Skipped& out = finite ? errors[row].outside : errors[row].not_finite;
    atomicAdd(&out.count, 1);
    atomicMax(&out.first, INT_MAX - p);
  };
  count_in(0);
  if (unsigned(scene) < unsigned(a.scenes)) count_in(1 + scene);
}

// Calls f(block) for the blocks around one, itself included.
template <class T, int D, class F>
__device__ void for_surroundings(const Geometry<T, D>& g, int b, const F& f) {
  int block[D];
  block_coordinates(g, b, block);
  constexpr int count = D == 2 ? 9 : 27;
  for (int o = 0; o < count; o++) {
    int way = 0;
    bool inside = true;
#pragma unroll
    for (int i = 0, rest = o; i < D; i++, rest /= 3) {
      const int step = rest % 3 - 1;
      way = way * g.blocks[i] + step;
      inside = inside && unsigned(block[i] + step) < unsigned(g.blocks[i]);
    }
    if (inside) f(b + way);
  }
}

// Marks the tiles of the blocks that particles of a base block touch, or of all blocks around it.
template <class T, int D>
__device__ void mark_tiles(const ActivateArguments<T, D>& a, const Workspace& w, int key, unsigned touched) {
  if (a.margin_blocks > 0) {
    for_surroundings(a.geometry, key, [&](int b) { w.marked[b / kThreads] = 1; });
    return;
  }
  for (int o = 0; o < 1 << D; o++)
    if (touched >> o & 1) w.marked[(key + further(a.geometry, o)) / kThreads] = 1;
}

// Clears the table entries and counts of the previous activation.
template <class T, int D>
__device__ void clear_previous(const ActivateArguments<T, D>& a, const Workspace& w, int table) {
  for (int i = int(blockIdx.x); i < *w.listed; i += int(gridDim.x)) {
    const int64_t b = int64_t(w.list[i]) * kThreads + threadIdx.x;
    if (b >= table) continue;
    a.table[b] = -1;
    w.block_counts[b] = {0, 0};
  }
}

// By one thread block: the marked tiles in their order.
template <int Threads>
__device__ void list_tiles(const Workspace& w) {
  using Scan = cub::BlockScan<int, Threads>;
  __shared__ typename Scan::TempStorage storage;
  int listed = 0;
  for (int64_t begin = 0; begin < w.tiles; begin += Threads * int64_t(sizeof(uint4))) {
    const int64_t first = begin + threadIdx.x * int64_t(sizeof(uint4));
    uint4 marks = first < w.tiles ? *reinterpret_cast<const uint4*>(w.marked + first) : uint4{};
    int place, total;
    Scan(storage).ExclusiveSum(__popc(marks.x) + __popc(marks.y) + __popc(marks.z) + __popc(marks.w), place, total);
    const unsigned word[] = {marks.x, marks.y, marks.z, marks.w};
    place += listed;
    for (int k = 0; k < 16; k++)
      if (word[k / 4] >> (8 * (k % 4)) & 1) w.list[place++] = int(first) + k;
    listed += total;
    __syncthreads();
  }
  if (threadIdx.x == 0) *w.listed = listed;
}

// Row of the first particle.
template <class T, int D>
__device__ int first_row(const ActivateArguments<T, D>& a) {
  return a.copy && *a.copy ? a.copy_rows : 0;
}

// Particles [kThreads piece, kThreads (piece + 1)).
template <int Order, bool Marks, class T, int D>
__device__ void classify(const ActivateArguments<T, D>& a, const Workspace& w, int64_t piece) {
  const int64_t p = piece * kThreads + threadIdx.x;
  const bool exists = p < a.particles;
  const int64_t row = p + first_row(a);
  T x[D], f[D];
  int base[D], key = -1;
  unsigned touched = 0;
  if (exists) {
#pragma unroll
    for (int i = 0; i < D; i++) x[i] = a.x.pointer[row * a.x.stride[0] + i * a.x.stride[1]];
    const bool finite = is_finite<D>(x);
    const int scene = a.scene ? a.scene[p * a.scene_stride] : 0;
    if (finite && unsigned(scene) < unsigned(a.scenes) && locate<Order>(a.geometry, x, base, f)) {
      int block[D];
#pragma unroll
      for (int i = 0; i < D; i++) {
        block[i] = int(unsigned(base[i]) / kBlockWidth);
        base[i] &= kBlockWidth - 1;
      }
      touched = touched_blocks<Order, D>(base);
      key = block_index(a.geometry, scene, block);
    } else if (scene != kAbsent) {
      report(a, w.errors, finite, scene, int(row));
    }
  }
  // One atomic per block and warp: neighbours in memory are mostly neighbours in space.
  const unsigned group = __match_any_sync(~0u, exists ? key : INT_MIN);
  const unsigned before = group & ((1u << threadIdx.x % 32) - 1);
  const unsigned touched_by_group = __reduce_or_sync(group, touched);
  if (piece % kSampling == 0) {
    const int groups = __popc(__ballot_sync(~0u, exists && before == 0));
    if (threadIdx.x % 32 == 0) {
      atomicAdd(&w.counters->groups, groups);
      atomicAdd(&w.counters->warps, 1);
    }
  }
  int first = 0;
  if (exists && before == 0) {
    if (key < 0) {
      first = atomicAdd(&w.counters->tail, __popc(group));
    } else {
      BlockCount* counts = w.block_counts + key;
      first = atomicAdd(&counts->count, __popc(group));
      if (touched_by_group & ~*const_cast<volatile int*>(&counts->touched)) {
        atomicOr(&counts->touched, int(touched_by_group));
        if constexpr (Marks) mark_tiles(a, w, key, touched_by_group);
      }
    }
  }
  const int rank = __shfl_sync(~0u, first, __ffs(group) - 1) + __popc(before);
  if (exists) {
    w.key[p] = key;
    w.rank[p] = rank;
  }
}

// ---- One-pass scan (decoupled look-back, Merrill and Garland 2016). A state holds two 31-bit sums and, in the top
// bits, whether they are those of the tile alone (1) or of all tiles up to it (2).

constexpr Packed kSums = (Packed(1) << 62) - 1;
__device__ Packed pack(int a, int b) { return Packed(unsigned(a)) | Packed(unsigned(b)) << 31; }
__device__ int first_of(Packed v) { return int(v & 0x7fffffff); }
__device__ int second_of(Packed v) { return int(v >> 31 & 0x7fffffff); }

// Sum over the tiles before; called by a whole warp.
__device__ Packed sum_before(volatile Packed* states, int tile) {
  const int lane = threadIdx.x % 32;
  Packed sum = 0;
  for (int end = tile; end > 0; end -= 32) {
    const int t = end - 1 - lane;
    Packed state;
    do state = t >= 0 ? states[t] : Packed(2) << 62;
    while (__any_sync(~0u, state >> 62 == 0));
    const unsigned complete = __ballot_sync(~0u, state >> 62 == 2);
    Packed part = complete && lane > __ffs(complete) - 1 ? 0 : state & kSums;
#pragma unroll
    for (int o = 16; o > 0; o /= 2) part += __shfl_xor_sync(~0u, part, o);
    sum += part;
    if (complete) break;
  }
  return sum;
}

// Sum over all entries of the table before this thread's; every thread of the block calls it with its own value.
__device__ Packed exclusive_sum(Packed value, Packed* states, int tile) {
  using Scan = cub::BlockScan<Packed, kThreads>;
  __shared__ typename Scan::TempStorage storage;
  __shared__ Packed before;
  Packed inside, total;
  Scan(storage).ExclusiveSum(value, inside, total);
  if (threadIdx.x < 32) {
    volatile Packed* const state = states + tile;
    if (threadIdx.x == 0) *state = total | Packed(1) << 62;
    const Packed sum = sum_before(states, tile);
    if (threadIdx.x == 0) {
      *state = (sum + total) | Packed(2) << 62;
      before = sum;
    }
  }
  __syncthreads();
  return before + inside;
}

// Thread blocks take tiles in ascending order, so that the tiles before are always running or done.
__device__ int next_tile(int* counter) {
  __shared__ int tile;
  if (threadIdx.x == 0) tile = atomicAdd(counter, 1);
  __syncthreads();
  return tile;
}

// Calls body(number, first, last) with the number and the first table entry of one tile; or of each listed tile, or of
// all tiles in turn if fewer thread blocks may run than there are tiles.
template <bool Many, class F>
__device__ void each_tile(const Workspace& w, int* counter, const F& body) {
  if constexpr (!Many) {
    const int tile = next_tile(counter);
    body(tile, tile * kThreads, tile == w.tiles - 1);
  } else {
    const int count = w.marked ? *w.listed : w.tiles;
    for (int tile; (tile = next_tile(counter)) < count;) {
      body(tile, (w.marked ? w.list[tile] : tile) * kThreads, tile == count - 1);
      __syncthreads();  // all have read the number of this tile
    }
  }
}

// Whether particles lie in one of the blocks around a block.
template <class T, int D>
__device__ bool is_near_particles(const Geometry<T, D>& g, const Workspace& w, int b) {
  bool near = false;
  for_surroundings(g, b, [&](int c) { near = near || w.block_counts[c].count > 0; });
  return near;
}

template <bool Margin, bool Many, class T, int D>
__device__ void slots(const ActivateArguments<T, D>& a, const Workspace& w, int table) {
  each_tile<Many>(w, &w.counters->tile[0], [&](int tile, int first, bool last) {
    const int b = first + int(threadIdx.x);
    bool active = false;
    if (b < table) {
      int block[D];
      block_coordinates(a.geometry, b, block);
#pragma unroll
      for (int o = 0; o < 1 << D; o++) {
        bool inside = true;
#pragma unroll
        for (int i = 0; i < D; i++) inside = inside && block[i] >= (o >> (D - 1 - i) & 1);
        if (inside) active = active || w.block_counts[b - further(a.geometry, o)].touched >> o & 1;
      }
    }
    const bool margin = Margin && a.margin_blocks > 0 && b < table && !active && is_near_particles(a.geometry, w, b);
    const Packed before = exclusive_sum(pack(active, margin), w.slot_states, tile);
    if (last && threadIdx.x == kThreads - 1) {
      w.counters->wanted = first_of(before) + active;
      w.counters->margin = second_of(before) + margin;
    }
    if (b >= table) return;
    const int slot = margin ? a.max_blocks + second_of(before) : first_of(before);
    const bool given = (active && slot < a.max_blocks) || (margin && slot < a.slots());
    a.table[b] = given ? slot : -1;
    if (given) a.block[slot] = b;
  });
}

template <bool Many, class T, int D>
__device__ void offsets(const ActivateArguments<T, D>& a, const Workspace& w, int table) {
  each_tile<Many>(w, &w.counters->tile[1], [&](int tile, int first, bool last) {
    const int b = first + int(threadIdx.x);
    int count = 0, items = 0, slot = -1;
    if (b < table) {
      const BlockCount counts = w.block_counts[b];
      slot = a.table[b];
      count = counts.count;
      // Slots ascend with the table, so the furthest touched neighbour shows whether all have one.
      if (count > 0 && a.table[b + further(a.geometry, 31 - __clz(counts.touched))] < 0) {
        w.block_counts[b].count = -1 - atomicAdd(&w.counters->tail, count);
        count = 0;
      }
      const int most = a.most_of_item > 0 ? a.most_of_item : item_particles(a.particles);
      items = (count + most - 1) / most;
    }
    const Packed before = exclusive_sum(pack(count, items), w.offset_states, tile);
    const int start = first_of(before), item = second_of(before);
    if (last && threadIdx.x == kThreads - 1) {
      w.counters->transferred = start + count;
      w.counters->items = item + items;
    }
    if (b >= table) return;
    if (slot >= 0 && slot < a.max_blocks) a.offsets[slot] = start;
    if (count > 0) w.block_counts[b].count = start;
    int4* const out = reinterpret_cast<int4*>(lay_out_schedule<D>(a.schedule, a.slots(), a.particles).items) + item;
    for (int k = 0; k < items; k++) {
      const int begin = start + int(int64_t(count) * k / items), end = start + int(int64_t(count) * (k + 1) / items);
      out[k] = make_int4(slot, begin, end, b);
    }
  });
}

template <class T, int D>
__device__ void write_status(const ActivateArguments<T, D>& a, const Workspace& w, int row) {
  const int wanted = w.counters->wanted;
  const ParticleErrors& errors = w.errors[row];
  const int64_t start = row * int64_t(kStatusSize);
  int* const status = a.status + start;
  copy_status(a.previous_status ? a.previous_status + start : nullptr, status);
  const bool skipped = errors.outside.count > 0 || errors.not_finite.count > 0;
  if (status[kProblemActivation] < 0 && (skipped || (row == 0 && wanted > a.max_blocks))) {
    const int missed = a.missed && (a.missed->lost & Displacement::kMissed);
    status[kProblemActivation] = a.previous_status ? a.previous_status[kActivations] - missed : 0;
    const auto write = [&](const Skipped& out, int count, int first, int id) {
      if (out.count == 0) return;
      const int p = INT_MAX - out.first;
      status[count] = out.count;
      status[first] = p;
      if (row > 0) status[id] = a.id ? int(a.id[p * a.id_stride]) : p;
    };
    write(errors.outside, kOutsideCount, kOutsideFirst, kOutsideId);
    write(errors.not_finite, kNonFiniteCount, kNonFiniteFirst, kNonFiniteId);
  }
  if (row > 0) return;
  status[kActivations]++;
  status[kBlocksWanted] = ::max(status[kBlocksWanted], wanted);
  status[kBlocksNow] = wanted;
}

template <class T, int D>
__device__ void write_neighbours(const ActivateArguments<T, D>& a, int b, int neighbours[1 << D]) {
  int block[D];
  block_coordinates(a.geometry, b, block);
#pragma unroll
  for (int o = 0; o < 1 << D; o++) {
    int to = 0;
    bool inside = true;
#pragma unroll
    for (int i = 0; i < D; i++) {
      const int step = o >> (D - 1 - i) & 1;
      to = to * a.geometry.blocks[i] + step;
      inside = inside && block[i] + step < a.geometry.blocks[i];
    }
    neighbours[o] = inside ? a.table[b + to] : -1;
  }
}

// Slot i, particle i, and row i of the status.
template <class T, int D>
__device__ void place(const ActivateArguments<T, D>& a, const Workspace& w, int64_t i) {
  const Counters& c = *w.counters;
  const Schedule<int> schedule = lay_out_schedule<D>(a.schedule, a.slots(), a.particles);
  if (i == 0) {
    *schedule.item_count = c.items;
    *schedule.scattered = is_scattered(c.groups, c.warps);
    if (a.next_displacement && c.margin > a.margin_blocks) a.next_displacement->lost = Displacement::kLost;
  }
  if (i <= a.scenes) write_status(a, w, int(i));
  const bool with_particles = i < min(c.wanted, a.max_blocks);
  const bool given = with_particles || (i >= a.max_blocks && i < a.slots() && i - a.max_blocks < c.margin);
  if (given) write_neighbours(a, a.block[i], schedule.neighbours + (i << D));
  if (!given && i < a.slots()) a.block[i] = -1;
  if (!with_particles && i <= a.slots()) a.offsets[i] = c.transferred;
  if (i >= a.particles) return;
  const int key = w.key[i], first = key < 0 ? -1 : w.block_counts[key].count, base_slot = first < 0 ? -1 : a.table[key];
  schedule.base_slot[i] = base_slot;
  const int rank = w.rank[i];
  const int64_t position = first < 0 ? a.particles + first - rank : first + rank;
  if (a.deterministic) {
    w.slot[i] = base_slot < 0 ? a.slots() : base_slot;
    w.id[i] = int(i) + first_row(a);
    w.slot_sorted[position] = int(i);
  } else {
    a.index[position] = int(i) + first_row(a);
  }
}

// In place of a sort, if one kernel does everything: the particle at a position goes behind those of its block that
// precede it in memory.
template <class T, int D>
__device__ void put_in_order(const ActivateArguments<T, D>& a, const Workspace& w, int64_t position) {
  const int i = w.slot_sorted[position];
  const int slot = lay_out_schedule<D>(a.schedule, a.slots(), a.particles).base_slot[i];
  int64_t place = position;
  if (slot >= 0) {
    const int begin = a.offsets[slot], end = a.offsets[slot + 1];
    place = begin;
    for (int k = begin; k < end; k++) place += w.slot_sorted[k] < i;
  }
  a.index[place] = i + first_row(a);
}

// ---- Kernels

template <class T, int D>
__global__ void __launch_bounds__(kThreads)
    take_back_kernel(const ActivateArguments<T, D> a, const Workspace w, int n) {
  clear_previous(a, w, n);
}

template <int Order, bool Marks, class T, int D>
__global__ void __launch_bounds__(kThreads) classify_kernel(const ActivateArguments<T, D> a, const Workspace w) {
  classify<Order, Marks>(a, w, blockIdx.x);
}

constexpr int kListers = 1024;
__global__ void __launch_bounds__(kListers) list_tiles_kernel(const Workspace w) { list_tiles<kListers>(w); }

template <bool Margin, bool Many, class T, int D>
__global__ void __launch_bounds__(kThreads) slots_kernel(const ActivateArguments<T, D> a, const Workspace w, int n) {
  slots<Margin, Many>(a, w, n);
}

template <bool Many, class T, int D>
__global__ void __launch_bounds__(kThreads) offsets_kernel(const ActivateArguments<T, D> a, const Workspace w, int n) {
  offsets<Many>(a, w, n);
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) place_kernel(const ActivateArguments<T, D> a, const Workspace w) {
  place(a, w, int64_t(blockIdx.x) * kThreads + threadIdx.x);
}

// The whole activation, in fresh tensors for a table of few tiles, or in those of the previous activation; or only a
// row of the status if that activation still lasts. All thread blocks run at once and wait for each other.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kThreads)
    activate_at_once(const ActivateArguments<T, D> a, const Workspace w, int table, int64_t rows) {
  grid_dependency_sync();
  const int64_t start = int64_t(blockIdx.x) * kThreads + threadIdx.x, stride = int64_t(gridDim.x) * kThreads;
  if (a.displacement && !a.fresh && a.displacement->lasts(a.particles, a.out_of_block_cost)) {
    for (int64_t row = start; row <= a.scenes; row += stride) {
      int* const status = a.status + row * kStatusSize;
      copy_status(a.previous_status + row * kStatusSize, status);
      if (row == 0) status[kActivations]++;
    }
    return;
  }
  if (w.marked) clear_previous(a, w, table);
  int4* const workspace = static_cast<int4*>(a.workspace);
  for (int64_t i = start; i < (w.marked ? w.zeroed : w.zeroed_once) / int64_t(sizeof(int4)); i += stride)
    workspace[i] = {};
  wait_for_all();
  for (int64_t piece = blockIdx.x; piece * kThreads < a.particles; piece += gridDim.x) {
    if (w.marked)
      classify<Order, true>(a, w, piece);
    else
      classify<Order, false>(a, w, piece);
  }
  wait_for_all();
  if (w.marked) {
    if (blockIdx.x == 0) list_tiles<kThreads>(w);
    wait_for_all();
  }
  slots<true, true>(a, w, table);
  wait_for_all();
  offsets<true>(a, w, table);
  wait_for_all();
  for (int64_t i = start; i < rows; i += stride) place(a, w, i);
  if (!a.deterministic) return;
  wait_for_all();
  for (int64_t i = start; i < a.particles; i += stride) put_in_order(a, w, i);
}

unsigned blocks_for(int64_t threads) { return unsigned((threads + kThreads - 1) / kThreads); }

}  // namespace

template <class T, int D>
int64_t activate_workspace(const ActivateArguments<T, D>& a) {
  return lay_out(a).size;
}

template <int Order, class T, int D>
void activate(const ActivateArguments<T, D>& a, Stream stream) {
  const Workspace w = lay_out(a);
  const int table = a.scenes * a.geometry.blocks_per_scene;
  // Loops over slots with their end, or rows of the status; and over particles.
  const int64_t rows = std::max(a.particles, int64_t(std::max(a.slots(), a.scenes)) + 1);
  if ((a.displacement && !a.fresh) || (!w.marked && !a.deterministic)) {
    launch_at_once(activate_at_once<Order, T, D>, blocks_for(std::max<int64_t>(rows, w.marked ? 0 : table)), kThreads,
                   0, stream, a, w, table, rows);
    return;
  }
  // No more listed tiles have to run at once than fit on the device.
  const unsigned tiles = w.marked ? std::min(blocks_for(table), grid_size(a.slots() + 1)) : blocks_for(table);
  if (w.marked && !a.fresh)
    launch(take_back_kernel<T, D>, tiles, kThreads, 0, stream, a, w, table);
  else if (w.marked)
    check(cudaMemsetAsync(a.table, 0xff, table * sizeof(int), stream));
  check(cudaMemsetAsync(a.workspace, 0, a.fresh || !w.marked ? w.zeroed_once : w.zeroed, stream));
  const auto classify = w.marked ? classify_kernel<Order, true, T, D> : classify_kernel<Order, false, T, D>;
  if (a.particles > 0) launch(classify, blocks_for(a.particles), kThreads, 0, stream, a, w);
  if (table > 0) {
    if (w.marked) launch(list_tiles_kernel, 1, kListers, 0, stream, w);
    const auto slots = a.margin_blocks > 0
                           ? (w.marked ? slots_kernel<true, true, T, D> : slots_kernel<true, false, T, D>)
                           : (w.marked ? slots_kernel<false, true, T, D> : slots_kernel<false, false, T, D>);
    launch(slots, tiles, kThreads, 0, stream, a, w, table);
    const auto offsets = w.marked ? offsets_kernel<true, T, D> : offsets_kernel<false, T, D>;
    launch(offsets, tiles, kThreads, 0, stream, a, w, table);
  }
  launch(place_kernel<T, D>, blocks_for(rows), kThreads, 0, stream, a, w);
  if (a.deterministic && a.particles > 0) {
    size_t size = w.sort_size;
    check(cub::DeviceRadixSort::SortPairs(w.sort, size, w.slot, w.slot_sorted, w.id, a.index, int(a.particles), 0,
                                          bits_for(a.slots()), stream));
  }
}

MPM_INSTANTIATE_SIZE(activate_workspace, ActivateArguments)
MPM_INSTANTIATE_ORDERS(activate, ActivateArguments)

}  // namespace mpm::cuda
