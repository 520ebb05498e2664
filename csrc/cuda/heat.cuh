#pragma once

#include <cooperative_groups.h>

#include "cuda/heat_launchers.h"
#include "cuda/heat_scene.cuh"
#include "cuda/heat_sums.cuh"
#include "cuda/home.cuh"
#include "cuda/launch.cuh"
#include "heat/cell.h"

// The heat solve. Scenes that are small are solved one by one (csrc/cuda/heat_scene.cuh), the others here by one
// persistent kernel: all scenes advance together, phase by phase, with a barrier of the whole
// grid between phases; a scene that is done takes no further work, and the kernel ends with the last one. The host is
// never asked, and the kernel can be captured in a graph.
//
// H is applied by warps, one item of particles each. A lane takes a cell: it holds the nodes of the cell's support and
// what the cell adds to them in registers, and walks the cell's particles. To that end the particles are packed once,
// as distances from the base node and conductance, in the order in which the lanes read them.
namespace mpm::cuda {

namespace cg = cooperative_groups;

constexpr int kHeatThreads = 128, kHeatWarps = kHeatThreads / 32;
template <int D>
constexpr int kSlotLanes = kBlockNodes<D> / 4;  // that share the nodes of a slot

template <int Order_, class T_, int D_>
struct HeatShape {
  using T = T_;
  static constexpr int Order = Order_, D = D_, support = Order + 1, nodes = kSupportNodes<Order, D>;
  static constexpr int cells = kBlockNodes<D>;
  static constexpr int slices = cells < 32 ? 32 / cells : 1;  // lanes that share the particles of a cell
  static constexpr int parts = cells * slices / 32;           // of a block, one warp wide
  static constexpr int width = kBlockWidth + Order, tile = D == 2 ? width * width : width * width * width;
};

// Memory of one warp.
template <class S>
union WarpMemory {
  using T = typename S::T;
  struct {
    T u[S::tile], sum[S::tile];
  } tile;
  struct {
    uint16_t cell[kItemParticles], rank[kItemParticles], order[kItemParticles];
    int count[S::cells + 1], start[S::cells];
  } sort;
};

template <class T, int D>
struct PackedItems {
  PackedParticle<T, D>* particles;  // [P]
  uint16_t* counts;                 // [items, cells] particles of each cell
};

struct SceneRange {
  int item, item_end, slot, slot_end;
};

// Work space in global memory.
template <class T, int D>
struct HeatWorkspace {
  PackedItems<T, D> packed;
  HeatVectors<T> v;
  StartSums<T>* start;     // [capacity] of each slot
  StepSums<T>* step;       // [capacity]
  double* item_curvature;  // [items] parts of p · A p
  double* slot_curvature;  // [capacity]
  HeatScene* scene;        // [scenes]
  SceneRange* range;       // [scenes]
  int* running;            // [1] scenes at work
  SceneWorkspace apart;    // of small scenes
  int64_t size;            // in bytes

  // `vectors` false: what the operator alone needs.
  HeatWorkspace(const Topology<T, D>& t, void* memory, bool vectors, bool small = false) : apart{}, size(0) {
    char* const base = static_cast<char*>(memory);
    const auto take = [&](int64_t bytes) {
      char* p = base + size;
      size += (bytes + 255) / 256 * 256;
      return p;
    };
    const int64_t items = most_items(t.capacity, t.particles), nodes = t.capacity * int64_t(kBlockNodes<D>);
    packed.particles = reinterpret_cast<PackedParticle<T, D>*>(take(t.particles * sizeof(PackedParticle<T, D>)));
    packed.counts = reinterpret_cast<uint16_t*>(take(items * kBlockNodes<D> * sizeof(uint16_t)));
    if (!vectors) return;
    T** const all[] = {&v.mass, &v.weight, &v.inverse, &v.r, &v.p, &v.product};
    for (T** vector : all) *vector = reinterpret_cast<T*>(take(nodes * sizeof(T)));
    start = reinterpret_cast<StartSums<T>*>(take(t.capacity * sizeof(StartSums<T>)));
    step = reinterpret_cast<StepSums<T>*>(take(t.capacity * sizeof(StepSums<T>)));
    item_curvature = reinterpret_cast<double*>(take(items * sizeof(double)));
    slot_curvature = reinterpret_cast<double*>(take(t.capacity * sizeof(double)));
    scene = reinterpret_cast<HeatScene*>(take(t.scenes * sizeof(HeatScene)));
    range = reinterpret_cast<SceneRange*>(take(t.scenes * sizeof(SceneRange)));
    running = reinterpret_cast<int*>(take(sizeof(int)));
    if (!small) return;
    apart.order = reinterpret_cast<int*>(take(t.particles * sizeof(int)));
    apart.cells = reinterpret_cast<SceneCell*>(take((t.particles + t.scenes) * sizeof(SceneCell)));
    apart.left = reinterpret_cast<bool*>(take(t.scenes));
  }
};

// Particles that a lane takes of its cell in each part of a block.
template <class S>
struct LaneCounts {
  int of_part[S::parts];

  template <class I>
  __device__ explicit LaneCounts(const I* of_cell) {
    const int lane = lane_index(), slice = lane * S::slices / 32;
#pragma unroll
    for (int part = 0; part < S::parts; part++)
      of_part[part] = (int(of_cell[part * 32 + lane % (32 / S::slices)]) + S::slices - 1 - slice) / S::slices;
  }
};

// Calls begin(cell), each(particle) and end(cell) for the cells of an item, a warp's width of them at a time; load(at,
// cell, rank) gives the particle that lies at `at` in the packed order. All lanes call begin and end.
template <class S, class Load, class Begin, class Each, class End>
__device__ void walk_cells(const LaneCounts<S>& counts, int at, const Load& load, const Begin& begin, const Each& each,
                           const End& end) {
  const int lane = lane_index(), slice = lane * S::slices / 32;
  const unsigned before = (1u << lane) - 1;
#pragma unroll 1
  for (int part = 0; part < S::parts; part++) {
    const int cell = part * 32 + lane % (32 / S::slices),
              mine = part == 0 ? counts.of_part[0] : counts.of_part[S::parts - 1];
    bool has = mine > 0;
    unsigned lanes = __ballot_sync(~0u, has);
    if (!lanes) continue;
    begin(cell);
    decltype(load(0, 0, 0)) next;
    if (has) next = load(at + __popc(lanes & before), cell, slice);
#pragma unroll 1
    for (int k = 1; lanes; k++) {
      const auto now = next;
      const bool had = has;
      at += __popc(lanes);
      has = mine > k;
      lanes = __ballot_sync(~0u, has);
      if (has) next = load(at + __popc(lanes & before), cell, k * S::slices + slice);
      if (had) each(now);
    }
    end(cell);
  }
}

// Sorts the particles of an item by cell, by the ranks of the index tensor, and packs them.
template <class S, class T, int D>
__device__ void pack_item(const Topology<T, D>& t, const Columns<const T, D>& x, const Columns<const T, 1>& conductance,
                          const Item& item, int number, const PackedItems<T, D>& packed, WarpMemory<S>& memory) {
  auto& m = memory.sort;
  const int lane = lane_index(), n = item.end - item.begin, scene = scene_of(t, item.block);
  __syncwarp();
  for (int c = lane; c <= S::cells; c += 32) m.count[c] = 0;
  __syncwarp();
  for (int k = lane; k - lane < n; k += 32) {
    int cell = -1, base[D];
    T f[D];
    if (k < n) {
      const bool at_home =
          locate_at_home<S::Order>(t, scene, item.block, read_vector(x, t.index[item.begin + k]), base, f);
      cell = at_home ? node_in_block<D>(base) : S::cells;
    }
    const unsigned group = __match_any_sync(~0u, cell);
    const int before = __popc(group & ((1u << lane) - 1)), counted = cell >= 0 ? m.count[cell] : 0;
    __syncwarp();
    if (cell >= 0) {
      m.cell[k] = uint16_t(cell);
      m.rank[k] = uint16_t(counted + before);
      if (before == 0) m.count[cell] = counted + __popc(group);
    }
    __syncwarp();
  }
  int total = 0;
  for (int first = 0; first < S::cells; first += 32) {
    const int own = first + lane < S::cells ? m.count[first + lane] : 0;
    int sum = own;
    for (int o = 1; o < 32; o *= 2) {
      const int v = __shfl_up_sync(~0u, sum, o);
      if (lane >= o) sum += v;
    }
    if (first + lane < S::cells) {
      m.start[first + lane] = total + sum - own;
      packed.counts[int64_t(number) * S::cells + first + lane] = uint16_t(own);
    }
    total += __shfl_sync(~0u, sum, 31);
  }
  __syncwarp();
  for (int k = lane; k < n; k += 32)
    if (m.cell[k] < S::cells) m.order[m.start[m.cell[k]] + m.rank[k]] = uint16_t(k);
  __syncwarp();
  const auto nothing = [](int) {};
  struct Place {
    int at, particle;
  };
  walk_cells<S>(
      LaneCounts<S>(m.count), item.begin,
      [&](int at, int cell, int rank) { return Place{at, t.index[item.begin + m.order[m.start[cell] + rank]]}; },
      nothing,
      [&](const Place& place) {
        int base[D];
        PackedParticle<T, D> q;
        locate_at_home<S::Order>(t, scene, item.block, read_vector(x, place.particle), base, q.f);
        q.conductance = scaled_conductance<S::Order>(conductance.at(place.particle), t.geometry.inverse_dx);
        packed.particles[place.at] = q;
      },
      nothing);
  __syncwarp();
}

// The nodes of a home's tile, in rounds of a warp's width: entry r * 32 + lane of the tile is node row[r], -1 where it
// is none.
template <class S>
struct TileRows {
  static constexpr int rounds = (S::tile + 31) / 32;
  int row[rounds];

  template <class T, int D>
  __device__ TileRows(const Topology<T, D>& t, int slot) {
    const int lane = lane_index();
    const int* const neighbours = schedule_of(t).neighbours + (int64_t(slot) << D);
    const int slots = lane < 1 << D ? neighbours[lane] : -1;
#pragma unroll
    for (int r = 0; r < rounds; r++) {
      const int i = r * 32 + lane;
      int node[D], neighbour = 0;
#pragma unroll
      for (int axis = D - 1, rest = i; axis >= 0; axis--) {
        node[axis] = rest % S::width;
        neighbour |= (node[axis] >= kBlockWidth) << (D - 1 - axis);
        rest /= S::width;
      }
      const int at = __shfl_sync(~0u, slots, neighbour % (1 << D));
      row[r] = at < 0 || i >= S::tile ? -1 : at * kBlockNodes<D> + node_in_block<D>(node);
    }
  }
};

template <class S, class F>
__device__ void for_support(int cell, const F& f) {
  constexpr int width = S::width, support = S::support;
  const int z = cell % kBlockWidth, y = cell / kBlockWidth % kBlockWidth, x = cell / (kBlockWidth * kBlockWidth);
  const int corner = ((S::D == 3 ? x * width : 0) + y) * width + z;
#pragma unroll
  for (int i = 0; i < (S::D == 3 ? support : 1); i++)
#pragma unroll
    for (int j = 0; j < support; j++)
#pragma unroll
      for (int k = 0; k < support; k++) f((i * support + j) * support + k, corner + (i * width + j) * width + k);
}

// Adds a sum over the packed particles of the items [number, end), which are of one home, to the nodes; returns Σ κ V
// |∇u|², the same in all lanes.
template <HeatSum Sum, class S, class T, int D>
__device__ T sum_items(const Topology<T, D>& t, const PackedItems<T, D>& packed, int number, int end, const T* u,
                       T* out, bool in_order, WarpMemory<S>& memory) {
  auto& m = memory.tile;
  const Item* const items = reinterpret_cast<const Item*>(schedule_of(t).items);
  const int lane = lane_index();
  LaneCounts<S> counts(packed.counts + int64_t(number) * S::cells);
  const TileRows<S> rows(t, items[number].slot);
  T loaded[TileRows<S>::rounds];
  if (Sum == HeatSum::product)
#pragma unroll
    for (int r = 0; r < rows.rounds; r++) loaded[r] = rows.row[r] < 0 ? T(0) : u[rows.row[r]];
  __syncwarp();
#pragma unroll
  for (int r = 0; r < rows.rounds; r++) {
    const int i = r * 32 + lane;
    if (i >= S::tile) continue;
    if (Sum == HeatSum::product) m.u[i] = loaded[r];
    m.sum[i] = T(0);
  }
  __syncwarp();
  T from[S::nodes], to[S::nodes], power = T(0);
#pragma unroll 1
  while (true) {
    walk_cells<S>(
        counts, items[number].begin, [&](int at, int, int) { return packed.particles[at]; },
        [&](int cell) {
          for_support<S>(cell, [&](int k, int i) {
            if (Sum == HeatSum::product) from[k] = m.u[i];
            to[k] = T(0);
          });
        },
        [&](const PackedParticle<T, D>& q) {
          power += add_particle<Sum, S::Order, T, D>(q.f, q.conductance, from, to);
        },
        [&](int cell) {
          // One node of every cell at a time: they differ, so nothing is added twice at once.
          for_support<S>(cell, [&](int k, int i) {
            T value = to[k];
#pragma unroll
            for (int o = S::slices / 2; o > 0; o /= 2) value += __shfl_xor_sync(~0u, value, o * 32 / S::slices);
            if (S::slices == 1 || lane < 32 / S::slices) m.sum[i] += value;
            __syncwarp();
          });
        });
    if (++number >= end) break;
    counts = LaneCounts<S>(packed.counts + int64_t(number) * S::cells);
  }
#pragma unroll
  for (int r = 0; r < rows.rounds; r++) {
    const T value = rows.row[r] < 0 ? T(0) : m.sum[r * 32 + lane];
    if (value == T(0)) continue;
    if (in_order)
      out[rows.row[r]] += value;
    else
      atomicAdd(out + rows.row[r], value);
  }
#pragma unroll
  for (int o = 16; o > 0; o /= 2) power += __shfl_xor_sync(~0u, power, o);
  return power;
}

template <class T, int D>
__device__ int colour_of_home(const Topology<T, D>& t, int home) {
  int block[D], colour = 0;
  block_coordinates(t.geometry, home, block);
#pragma unroll
  for (int i = 0; i < D; i++) colour = colour * 2 + (block[i] & 1);
  return colour;
}

// f(first item, end) for the items of this warp; for a colour >= 0, the homes of that colour, whole.
template <class T, int D, class F>
__device__ void for_items(const Topology<T, D>& t, int colour, const F& f) {
  const Schedule<const int> schedule = schedule_of(t);
  const Item* const items = reinterpret_cast<const Item*>(schedule.items);
  const int count = *schedule.item_count, warps = gridDim.x * kHeatWarps;
#pragma unroll 1
  for (int i = blockIdx.x + threadIdx.x / 32 * gridDim.x; i < count; i += warps) {
    int end = i + 1;
    if (colour >= 0) {
      if (colour_of_home(t, items[i].block) != colour || items[i].begin != t.offsets[items[i].slot]) continue;
      while (end < count && items[end].slot == items[i].slot) end++;
    }
    f(i, end);
  }
}

template <int Order, class T, int D>
struct HeatKernel {
  using S = HeatShape<Order, T, D>;
  HeatArguments<T, D> a;
  HeatWorkspace<T, D> w;
  Columns<const T, D> x;
  Columns<const T, 1> conductance;

  HeatKernel(const HeatArguments<T, D>& a, bool small)
      : a(a), w(a.topology, a.workspace, true, small), x(a.x), conductance(a.conductance) {}

  // Whether the scene is solved here, and not by a thread block.
  __device__ bool takes(int scene) const { return !w.apart.left || w.apart.left[scene]; }
  __device__ bool takes_any() const {
    bool any = !w.apart.left;
    for (int scene = threadIdx.x; scene < a.topology.scenes && !any; scene += kHeatThreads) any = w.apart.left[scene];
    return __syncthreads_or(any);
  }

  __device__ int scene_of_slot(int slot) const {
    const int block = a.topology.block[slot], scene = block / a.topology.geometry.blocks_per_scene;
    return block < 0 || scene >= a.topology.scenes ? -1 : scene;
  }
  __device__ bool running(int scene) const { return scene >= 0 && w.scene[scene].running; }

  // Items and slots of a scene: both are in the order of the block table.
  __device__ SceneRange range_of(int scene) const {
    const Topology<T, D>& t = a.topology;
    const Schedule<const int> schedule = schedule_of(t);
    const Item* const items = reinterpret_cast<const Item*>(schedule.items);
    const auto first = [](int count, const auto& below) {
      int low = 0;
      while (low < count) {
        const int middle = (low + count) / 2;
        if (below(middle))
          low = middle + 1;
        else
          count = middle;
      }
      return low;
    };
    const auto item = [&](int s) {
      return first(*schedule.item_count, [&](int i) { return scene_of(t, items[i].block) < s; });
    };
    const auto slot = [&](int s) {
      return first(t.capacity, [&](int i) { return t.block[i] >= 0 && scene_of(t, t.block[i]) < s; });
    };
    return {item(scene), item(scene + 1), slot(scene), slot(scene + 1)};
  }

  // f(slot, scene, first node) for slots of scenes taken and unused ones: a slot takes kSlotLanes lanes, and a lane
  // every kSlotLanes-th node from its first on.
  template <class F>
  __device__ void for_slots(const F& f) const {
    constexpr int lanes = kSlotLanes<D>, slots = 32 / lanes;
    const int warp = blockIdx.x + threadIdx.x / 32 * gridDim.x, stride = gridDim.x * kHeatWarps * slots;
    for (int slot = warp * slots + lane_index() / lanes; slot < a.topology.capacity; slot += stride)
      if (const int scene = scene_of_slot(slot); scene < 0 || takes(scene))
        f(slot, scene, int64_t(slot) * kBlockNodes<D> + lane_index() % lanes);
  }
  template <class F>
  __device__ static void for_nodes(int64_t first, const F& f) {
#pragma unroll
    for (int n = 0; n < kBlockNodes<D>; n += kSlotLanes<D>) f(first + n);
  }
  __device__ static bool is_first_lane() { return lane_index() % kSlotLanes<D> == 0; }
  // f(scene) by one block of threads per scene taken.
  template <class F>
  __device__ void for_scenes(const F& f) const {
    for (int scene = blockIdx.x; scene < a.topology.scenes; scene += gridDim.x)
      if (takes(scene)) f(scene);
  }

  template <HeatSum Sum, class Wanted, class Finish>
  __device__ void sum_to(const T* u, T* out, WarpMemory<S>& memory, const Wanted& wanted, const Finish& finish) const {
    const Item* const items = reinterpret_cast<const Item*>(schedule_of(a.topology).items);
    for (int colour = a.deterministic ? 0 : -1; colour < (a.deterministic ? 1 << D : 0); colour++) {
      for_items(a.topology, colour, [&](int number, int end) {
        if (!wanted(scene_of(a.topology, items[number].block))) return;
        const T power = sum_items<Sum, S>(a.topology, w.packed, number, end, u, out, a.deterministic, memory);
        finish(number, end, power);
      });
      if (a.deterministic) cg::this_grid().sync();
    }
  }

  __device__ void start(WarpMemory<S>& memory) const;
  __device__ void iterate(WarpMemory<S>& memory) const;
  __device__ void finish() const;
};

template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::start(WarpMemory<S>& memory) const {
  const Topology<T, D>& t = a.topology;
  const int64_t threads = int64_t(gridDim.x) * kHeatThreads, thread = int64_t(blockIdx.x) * kHeatThreads + threadIdx.x;
  const auto all = [&](int scene) { return takes(scene); };
  const auto nothing = [](int, int, T) {};
  for (int64_t i = thread; i < int64_t(t.capacity) * kBlockNodes<D>; i += threads)
    w.v.product[i] = w.v.inverse[i] = w.v.weight[i] = T(0);
  for (int64_t scene = thread; scene < t.scenes; scene += threads) {
    w.range[scene] = range_of(int(scene));
    w.scene[scene].running = false;
  }
  if (thread == 0) *w.running = 0;
  const Item* const items = reinterpret_cast<const Item*>(schedule_of(t).items);
  for_items(t, -1, [&](int i, int) {
    if (takes(scene_of(t, items[i].block))) pack_item<S>(t, x, conductance, items[i], i, w.packed, memory);
  });
  cg::this_grid().sync();
  if (a.theta) sum_to<HeatSum::product>(a.theta, w.v.product, memory, all, nothing);
  if (a.method == HeatMethod::chebyshev)
    sum_to<HeatSum::bound>(nullptr, w.v.weight, memory, all, nothing);
  else
    sum_to<HeatSum::diagonal>(nullptr, w.v.inverse, memory, all, nothing);
  cg::this_grid().sync();
  for_slots([&](int slot, int scene, int64_t first) {
    auto sums = StartSums<T>::zero();
    const double dt = scene < 0 ? 1 : step_of_scene(a, scene);
    for_nodes(first, [&](int64_t i) {
      sums.add(start_node(a, w.v, i, i, dt, scene >= 0));
      a.increment[i] = T(0);
    });
    sums = sum_of_lanes<kSlotLanes<D>>(sums);
    if (is_first_lane()) w.start[slot] = sums;
  });
  cg::this_grid().sync();
  for_scenes([&](int scene) {
    auto sums = StartSums<double>::zero();
    for (int slot = w.range[scene].slot + threadIdx.x; slot < w.range[scene].slot_end; slot += kHeatThreads)
      sums.add(w.start[slot]);
    sums = sum_of_block(sums);
    if (threadIdx.x > 0) return;
    const HeatScene s = start_scene(a, scene, sums);
    w.scene[scene] = s;
    if (s.running) atomicAdd(w.running, 1);
  });
  cg::this_grid().sync();
}

template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::iterate(WarpMemory<S>& memory) const {
  for_slots([&](int slot, int scene, int64_t first) {
    if (!running(scene)) return;
    const T beta = T(w.scene[scene].beta), gamma = T(w.scene[scene].gamma);
    T weighted = T(0);
    for_nodes(first, [&](int64_t i) { weighted += direct_node(w.v, i, beta, gamma); });
    const Curvature sum = sum_of_lanes<kSlotLanes<D>>(Curvature{double(weighted)});
    if (is_first_lane()) w.slot_curvature[slot] = sum.value;
  });
  cg::this_grid().sync();
  sum_to<HeatSum::product>(
      w.v.p, w.v.product, memory, [&](int scene) { return running(scene); },
      [&](int number, int end, T power) {
        for (int i = number + lane_index(); i < end; i += 32) w.item_curvature[i] = i == number ? double(power) : 0;
      });
  cg::this_grid().sync();
  if (a.method == HeatMethod::conjugate_gradients) {
    for_scenes([&](int scene) {
      if (!running(scene)) return;
      const SceneRange range = w.range[scene];
      Curvature sum{0};
      for (int i = range.item + threadIdx.x; i < range.item_end; i += kHeatThreads) sum.value += w.item_curvature[i];
      for (int i = range.slot + threadIdx.x; i < range.slot_end; i += kHeatThreads) sum.value += w.slot_curvature[i];
      sum = sum_of_block(sum);
      if (threadIdx.x > 0) return;
      set_step(w.scene[scene], sum.value);
      if (!w.scene[scene].running) atomicSub(w.running, 1);
    });
    cg::this_grid().sync();
  }
  for_slots([&](int slot, int scene, int64_t first) {
    if (!running(scene)) return;
    const HeatScene& s = w.scene[scene];
    const T alpha = T(s.alpha);
    auto sums = StepSums<T>::zero();
    for_nodes(first, [&](int64_t i) { sums.add(update_node(w.v, a.increment, i, alpha)); });
    if (!wants_sums(s, a.method)) return;
    sums = sum_of_lanes<kSlotLanes<D>>(sums);
    if (is_first_lane()) w.step[slot] = sums;
  });
  cg::this_grid().sync();
  for_scenes([&](int scene) {
    if (!running(scene)) return;
    auto sums = StepSums<double>::zero();
    if (wants_sums(w.scene[scene], a.method)) {
      for (int slot = w.range[scene].slot + threadIdx.x; slot < w.range[scene].slot_end; slot += kHeatThreads)
        sums.add(w.step[slot]);
      sums = sum_of_block(sums);
    }
    __syncthreads();  // all have read the scene
    if (threadIdx.x > 0) return;
    finish_iteration(w.scene[scene], a.method, sums);
    if (!w.scene[scene].running) atomicSub(w.running, 1);
  });
  cg::this_grid().sync();
}

template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::finish() const {
  for_slots([&](int, int scene, int64_t first) {
    if (scene < 0) return;
    const T shift = T(energy_shift(w.scene[scene]));
    for_nodes(first, [&](int64_t i) {
      if (w.v.mass[i] != T(0)) a.increment[i] += shift;
    });
  });
  for (int scene = blockIdx.x * kHeatThreads + threadIdx.x; scene < a.topology.scenes;
       scene += gridDim.x * kHeatThreads)
    if (takes(scene)) report_scene(a, scene, w.scene[scene]);
}

// Thread blocks to fit in a multiprocessor at once, which limits registers.
template <int Order, class T>
constexpr int kHeatResident = Order == 2 && sizeof(T) == 4 ? 5 : 2;

template <int Order, class T, int D>
__global__ void __launch_bounds__(kHeatThreads, kHeatResident<Order, T>)
    heat_kernel(const HeatKernel<Order, T, D> kernel) {
  __shared__ WarpMemory<HeatShape<Order, T, D>> memory[kHeatWarps];
  WarpMemory<HeatShape<Order, T, D>>& own = memory[threadIdx.x / 32];
  if (!kernel.takes_any()) return;
  kernel.start(own);
  while (*static_cast<volatile int*>(kernel.w.running) > 0) kernel.iterate(own);
  kernel.finish();
}

// H u or the diagonal; colour as in `for_items`. The first launch packs the particles.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kHeatThreads)
    operator_kernel(const HeatOperatorArguments<T, D> a, const PackedItems<T, D> packed, const Columns<const T, D> x,
                    const Columns<const T, 1> conductance, int colour) {
  using S = HeatShape<Order, T, D>;
  __shared__ WarpMemory<S> memory[kHeatWarps];
  WarpMemory<S>& own = memory[threadIdx.x / 32];
  const Item* const items = reinterpret_cast<const Item*>(schedule_of(a.topology).items);
  for_items(a.topology, colour, [&](int number, int end) {
    for (int i = number; i < end; i++) pack_item<S>(a.topology, x, conductance, items[i], i, packed, own);
    if (a.nodes)
      sum_items<HeatSum::product, S>(a.topology, packed, number, end, a.nodes, a.sum, colour >= 0, own);
    else
      sum_items<HeatSum::diagonal, S>(a.topology, packed, number, end, a.nodes, a.sum, colour >= 0, own);
  });
}

template <int Order, class T, int D>
void heat_cg(const HeatArguments<T, D>& a, Stream stream) {
  const Topology<T, D>& t = a.topology;
  const bool small = small_scenes(t);
  HeatKernel<Order, T, D> kernel(a, small);
  if (small) solve_scenes<Order, T, D>({a, kernel.w.packed.particles, kernel.w.v, kernel.w.apart}, stream);
  const int processors = device_attribute(cudaDevAttrMultiProcessorCount);
  int resident = 0;
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, heat_kernel<Order, T, D>, kHeatThreads, 0));
  const int64_t wanted = std::max<int64_t>(most_items(t.capacity, t.particles), t.capacity) / kHeatWarps + 1;
  const unsigned blocks =
      unsigned(std::min<int64_t>(std::max<int64_t>(wanted, t.scenes), int64_t(processors) * resident));
  void* arguments[] = {&kernel};
  check(cudaLaunchCooperativeKernel(heat_kernel<Order, T, D>, blocks, kHeatThreads, arguments, 0, stream));
}

template <int Order, class T, int D>
void heat_operator(const HeatOperatorArguments<T, D>& a, Stream stream) {
  const int64_t items = most_items(a.topology.capacity, a.topology.particles);
  if (items == 0) return;
  const HeatWorkspace<T, D> w(a.topology, a.workspace, false);
  for (int colour = a.deterministic ? 0 : -1; colour < (a.deterministic ? 1 << D : 0); colour++)
    launch(operator_kernel<Order, T, D>, grid_size(items / kHeatWarps + 1), kHeatThreads, 0, stream, a, w.packed,
           Columns<const T, D>(a.x), Columns<const T, 1>(a.conductance), colour);
}

template <class T, int D>
int64_t heat_workspace(const HeatArguments<T, D>& a) {
  return HeatWorkspace<T, D>(a.topology, nullptr, true, small_scenes(a.topology)).size;
}
template <class T, int D>
int64_t heat_operator_workspace(const HeatOperatorArguments<T, D>& a) {
  return HeatWorkspace<T, D>(a.topology, nullptr, false).size;
}

#define INSTANTIATE_HEAT(T, D)                                                  \
  template int64_t heat_workspace(const HeatArguments<T, D>&);                  \
  template int64_t heat_operator_workspace(const HeatOperatorArguments<T, D>&); \
  INSTANTIATE_HEAT_ORDER(2, T, D)                                               \
  INSTANTIATE_HEAT_ORDER(3, T, D)
#define INSTANTIATE_HEAT_ORDER(Order, T, D)                               \
  template void heat_cg<Order, T, D>(const HeatArguments<T, D>&, Stream); \
  template void heat_operator<Order, T, D>(const HeatOperatorArguments<T, D>&, Stream);

}  // namespace mpm::cuda
