#include <cooperative_groups.h>

#include "cuda/base_block.cuh"
#include "cuda/columns.cuh"
#include "cuda/launch.cuh"
#include "cuda/quad.cuh"
#include "heat/cell.h"
#include "heat/scene.cuh"
#include "heat/solve.h"
#include "heat/sums.cuh"

// The heat solve. Scenes that are small are solved one by one (csrc/heat/scene.cuh), the others here by one
// persistent kernel: all scenes advance together, phase by phase, with a barrier of the whole grid between phases; a
// scene that is done takes no further work, and the kernel ends with the last one. The host is never asked, and the
// kernel can be captured in a graph.
//
// H is applied by warps, one item of particles each. A lane takes a cell: it holds the differences of the nodes of the
// cell's support and what the cell adds to them in registers, and walks the cell's particles. To that end the particles
// are packed once, as distances from the base node and conductance, in the order in which the lanes read them.
namespace mpm::cuda {

namespace cg = cooperative_groups;

// Threads of a block: of a solve as many as fit in a multiprocessor by their registers, so that few wait at barriers.
template <int Order, class T>
constexpr int kHeatThreads = Order == 2 && sizeof(T) == 4 ? 640 : 256;
constexpr int kOperatorThreads = 128;
constexpr int kItemWork = 192;  // of an item beside its particles, in particles: measured by instructions
template <int D>
constexpr int kSlotQuads = kBlockNodes<D> / kBlockWidth;

template <int Order_, class T_, int D_>
struct HeatShape {
  using T = T_;
  static constexpr int Order = Order_, D = D_, support = Order + 1, nodes = kSupportNodes<Order, D>;
  static constexpr int cells = kBlockNodes<D>;
  static constexpr int slices = cells < 32 ? 32 / cells : 1;  // lanes that share the particles of a cell
  static constexpr int parts = cells * slices / 32;           // of a block, one warp wide
  // A tile holds the nodes of a base block and the next Order along each axis: rows of two blocks, and planes set apart
  // so that the cells of a part lie in different banks.
  static constexpr int width = kBlockWidth + Order, row = 2 * kBlockWidth, plane = width * row + kBlockWidth;
  static constexpr int tile = D == 2 ? width * row : width * plane;
};

// Read by one warp only, which leaves the cache to the nodes.
template <class P>
__device__ P load_once(const P* p) {
  P q;
#pragma unroll
  for (int k = 0; k < sizeof(P) / sizeof(uint4); k++)
    reinterpret_cast<uint4*>(&q)[k] = __ldcs(reinterpret_cast<const uint4*>(p) + k);
  return q;
}

// Memory of one warp.
template <class S>
union WarpMemory {
  using T = typename S::T;
  struct {
    alignas(16) T u[S::tile];
    alignas(16) T sum[S::tile];
  } tile;
  struct {
    uint16_t rank[kItemParticles];
    unsigned lanes[kItemParticles];  // of a row: those that have a particle of this rank
    uint16_t start[kItemParticles];  // of a row in the packed order
    int count[S::cells + 1], row[S::parts];
  } sort;
};

template <class T, int D>
struct PackedItems {
  PackedParticle<T, D>* particles;  // [P]
  uint16_t* counts;                 // [items, cells] particles of each cell
};

// Items, slots and thread blocks of a scene; a block takes a row of items, and a row of slots.
struct SceneRange {
  int item, item_end, item_block, item_block_end, slot, slot_end, slot_block, slot_block_end;
};

// Of one solve; more would find nothing to do.
template <class T, int D>
int64_t most_thread_blocks(const Topology<T, D>& t) {
  return std::max<int64_t>(most_items(t.max_blocks, t.particles), t.max_blocks) / 4 + 1;
}

// Work space in global memory. A part of a sum is what one thread block adds to one scene. Blocks take their items and
// slots in the order of scenes, so that block + scene numbers the parts.
template <class T, int D>
struct HeatWorkspace {
  PackedItems<T, D> packed;
  HeatVectors<T> v;
  StartSums<double>* start;  // [parts], as those below
  StepSums<double>* step;
  Curvature* item_curvature;  // of p · H p
  Curvature* slot_curvature;  // of the rest of p · A p
  HeatScene* scene[2];        // [scenes] after an update, and before the next one
  SceneRange* range;          // [scenes]
  int* first_item;            // [blocks + 1] of each block
  int* used;                  // [1] slots
  int* running;               // [1] scenes at work
  unsigned* arrived;          // [1] at barriers, thread blocks
  SceneWorkspace apart;       // of small scenes
  int64_t size;               // in bytes

  // `vectors` false: what the operator alone needs.
  HeatWorkspace(const Topology<T, D>& t, void* memory, bool vectors, bool small = false) : apart{}, size(0) {
    char* const base = static_cast<char*>(memory);
    const auto take = [&](int64_t bytes) {
      char* p = base + size;
      size += (bytes + 255) / 256 * 256;
      return p;
    };
    const int64_t items = most_items(t.max_blocks, t.particles), nodes = t.max_blocks * int64_t(kBlockNodes<D>);
    packed.particles = reinterpret_cast<PackedParticle<T, D>*>(take(t.particles * sizeof(PackedParticle<T, D>)));
    packed.counts = reinterpret_cast<uint16_t*>(take(items * kBlockNodes<D> * sizeof(uint16_t)));
    if (!vectors) return;
    T** const all[] = {&v.mass, &v.weight, &v.inverse, &v.r, &v.p, &v.product};
    for (T** vector : all) *vector = reinterpret_cast<T*>(take(nodes * sizeof(T)));
    const int64_t parts = most_thread_blocks(t) + t.scenes;
    start = reinterpret_cast<StartSums<double>*>(take(parts * sizeof(StartSums<double>)));
    step = reinterpret_cast<StepSums<double>*>(take(parts * sizeof(StepSums<double>)));
    item_curvature = reinterpret_cast<Curvature*>(take(parts * sizeof(Curvature)));
    slot_curvature = reinterpret_cast<Curvature*>(take(parts * sizeof(Curvature)));
    for (HeatScene*& state : scene) state = reinterpret_cast<HeatScene*>(take(t.scenes * sizeof(HeatScene)));
    range = reinterpret_cast<SceneRange*>(take(t.scenes * sizeof(SceneRange)));
    first_item = reinterpret_cast<int*>(take((most_thread_blocks(t) + 1) * sizeof(int)));
    used = reinterpret_cast<int*>(take(sizeof(int)));
    running = reinterpret_cast<int*>(take(sizeof(int)));
    arrived = reinterpret_cast<unsigned*>(take(sizeof(unsigned)));
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

// Calls begin(cell, whether there are particles), each(particle) and end(cell) for the cells of an item, a warp's width
// of them at a time. All lanes do, where they have no particle with one that conducts nothing.
template <class S, class T, int D, class Begin, class Each, class End>
__device__ void walk_cells(const LaneCounts<S>& counts, const PackedParticle<T, D>* particles, const Begin& begin,
                           const Each& each, const End& end) {
  const int lane = lane_index();
  const unsigned before = (1u << lane) - 1;
#pragma unroll 1
  for (int part = 0; part < S::parts; part++) {
    const int cell = part * 32 + lane % (32 / S::slices);
    const int mine = part == 0 ? counts.of_part[0] : counts.of_part[S::parts - 1];
    bool has = mine > 0;
    unsigned lanes = __ballot_sync(~0u, has);
    if (!lanes) continue;
    PackedParticle<T, D> next{};
    if (has) next = load_once(particles + __popc(lanes & before));
    begin(cell, has);
#pragma unroll 1
    for (int k = 1; lanes; k++) {
      PackedParticle<T, D> now = next;
      if (!has) now.conductance = T(0);
      particles += __popc(lanes);
      has = mine > k;
      lanes = __ballot_sync(~0u, has);
      if (has) next = load_once(particles + __popc(lanes & before));
      each(now);
    }
    end(cell);
  }
}

// Packs the particles of an item as `walk_cells` reads them: row by row, the lanes of a row being those with a particle
// of this rank.
template <class S, class T, int D>
__device__ void pack_item(const Topology<T, D>& t, const Columns<const T, D>& x, const Columns<const T, 1>& conductance,
                          const Item& item, int number, const PackedItems<T, D>& packed, WarpMemory<S>& memory) {
  constexpr int width = 32 / S::slices;  // cells in a part
  auto& m = memory.sort;
  const int lane = lane_index(), n = item.end - item.begin;
  const int* const index = t.index + item.begin;
  BaseBlock<T, D> base_block;
  base_block.template set<S::Order>(t, item.block);
  __syncwarp();
  for (int c = lane; c <= S::cells; c += 32) m.count[c] = 0;
  __syncwarp();
  const auto index_at = [&](int k) { return k < n ? index[k] : 0; };
  Vector<T, D> ahead = read_vector(x, index_at(lane));  // loads are ahead of their use
  int particle = index_at(lane + 32);
#pragma unroll 1
  for (int k = lane; k - lane < n; k += 32) {
    const Vector<T, D> position = ahead;
    ahead = read_vector(x, particle);
    particle = index_at(k + 64);
    int cell = -1;
    T f[D];
    if (k < n) base_block.template locate<S::Order>(t.geometry, position, cell, f);
    const unsigned group = __match_any_sync(~0u, cell);
    const int before = __popc(group & ((1u << lane) - 1)), counted = cell >= 0 ? m.count[cell] : 0;
    __syncwarp();
    if (cell >= 0) {
      m.rank[k] = uint16_t(counted + before);
      if (before == 0) m.count[cell] = counted + __popc(group);
    }
    __syncwarp();
  }
  for (int c = lane; c < S::cells; c += 32) packed.counts[int64_t(number) * S::cells + c] = uint16_t(m.count[c]);
  const LaneCounts<S> counts(m.count);
#pragma unroll
  for (int part = 0, row = 0, at = 0; part < S::parts; part++) {
    if (lane == 0) m.row[part] = row;
    for (int k = 0; const unsigned lanes = __ballot_sync(~0u, counts.of_part[part] > k); k++, row++) {
      if (lane == 0) {
        m.lanes[row] = lanes;
        m.start[row] = uint16_t(at);
      }
      at += __popc(lanes);
    }
  }
  __syncwarp();
  ahead = read_vector(x, index_at(lane));
  T conductance_ahead = conductance.at(index_at(lane));
  particle = index_at(lane + 32);
#pragma unroll 1
  for (int k = lane; k < n; k += 32) {
    const Vector<T, D> position = ahead;
    PackedParticle<T, D> q;
    q.conductance = scaled_conductance<S::Order>(conductance_ahead, t.geometry.inverse_dx);
    ahead = read_vector(x, particle);
    conductance_ahead = conductance.at(particle);
    particle = index_at(k + 64);
    int cell;
    if (!base_block.template locate<S::Order>(t.geometry, position, cell, q.f)) continue;
    const int row = m.row[cell / width] + m.rank[k] / S::slices;
    const int place = m.rank[k] % S::slices * width + cell % width;
    const int at = m.start[row] + __popc(m.lanes[row] & ((1u << place) - 1));
    packed.particles[item.begin + at] = q;
  }
  __syncwarp();
}

// The quads of a base block's tile, in rounds of a warp's width: quad r of a lane lies at entry at[r] of the tile, and
// at node node[r], -1 where it is none.
template <class S>
struct TileQuads {
  static constexpr int rows = S::D == 2 ? S::width : S::width * S::width, rounds = (2 * rows + 31) / 32;
  int at[rounds], node[rounds];

  template <class T, int D>
  __device__ TileQuads(const Topology<T, D>& t, int slot) {
    const int lane = lane_index();
    const int* const neighbours = schedule_of(t).neighbours + (int64_t(slot) << D);
    const int slots = lane < 1 << D ? neighbours[lane] : -1;
#pragma unroll
    for (int r = 0; r < rounds; r++) {
      const int quad = r * 32 + lane, far = quad % 2, y = quad / 2 % S::width, x = quad / 2 / S::width;
      const int row[] = {x, y, 0};  // in 2-D, x is 0
      int neighbour = far;
#pragma unroll
      for (int axis = 0; axis < D - 1; axis++) neighbour |= (row[axis + 3 - D] >= kBlockWidth) << (D - 1 - axis);
      const int block = __shfl_sync(~0u, slots, neighbour % (1 << D));
      at[r] = x * S::plane + y * S::row + far * kBlockWidth;
      node[r] = block < 0 || quad >= 2 * rows ? -1 : block * kBlockNodes<D> + node_in_block<D>(row + 3 - D);
    }
  }
};

template <class S, class F>
__device__ void for_support(int cell, const F& f) {
  constexpr int support = S::support;
  const int z = cell % kBlockWidth, y = cell / kBlockWidth % kBlockWidth, x = cell / (kBlockWidth * kBlockWidth);
  const int corner = x * S::plane + y * S::row + z;
#pragma unroll
  for (int i = 0; i < (S::D == 3 ? support : 1); i++)
#pragma unroll
    for (int j = 0; j < support; j++)
#pragma unroll
      for (int k = 0; k < support; k++) f((i * support + j) * support + k, corner + i * S::plane + j * S::row + k);
}

// nodes += q by one atomic operation where there is one for four.
template <class T>
__device__ void add_quad(T* nodes, const Quad<T>& q) {
#if __CUDA_ARCH__ >= 900
  if constexpr (sizeof(T) == 4)
    atomicAdd(reinterpret_cast<float4*>(nodes), make_float4(q.e[0], q.e[1], q.e[2], q.e[3]));
  else
#endif
#pragma unroll
    for (int k = 0; k < kBlockWidth; k++)
      if (q.e[k] != T(0)) atomicAdd(nodes + k, q.e[k]);
}

// Adds a sum over the packed particles of the items [number, end), which are of one base block, to the nodes; returns Σ
// κ V |∇u|², the same in all lanes.
template <HeatSum Sum, class S, class T, int D>
__device__ T sum_items(const Topology<T, D>& t, const PackedItems<T, D>& packed, int number, int end, const T* u,
                       T* out, bool in_order, WarpMemory<S>& memory) {
  auto& m = memory.tile;
  const Item* const items = reinterpret_cast<const Item*>(schedule_of(t).items);
  LaneCounts<S> counts(packed.counts + int64_t(number) * S::cells);
  const TileQuads<S> quads(t, items[number].slot);
  Quad<T> loaded[TileQuads<S>::rounds];
#pragma unroll
  for (int r = 0; r < quads.rounds; r++)
    loaded[r] = Sum == HeatSum::product && quads.node[r] >= 0 ? load_quad(u + quads.node[r]) : Quad<T>{};
  __syncwarp();
#pragma unroll
  for (int r = 0; r < quads.rounds; r++) {
    if (r * 32 + lane_index() >= 2 * quads.rows) continue;
    if (Sum == HeatSum::product) store_quad(m.u + quads.at[r], loaded[r]);
    store_quad(m.sum + quads.at[r], Quad<T>{});
  }
  __syncwarp();
  T from[S::nodes], to[S::nodes], power = T(0);
#pragma unroll 1
  while (true) {
    walk_cells<S>(
        counts, packed.particles + items[number].begin,
        [&](int cell, bool some) {
          for_support<S>(cell, [&](int k, int i) {
            if (Sum == HeatSum::product) from[k] = some ? m.u[i] : T(0);  // u may be NaN away from the particles
            to[k] = T(0);
          });
          if (Sum == HeatSum::product) to_differences<S::Order, D>(from);
        },
        [&](const PackedParticle<T, D>& q) {
          power += add_particle<Sum, S::Order, T, D>(q.f, q.conductance, from, to);
        },
        [&](int cell) {
          if (Sum == HeatSum::product) to_nodes<S::Order, D>(to);
          // One node of every cell at a time: they differ, so nothing is added twice at once.
          for_support<S>(cell, [&](int k, int i) {
            T value = to[k];
#pragma unroll
            for (int o = S::slices / 2; o > 0; o /= 2) value += __shfl_xor_sync(~0u, value, o * 32 / S::slices);
            if (S::slices == 1 || lane_index() < 32 / S::slices) m.sum[i] += value;
            __syncwarp();
          });
        });
    if (++number >= end) break;
    counts = LaneCounts<S>(packed.counts + int64_t(number) * S::cells);
  }
#pragma unroll
  for (int r = 0; r < quads.rounds; r++) {
    if (quads.node[r] < 0) continue;
    const Quad<T> sum = load_quad(m.sum + quads.at[r]);
    T* const nodes = out + quads.node[r];
    if (!in_order) {
      add_quad(nodes, sum);
      continue;
    }
#pragma unroll
    for (int k = 0; k < kBlockWidth; k++) nodes[k] += sum.e[k];
  }
#pragma unroll
  for (int o = 16; o > 0; o /= 2) power += __shfl_xor_sync(~0u, power, o);
  return power;
}

// f(first item, end) for the items from `first` on that are this warp's, every `stride`-th; for a colour >= 0, the
// base blocks of that colour, whole.
template <class T, int D, class F>
__device__ void for_items(const Topology<T, D>& t, int first, int last, int stride, int colour, const F& f) {
  const Schedule<const int> schedule = schedule_of(t);
  const Item* const items = reinterpret_cast<const Item*>(schedule.items);
#pragma unroll 1
  for (int i = first; i < last; i += stride) {
    int end = i + 1;
    if (colour >= 0) {
      if (block_colour(t.geometry, items[i].block) != colour || items[i].begin != t.offsets[items[i].slot]) continue;
      while (end < *schedule.item_count && items[end].slot == items[i].slot) end++;
    }
    f(i, end);
  }
}
// Of all items, by the warps of all thread blocks.
template <class T, int D, class F>
__device__ void for_items(const Topology<T, D>& t, int colour, const F& f) {
  for_items(t, blockIdx.x + threadIdx.x / 32 * gridDim.x, *schedule_of(t).item_count, gridDim.x * (blockDim.x / 32),
            colour, f);
}

// How many of `count` entries are below; they come first.
template <class Below>
__device__ int entries_below(int count, const Below& below) {
  int low = 0;
  while (low < count) {
    const int middle = (low + count) / 2;
    if (below(middle))
      low = middle + 1;
    else
      count = middle;
  }
  return low;
}

// A kernel of three phases per iteration, a barrier of the grid after each: directions, product, update. What follows
// from the sums of a phase every thread block finds out by itself, for the scenes of its slots.
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
    for (int scene = threadIdx.x; scene < a.topology.scenes && !any; scene += blockDim.x) any = w.apart.left[scene];
    return __syncthreads_or(any);
  }

  // Barrier of the grid. That of cooperative groups asks for the last block without a pause, which slows down those
  // that are still at work.
  __device__ void wait_for_all() const {
    __syncthreads();
    if (threadIdx.x == 0) {
      __threadfence();
      const unsigned all = (atomicAdd(w.arrived, 1) / gridDim.x + 1) * gridDim.x;
      while (int(*static_cast<volatile unsigned*>(w.arrived) - all) < 0) __nanosleep(50);
      __threadfence();
    }
    __syncthreads();
  }

  __device__ const Item* items() const { return reinterpret_cast<const Item*>(schedule_of(a.topology).items); }
  __device__ int scene_of_item(int item) const { return scene_of(a.topology, items()[item].block); }
  __device__ int scene_of_slot(int slot) const { return scene_of(a.topology, a.topology.block[slot]); }

  // Slots of thread blocks: as many each.
  __device__ int first_slot(int block) const { return int(int64_t(*w.used) * block / gridDim.x); }
  __device__ int block_of_slot(int slot) const { return int((int64_t(slot + 1) * gridDim.x - 1) / *w.used); }
  // Items of thread blocks: as much work each.
  __device__ void lay_out_items(int block) const {
    const int count = *schedule_of(a.topology).item_count;
    const int64_t work = count > 0 ? items()[count - 1].end + int64_t(count) * kItemWork : 0;
    w.first_item[block] = entries_below(
        count, [&](int i) { return (items()[i].begin + int64_t(i) * kItemWork) * gridDim.x < work * block; });
  }
  __device__ int block_of_item(int item) const {
    return entries_below(gridDim.x, [&](int block) { return w.first_item[block + 1] <= item; });
  }
  // Items and slots are in the order of the block table, and so of scenes.
  __device__ void lay_out_scene(int scene) const {
    SceneRange& r = w.range[scene];
    const auto item = [&](int s) {
      return entries_below(*schedule_of(a.topology).item_count, [&](int i) { return scene_of_item(i) < s; });
    };
    const auto slot = [&](int s) {
      return entries_below(a.topology.max_blocks,
                           [&](int i) { return a.topology.block[i] >= 0 && scene_of_slot(i) < s; });
    };
    r.item = item(scene);
    r.item_end = item(scene + 1);
    r.slot = slot(scene);
    r.slot_end = slot(scene + 1);
    if (scene == a.topology.scenes - 1) *w.used = r.slot_end;
  }
  // When the above are known.
  __device__ void lay_out_parts(int scene) const {
    SceneRange& r = w.range[scene];
    r.item_block = r.slot_block = 0;
    r.item_block_end = r.slot_block_end = 0;
    if (r.item < r.item_end) {
      r.item_block = block_of_item(r.item);
      r.item_block_end = block_of_item(r.item_end - 1) + 1;
    }
    if (r.slot < r.slot_end) {
      r.slot_block = block_of_slot(r.slot);
      r.slot_block_end = block_of_slot(r.slot_end - 1) + 1;
    }
  }

  // f(scene, slot, end, whether they are the first of the scene) for the slots of this thread block, of scenes taken.
  template <class F>
  __device__ void for_slots(const F& f) const {
    const int last = first_slot(blockIdx.x + 1);
    for (int slot = first_slot(blockIdx.x), end; slot < last; slot = end) {
      const int scene = scene_of_slot(slot);
      end = min(last, w.range[scene].slot_end);
      if (takes(scene)) f(scene, slot, end, slot == w.range[scene].slot);
    }
  }
  // f(first node) for the quads of slots, a thread each.
  template <class F>
  __device__ static void for_quads(int slot, int end, const F& f) {
    for (int64_t quad = int64_t(slot) * kSlotQuads<D> + threadIdx.x; quad < int64_t(end) * kSlotQuads<D>;
         quad += blockDim.x)
      f(quad * kBlockWidth);
  }
  template <class V>
  __device__ void put_part(V* parts, int scene, const V& of_thread) const {
    const V sum = sum_of_block(of_thread);
    if (threadIdx.x == 0) parts[blockIdx.x + scene] = sum;
  }
  template <class V>
  __device__ static void add_parts(const V* parts, int scene, int block, int end, V& sum) {
    for (block += threadIdx.x; block < end; block += blockDim.x) sum.add(parts[block + scene]);
  }
  // What thread 0 decides, in all threads.
  template <class F>
  __device__ static HeatScene decide(const F& f) {
    __shared__ HeatScene scene;
    __syncthreads();
    if (threadIdx.x == 0) scene = f();
    __syncthreads();
    return scene;
  }

  // Adds a sum over particles to `out`, for the scenes wanted; the parts of p · H p are kept.
  template <HeatSum Sum, class Wanted>
  __device__ void sum_to(const T* u, T* out, WarpMemory<S>& memory, const Wanted& wanted) const {
    for (int colour = a.deterministic ? 0 : -1; colour < (a.deterministic ? 1 << D : 0); colour++) {
      const int last = w.first_item[blockIdx.x + 1];
      for (int item = w.first_item[blockIdx.x], end; item < last; item = end) {
        const int scene = scene_of_item(item);
        end = min(last, w.range[scene].item_end);
        if (!wanted(scene)) continue;
        Curvature sum{0};
        for_items(a.topology, item + threadIdx.x / 32, end, blockDim.x / 32, colour, [&](int number, int end) {
          const T power = sum_items<Sum, S>(a.topology, w.packed, number, end, u, out, a.deterministic, memory);
          if (lane_index() == 0) sum.value += double(power);
        });
        if (Sum != HeatSum::product) continue;
        if (colour > 0 && threadIdx.x == 0) sum.add(w.item_curvature[blockIdx.x + scene]);
        put_part(w.item_curvature, scene, sum);
      }
      if (a.deterministic) wait_for_all();
    }
  }

  __device__ void start(WarpMemory<S>& memory) const;
  __device__ void direct(bool first) const;
  __device__ void product(WarpMemory<S>& memory) const {
    sum_to<HeatSum::product>(w.v.p, w.v.product, memory, [&](int scene) { return w.scene[1][scene].running; });
    wait_for_all();
  }
  __device__ void update() const;
  __device__ void finish() const;
};

template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::start(WarpMemory<S>& memory) const {
  const Topology<T, D>& t = a.topology;
  const int64_t threads = int64_t(gridDim.x) * blockDim.x, thread = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  const auto all = [&](int scene) { return takes(scene); };
  for (int64_t quad = thread; quad < int64_t(t.max_blocks) * kSlotQuads<D>; quad += threads) {
    T* const vectors[] = {w.v.product, w.v.inverse, w.v.weight};
#pragma unroll
    for (T* vector : vectors) store_quad(vector + quad * kBlockWidth, Quad<T>{});
  }
  for (int64_t scene = thread; scene < t.scenes; scene += threads) {
    lay_out_scene(int(scene));
    w.scene[1][scene].running = false;
  }
  for (int64_t block = thread; block <= gridDim.x; block += threads) lay_out_items(int(block));
  for (int64_t part = thread; part < gridDim.x + t.scenes; part += threads) {
    w.start[part] = StartSums<double>::zero();
    w.step[part] = StepSums<double>::zero();
    w.item_curvature[part] = w.slot_curvature[part] = {0};
  }
  if (thread == 0) *w.running = *w.arrived = 0;
  for_items(t, -1, [&](int i, int) {
    if (takes(scene_of_item(i))) pack_item<S>(t, x, conductance, items()[i], i, w.packed, memory);
  });
  cg::this_grid().sync();
  for (int64_t scene = thread; scene < t.scenes; scene += threads) lay_out_parts(int(scene));
  if (a.theta) sum_to<HeatSum::product>(a.theta, w.v.product, memory, all);
  if (a.method == HeatMethod::chebyshev)
    sum_to<HeatSum::bound>(nullptr, w.v.weight, memory, all);
  else
    sum_to<HeatSum::diagonal>(nullptr, w.v.inverse, memory, all);
  wait_for_all();
  for_slots([&](int scene, int slot, int end, bool) {
    const double dt = step_of_scene(a, scene);
    auto sums = StartSums<double>::zero();
    for_quads(slot, end, [&](int64_t i) {
      Quad<T> mass, weight = load_quad(w.v.weight + i), inverse = load_quad(w.v.inverse + i), r, p;
      Quad<T> product = load_quad(w.v.product + i);
      const HeatVectors<T> v{mass.e, weight.e, inverse.e, r.e, p.e, product.e};
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++) sums.add(start_node(a, v, i + k, k, dt, true));
      store_quad(w.v.mass + i, mass);
      store_quad(w.v.weight + i, weight);
      store_quad(w.v.inverse + i, inverse);
      store_quad(w.v.r + i, r);
      store_quad(w.v.p + i, p);
      store_quad(w.v.product + i, product);
      store_quad(a.increment + i, Quad<T>{});
    });
    put_part(w.start, scene, sums);
  });
  for (int64_t quad = int64_t(*w.used) * kSlotQuads<D> + thread; quad < int64_t(t.max_blocks) * kSlotQuads<D>;
       quad += threads)
    store_quad(a.increment + quad * kBlockWidth, Quad<T>{});
  wait_for_all();
}

// The decision after an update, and the next direction.
template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::direct(bool first) const {
  for_slots([&](int scene, int slot, int end, bool owner) {
    const SceneRange range = w.range[scene];
    HeatScene s;
    if (first) {
      auto sums = StartSums<double>::zero();
      add_parts(w.start, scene, range.slot_block, range.slot_block_end, sums);
      sums = sum_of_block(sums);
      s = decide([&] { return start_scene(a, scene, sums); });
      if (owner && threadIdx.x == 0 && s.running) atomicAdd(w.running, 1);
    } else {
      s = w.scene[0][scene];
      if (s.running) {
        auto sums = StepSums<double>::zero();
        if (wants_sums(s, a.method)) add_parts(w.step, scene, range.slot_block, range.slot_block_end, sums);
        sums = sum_of_block(sums);
        s = decide([&] {
          HeatScene next = s;
          finish_iteration(next, a.method, sums);
          return next;
        });
        if (owner && threadIdx.x == 0 && !s.running) atomicSub(w.running, 1);
      }
    }
    if (owner && threadIdx.x == 0) w.scene[1][scene] = s;
    if (!s.running) return;
    const T beta = T(s.beta), gamma = T(s.gamma);
    Curvature sum{0};
    for_quads(slot, end, [&](int64_t i) {
      Quad<T> weight = load_quad(w.v.weight + i), inverse = load_quad(w.v.inverse + i), r = load_quad(w.v.r + i);
      Quad<T> p = load_quad(w.v.p + i);
      const HeatVectors<T> v{nullptr, weight.e, inverse.e, r.e, p.e, nullptr};
      T weighted = T(0);
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++) weighted += direct_node(v, k, beta, gamma);
      store_quad(w.v.p + i, p);
      sum.value += double(weighted);
    });
    put_part(w.slot_curvature, scene, sum);
  });
  wait_for_all();
}

// The step length, and the step.
template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::update() const {
  for_slots([&](int scene, int slot, int end, bool owner) {
    const SceneRange range = w.range[scene];
    HeatScene s = w.scene[1][scene];
    if (s.running && a.method == HeatMethod::conjugate_gradients) {
      Curvature sum{0};
      add_parts(w.item_curvature, scene, range.item_block, range.item_block_end, sum);
      add_parts(w.slot_curvature, scene, range.slot_block, range.slot_block_end, sum);
      sum = sum_of_block(sum);
      s = decide([&] {
        HeatScene next = s;
        set_step(next, sum.value);
        return next;
      });
      if (owner && threadIdx.x == 0 && !s.running) atomicSub(w.running, 1);
    }
    if (owner && threadIdx.x == 0) w.scene[0][scene] = s;
    if (!s.running) return;
    const T alpha = T(s.alpha);
    auto sums = StepSums<double>::zero();
    for_quads(slot, end, [&](int64_t i) {
      Quad<T> mass = load_quad(w.v.mass + i), weight = load_quad(w.v.weight + i), inverse = load_quad(w.v.inverse + i);
      Quad<T> r = load_quad(w.v.r + i), p = load_quad(w.v.p + i), product = load_quad(w.v.product + i);
      Quad<T> increment = load_quad(a.increment + i);
      const HeatVectors<T> v{mass.e, weight.e, inverse.e, r.e, p.e, product.e};
      auto of_quad = StepSums<T>::zero();
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++) of_quad.add(update_node(v, increment.e, k, alpha));
      store_quad(w.v.product + i, product);
      store_quad(w.v.r + i, r);
      store_quad(a.increment + i, increment);
      sums.add(of_quad);
    });
    if (wants_sums(s, a.method)) put_part(w.step, scene, sums);
  });
  wait_for_all();
}

template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::finish() const {
  for_slots([&](int scene, int slot, int end, bool) {
    const T shift = T(energy_shift(w.scene[1][scene]));
    for_quads(slot, end, [&](int64_t i) {
      const Quad<T> mass = load_quad(w.v.mass + i);
      Quad<T> increment = load_quad(a.increment + i);
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++)
        if (mass.e[k] != T(0)) increment.e[k] += shift;
      store_quad(a.increment + i, increment);
    });
  });
  for (int scene = blockIdx.x * blockDim.x + threadIdx.x; scene < a.topology.scenes; scene += gridDim.x * blockDim.x) {
    if (!takes(scene)) continue;
    const bool empty = w.range[scene].slot == w.range[scene].slot_end;
    report_scene(a, scene, empty ? start_scene(a, scene, StartSums<double>::zero()) : w.scene[1][scene]);
  }
}

template <int Order, class T, int D>
__global__ void __launch_bounds__(kHeatThreads<Order, T>, 1) heat_kernel(const HeatKernel<Order, T, D> kernel) {
  extern __shared__ uint4 dynamic[];
  auto& own = reinterpret_cast<WarpMemory<HeatShape<Order, T, D>>*>(dynamic)[threadIdx.x / 32];
  if (!kernel.takes_any()) return;
  kernel.start(own);
  for (kernel.direct(true); *static_cast<volatile int*>(kernel.w.running) > 0; kernel.direct(false)) {
    kernel.product(own);
    kernel.update();
  }
  kernel.finish();
}

// H u or the diagonal; colour as in `for_items`. The first launch packs the particles.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kOperatorThreads)
    operator_kernel(const HeatOperatorArguments<T, D> a, const PackedItems<T, D> packed, const Columns<const T, D> x,
                    const Columns<const T, 1> conductance, int colour) {
  using S = HeatShape<Order, T, D>;
  __shared__ WarpMemory<S> memory[kOperatorThreads / 32];
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
  constexpr int threads = kHeatThreads<Order, T>,
                shared_memory = threads / 32 * sizeof(WarpMemory<HeatShape<Order, T, D>>);
  const auto function = heat_kernel<Order, T, D>;
  int resident = 0;
  check(cudaFuncSetAttribute(function, cudaFuncAttributeMaxDynamicSharedMemorySize, shared_memory));
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, function, threads, shared_memory));
  const unsigned blocks = unsigned(
      std::min<int64_t>(most_thread_blocks(t), int64_t(device_attribute(cudaDevAttrMultiProcessorCount)) * resident));
  void* arguments[] = {&kernel};
  check(cudaLaunchCooperativeKernel(function, blocks, threads, arguments, shared_memory, stream));
}

template <int Order, class T, int D>
void heat_operator(const HeatOperatorArguments<T, D>& a, Stream stream) {
  const int64_t items = most_items(a.topology.max_blocks, a.topology.particles);
  if (items == 0) return;
  const HeatWorkspace<T, D> w(a.topology, a.workspace, false);
  for (int colour = a.deterministic ? 0 : -1; colour < (a.deterministic ? 1 << D : 0); colour++)
    launch(operator_kernel<Order, T, D>, grid_size(items * 32 / kOperatorThreads + 1), kOperatorThreads, 0, stream, a,
           w.packed, Columns<const T, D>(a.x), Columns<const T, 1>(a.conductance), colour);
}

template <class T, int D>
int64_t heat_workspace(const HeatArguments<T, D>& a) {
  return HeatWorkspace<T, D>(a.topology, nullptr, true, small_scenes(a.topology)).size;
}
template <class T, int D>
int64_t heat_operator_workspace(const HeatOperatorArguments<T, D>& a) {
  return HeatWorkspace<T, D>(a.topology, nullptr, false).size;
}

MPM_INSTANTIATE_SIZE(heat_workspace, HeatArguments)
MPM_INSTANTIATE_ORDERS(heat_cg, HeatArguments)
MPM_INSTANTIATE_SIZE(heat_operator_workspace, HeatOperatorArguments)
MPM_INSTANTIATE_ORDERS(heat_operator, HeatOperatorArguments)

}  // namespace mpm::cuda
