#pragma once

#include <utility>

#include "cuda/base_block.cuh"
#include "cuda/columns.cuh"
#include "cuda/vec4.cuh"
#include "heat/cell.h"
#include "heat/solve.h"
#include "heat/sums.cuh"

// The heat operator H, applied by warps, one item of particles each. A lane processes a cell: it holds the differences
// of the nodes of the cell's support and the contributions of the cell to them in registers, and walks the cell's
// particles. For this the particles are packed once, as distances from the base node and conductance, in the order of
// reading by the lanes.
namespace mpm::cuda {

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

// Read by only one warp, so that the cache is left to the nodes.
template <class P>
__device__ P load_once(const P* p) {
  P q;
#pragma unroll
  for (int k = 0; k < sizeof(P) / sizeof(uint4); k++)
    reinterpret_cast<uint4*>(&q)[k] = __ldcs(reinterpret_cast<const uint4*>(p) + k);
  return q;
}

// The packed order of an item: row by row, where the lanes of a row are those with a particle of this rank.
template <class S, int Most = kItemParticles>
struct PackedOrder {
  uint16_t rank[Most];
  unsigned lanes[Most];  // of a row
  uint16_t start[Most];  // of a row in the packed order
  int count[S::cells + 1], row[S::parts];

  __device__ int place(int cell, int rank) const {
    constexpr int width = 32 / S::slices;  // cells in a part
    const int number = row[cell / width] + rank / S::slices, lane = rank % S::slices * width + cell % width;
    return start[number] + __popc(lanes[number] & ((1u << lane) - 1));
  }
};

// Memory of one warp.
template <class S>
union WarpMemory {
  using T = typename S::T;
  struct {
    alignas(16) T u[S::tile];
    alignas(16) T sum[S::tile];
  } tile;
  PackedOrder<S> sort;
};

// Bytes of a part of a work space.
inline int64_t align_workspace(int64_t bytes) { return (bytes + 255) / 256 * 256; }

template <class T, int D>
struct PackedItems {
  PackedParticle<T, D>* particles;  // [P]
  uint16_t* counts;                 // [items, cells] particles of each cell
  T* tiles;                         // [slots, kTile] sums of base blocks, where these have an order
  static constexpr int kTile = HeatShape<3, T, D>::tile;  // that of quadratic weights is smaller

  // In a work space, where take(bytes) returns memory.
  template <class Take>
  void lay_out(const Topology<T, D>& t, bool has_tiles, const Take& take) {
    // Small items, in 2-D, may be more than most_items().
    const int64_t items = D == 2 ? room_for_items(t.max_blocks, t.particles) : most_items(t.max_blocks, t.particles);
    particles = reinterpret_cast<PackedParticle<T, D>*>(take(t.particles * sizeof(PackedParticle<T, D>)));
    counts = reinterpret_cast<uint16_t*>(take(items * kBlockNodes<D> * sizeof(uint16_t)));
    tiles = reinterpret_cast<T*>(take(has_tiles ? int64_t(t.max_blocks) * kTile * sizeof(T) : 0));
  }
};

// Those of the simple steps come first in the work space of a solve, as in csrc/heat/heat.cu.
template <class T, int D>
PackedItems<T, D> packed_in(void* workspace, const Topology<T, D>& t, bool has_tiles) {
  PackedItems<T, D> packed;
  char* next = static_cast<char*>(workspace);
  packed.lay_out(t, has_tiles, [&](int64_t bytes) { return std::exchange(next, next + align_workspace(bytes)); });
  return packed;
}

// A particle out of its base block, in the form of a packed one.
template <class T, int D>
__device__ PackedParticle<T, D> packed_out_of_block(int particle, const T& conductance) {
  PackedParticle<T, D> q{};
  reinterpret_cast<int&>(q.f[0]) = particle;
  q.conductance = conductance;
  return q;
}

// Stores a particle of the item [begin, end): in its cell, by its rank there; or out of the block, from the end on, by
// its number particle().
template <class S, int Most, class T, int D, class Number>
__device__ void store_packed(const PackedItems<T, D>& packed, const PackedOrder<S, Most>& order, int begin, int end,
                             int cell, int rank, const PackedParticle<T, D>& q, const Number& particle) {
  if (cell < S::cells)
    packed.particles[begin + order.place(cell, rank)] = q;
  else
    packed.particles[end - 1 - rank] = packed_out_of_block<T, D>(particle(), q.conductance);
}

// Particles of its cell that a lane processes in each part of a block.
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

// A walk over the cells of an item, one part of them at a time, as wide as a warp. All lanes take part, with a
// non-conducting particle where they have none. Of several warps that share an item, each processes only one part, and
// those of the same part every `share`-th row of its packed order. The first particles are loaded at once.
template <class S, int Warps, class T, int D>
class CellWalk {
  static_assert(Warps == 1 || Warps % S::parts == 0);
  static constexpr int share = Warps == 1 ? 1 : Warps / S::parts;  // warps of a part

 public:
  __device__ CellWalk(const LaneCounts<S>& counts, const PackedParticle<T, D>* particles, int warp)
      : counts_(counts), particles_(particles) {
    if (Warps > 1)
      for (; part_ < warp % S::parts; part_++) particles_ += __reduce_add_sync(~0u, counts_.of_part[part_]);
    start_part(warp / S::parts);
  }

  // Calls begin(cell, whether there are particles), each(particle) and end(cell) for the cells.
  template <class Begin, class Each, class End>
  __device__ void run(const Begin& begin, const Each& each, const End& end) {
#pragma unroll 1
    while (true) {
      const int cell = part_ * 32 + lane_index() % (32 / S::slices);
      if (lanes_) begin(cell, has_);
      const bool some = lanes_ != 0;
#pragma unroll 1
      while (lanes_) {
        PackedParticle<T, D> now = next_;
        if (!has_) now.conductance = T(0);
        particles_ += __popc(lanes_);
        row_++;
#pragma unroll
        for (int other = 1; other < share; other++) skip_row();
        load();
        each(now);
      }
      if (some) end(cell);
      if (Warps > 1 || ++part_ == S::parts) return;
      start_part(0);
    }
  }

 private:
  LaneCounts<S> counts_;
  const PackedParticle<T, D>* particles_;
  int part_ = 0, mine_ = 0, row_ = 0;
  bool has_ = false;
  unsigned lanes_ = 0;
  PackedParticle<T, D> next_{};

  __device__ void skip_row() { particles_ += __popc(__ballot_sync(~0u, mine_ > row_++)); }
  __device__ void load() {
    has_ = mine_ > row_;
    lanes_ = __ballot_sync(~0u, has_);
    if (has_) next_ = load_once(particles_ + __popc(lanes_ & ((1u << lane_index()) - 1)));
  }
  __device__ void start_part(int row) {
    mine_ = part_ == 0 ? counts_.of_part[0] : counts_.of_part[S::parts - 1];
    row_ = 0;
    if (Warps > 1)
      while (row_ < row) skip_row();
    load();
  }
};

// Makes the rows for the counts of the cells, by one warp.
template <class S, int Most>
__device__ void set_rows(PackedOrder<S, Most>& m) {
  const LaneCounts<S> counts(m.count);
#pragma unroll
  for (int part = 0, row = 0, at = 0; part < S::parts; part++) {
    if (lane_index() == 0) m.row[part] = row;
    for (int k = 0; const unsigned lanes = __ballot_sync(~0u, counts.of_part[part] > k); k++, row++) {
      if (lane_index() == 0) {
        m.lanes[row] = lanes;
        m.start[row] = uint16_t(at);
      }
      at += __popc(lanes);
    }
  }
}

// Packs the particles of an item in the order of a walk.
template <class S, class T, int D>
__device__ void pack_item(const Topology<T, D>& t, const Columns<const T, D>& x, const Columns<const T, 1>& conductance,
                          const Item& item, int number, const PackedItems<T, D>& packed, WarpMemory<S>& memory) {
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
  set_rows(m);
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
    packed.particles[item.begin + m.place(cell, m.rank[k])] = q;
  }
  __syncwarp();
}

// Quads of a base block's tile, which the threads of one or several warps share: quad r of a thread lies at entry at[r]
// of the tile, and at node node[r], -1 where there is none.
template <class S, int Threads = 32>
struct TileQuads {
  static constexpr int rows = S::D == 2 ? S::width : S::width * S::width, rounds = (2 * rows + Threads - 1) / Threads;
  int at[rounds], node[rounds];

  template <class T, int D>
  __device__ TileQuads(const Topology<T, D>& t, int slot) {
    const int lane = lane_index();
    const int* const neighbours = schedule_of(t).neighbours + (int64_t(slot) << D);
    const int slots = lane < 1 << D ? neighbours[lane] : -1;
#pragma unroll
    for (int r = 0; r < rounds; r++) {
      const int quad = quad_of(r), far = quad % 2, y = quad / 2 % S::width, x = quad / 2 / S::width;
      const int row[] = {x, y, 0};  // in 2-D, x is 0
      int neighbour = far;
#pragma unroll
      for (int axis = 0; axis < D - 1; axis++) neighbour |= (row[axis + 3 - D] >= kBlockWidth) << (D - 1 - axis);
      const int block = __shfl_sync(~0u, slots, neighbour % (1 << D));
      at[r] = x * S::plane + y * S::row + far * kBlockWidth;
      node[r] = block < 0 || !in_tile(r) ? -1 : block * kBlockNodes<D> + node_in_block<D>(row + 3 - D);
    }
  }
  __device__ static bool in_tile(int r) { return quad_of(r) < 2 * rows; }

 private:
  __device__ static int quad_of(int r) { return r * Threads + int(threadIdx.x) % Threads; }
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
__device__ void add_quad(T* nodes, const Vec4<T>& q) {
#if __CUDA_ARCH__ >= 900
  if constexpr (sizeof(T) == 4)
    atomicAdd(reinterpret_cast<float4*>(nodes), make_float4(q.e[0], q.e[1], q.e[2], q.e[3]));
  else
#endif
#pragma unroll
    for (int k = 0; k < kBlockWidth; k++)
      if (q.e[k] != T(0)) atomicAdd(nodes + k, q.e[k]);
}

// Values u of four nodes of a row, from an array.
template <class T>
struct StoredValues {
  const T* u;
  __device__ Vec4<T> at(int node) const { return load_vec4(u + node); }
};

// Those at the start of a solve.
template <class T, int D>
struct StartValues {
  const HeatArguments<T, D>& a;
  __device__ Vec4<T> at(int node) const {
    if (a.theta) return load_vec4(a.theta + node);
    static_assert(kHeatChannels == 4);
    Vec4<T> u;
#pragma unroll
    for (int k = 0; k < kBlockWidth; k++) {
      const Vec4<T> sum = load_vec4(a.sums + int64_t(node + k) * kHeatChannels);
      u.e[k] = mean_of(sum.e[kHeatTheta], sum.e[kHeatCapacity]);
    }
    return u;
  }
};

// Adds the cells of a walk to the sums of a tile; u are the values of its nodes. Of several warps that share the item,
// each has sums of its own. Returns what the particles of this lane add to Σ κ V |∇u|².
template <HeatSum Sum, class S, int Warps, class T, int D>
__device__ T sum_cells(CellWalk<S, Warps, T, D> walk, const T* u, T* sum) {
  T from[S::nodes], to[S::nodes], power = T(0);
  walk.run(
      [&](int cell, bool some) {
        for_support<S>(cell, [&](int k, int i) {
          if (Sum == HeatSum::product) from[k] = some ? u[i] : T(0);  // u may be NaN away from the particles
          to[k] = T(0);
        });
        if (Sum == HeatSum::product) to_differences<S::Order, D>(from);
      },
      [&](const PackedParticle<T, D>& q) { power += add_particle<Sum, S::Order, T, D>(q.f, q.conductance, from, to); },
      [&](int cell) {
        if (Sum == HeatSum::product) to_nodes<S::Order, D>(to);
        // One node of every cell at a time: they differ, so no node is added to concurrently.
        for_support<S>(cell, [&](int k, int i) {
          T value = to[k];
#pragma unroll
          for (int o = S::slices / 2; o > 0; o /= 2) value += __shfl_xor_sync(~0u, value, o * 32 / S::slices);
          if (S::slices == 1 || lane_index() < 32 / S::slices) sum[i] += value;
          __syncwarp();
        });
      });
  return power;
}

// Adds a sum over the packed particles of the items [number, end), which are of one base block, to the nodes; returns
// Σ κ V |∇u|², the same in all lanes.
template <HeatSum Sum, class S, class Values, class T, int D>
__device__ T sum_items(const Topology<T, D>& t, const PackedItems<T, D>& packed, int number, int end, const Values& u,
                       T* out, bool in_order, WarpMemory<S>& memory) {
  auto& m = memory.tile;
  const Item* const items = reinterpret_cast<const Item*>(schedule_of(t).items);
  LaneCounts<S> counts(packed.counts + int64_t(number) * S::cells);
  const TileQuads<S> quads(t, items[number].slot);
  Vec4<T> loaded[TileQuads<S>::rounds];
#pragma unroll
  for (int r = 0; r < quads.rounds; r++)
    loaded[r] = Sum == HeatSum::product && quads.node[r] >= 0 ? u.at(quads.node[r]) : Vec4<T>{};
  __syncwarp();
#pragma unroll
  for (int r = 0; r < quads.rounds; r++) {
    if (!quads.in_tile(r)) continue;
    if (Sum == HeatSum::product) store_vec4(m.u + quads.at[r], loaded[r]);
    store_vec4(m.sum + quads.at[r], Vec4<T>{});
  }
  __syncwarp();
  T power = T(0);
#pragma unroll 1
  while (true) {
    power += sum_cells<Sum>(CellWalk<S, 1, T, D>(counts, packed.particles + items[number].begin, 0), m.u, m.sum);
    if (++number >= end) break;
    counts = LaneCounts<S>(packed.counts + int64_t(number) * S::cells);
  }
#pragma unroll
  for (int r = 0; r < quads.rounds; r++) {
    if (quads.node[r] < 0) continue;
    const Vec4<T> sum = load_vec4(m.sum + quads.at[r]);
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

// f(first item, end) for the items of this warp from `first` on, every `stride`-th; for a colour >= 0, the complete
// base blocks of that colour.
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
// Over all items, by the warps of all thread blocks.
template <class T, int D, class F>
__device__ void for_items(const Topology<T, D>& t, int colour, const F& f) {
  for_items(t, blockIdx.x + threadIdx.x / 32 * gridDim.x, *schedule_of(t).item_count, gridDim.x * (blockDim.x / 32),
            colour, f);
}

}  // namespace mpm::cuda
