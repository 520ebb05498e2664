#pragma once

#include <cuda_pipeline.h>

#include "rollout/schedules/fused_g2p2g.h"
#include "transfer/advance_gather.cuh"
#include "transfer/scatter.cuh"

// The kernel of G2P2G: a thread block processes the particles of an item, as in P2G. Their velocities come from a tile
// that reaches one node further than the nodes of the block, so it still serves most particles that have left the block
// since the activation.
namespace mpm::cuda {

constexpr int kHalo = 1;

// The nodes of a tile: those of the base block, the next Order along each axis, and kHalo more on either side. Rows are
// padded so that neighbours along any axis, and most nodes of a cube of 4, lie in different banks.
template <int Order, class T, int D>
struct WideTile {
  static constexpr int width = kBlockWidth + Order + 2 * kHalo, row = width + 2, plane = width * row + 4;
  static constexpr int nodes = D == 2 ? width * width : width * width * width, room = D == 2 ? plane : width * plane;
  static constexpr int blocks = 1;
  using Node = Vec4<T>;  // mass and velocity, as in the grid in 3-D
  const Node* corner;    // the base node
  BlockRows<1> rows;

  static constexpr int step(int axes_after) { return axes_after == 0 ? 1 : axes_after == 1 ? row : plane; }
  __device__ bool is_far(int, int) const { return false; }
  __device__ void load(int, int offset, T (&node)[D]) const {
    const Node v = corner[offset];
#pragma unroll
    for (int c = 0; c < D; c++) node[c] = v.e[1 + c];
  }
};

// An item with its block and the blocks around it.
template <class T, int D>
struct ItemPlace {
  static constexpr int around = D == 2 ? 9 : 27;
  int begin, end;         // its particles
  int slots[around];      // of the blocks around, -1 where they are not active
  int following[1 << D];  // slots of the blocks that P2G reaches
  BaseBlock<T, D> home;
};

// Data of the current and the next item. After the particles have moved, the tile is that of the next item.
template <class S>
struct G2P2GMemory {
  static constexpr int D = S::D;
  using T = typename S::T;
  using Tile = WideTile<S::Order, T, D>;
  alignas(16) Item next;
  int number;  // of the item after the next
  ItemPlace<T, D> places[2];
  int head[S::lists + 1];
  OutOfBlockList<S::batch> far;            // particles beyond the blocks around, after G2P
  int out_of_block;                        // number of particles in the blocks around:
  uint16_t row[S::batch], base[S::batch];  // their contributions; their base nodes, from the first block around
  T x[D][S::batch];
  alignas(16) typename Tile::Node tile[Tile::room];
};

// Node sums in fixed point have separate kernels, since their work per node would cost the others 7%.
template <bool Fixed, class Source, class Task>
class G2P2G {
 public:
  using S = typename Source::Shape;
  using T = typename S::T;
  using Memory = G2P2GMemory<S>;
  using Tile = typename Memory::Tile;
  using Nodes = std::conditional_t<Fixed, NodeSums<T>, NodeField<T>>;
  static constexpr int D = S::D, Order = S::Order, threads = S::threads;
  static_assert(S::batch >= kItemParticles);

  __device__ G2P2G(const Source& source, const Task& task, Memory& m, char* memory, int first_row, int* taken)
      : source(source),
        task(task),
        m(m),
        shared(memory, m.head),
        first_row_(first_row),
        taken_(taken),
        dt_(source.fields.time_step(0)),
        parameters_(source.parameters(0)) {}

  // Processes items until there are none left, by all threads. The blocks around the next item are looked up while the
  // particles of the current one move, and its tile is loaded while they are added to the nodes.
  __device__ void take_items(const Schedule<const int>& schedule) {
    const int count = *schedule.item_count;
    if (int(blockIdx.x) >= count) return;
    int now = blockIdx.x;
    load_item(schedule, now);
    empty();
    __pipeline_wait_prior(0);
    __syncthreads();
    find(here());
    __syncthreads();
    load(here());
    int next = m.number;
    if (next < count) load_item(schedule, next);
#pragma unroll 1
    while (now < count) {
      __pipeline_wait_prior(0);
      __syncthreads();
      move_all();
      if (next < count) find(m.places[1 - turn_]);
      __syncthreads();
      if (Fixed && threadIdx.x < 32) link_in_order(shared, here().end - here().begin);
      if (next < count) load(m.places[1 - turn_]);
      now = next;
      next = m.number;
      if (next < count) load_item(schedule, next);
      if (Fixed) __syncthreads();
      add_particles(nodes(), shared, here().following, false, [&] { add_all_out_of_block(); }, [&] { empty(); });
      turn_ = 1 - turn_;
    }
  }

  // Skipped particles are at rest.
  __device__ void skip(int p) const { source.skip_at_rest(p); }

  __device__ void flush_counters(Displacement* displacement) const {
    add_to_displacement(displacement, out_of_block_, lost_);
  }

 private:
  const Source& source;
  const Task& task;
  Memory& m;
  const SharedParticles<S> shared;
  const int first_row_;
  int* const taken_;
  const T dt_;
  const typename Source::Parameters parameters_;  // of all particles
  int out_of_block_ = 0, lost_ = 0, turn_ = 0;

  __device__ const Topology<T, D>& topology() const { return source.topology; }

  __device__ const Nodes& nodes() const { return source.nodes; }

  __device__ ItemPlace<T, D>& here() const { return m.places[turn_]; }

  __device__ void empty() {
    empty_lists<S>(m.head);
    if (threadIdx.x == 0) m.far.count = m.out_of_block = 0;
  }

  __device__ void load_item(const Schedule<const int>& schedule, int i) {
    if (threadIdx.x == 0) __pipeline_memcpy_async(&m.next, schedule.items + 4 * i, sizeof(Item));
    __pipeline_commit();
  }

  // Finds the place of the next item. All blocks around it within the domain should be active. By the last threads,
  // which mostly have fewer particles to move.
  __device__ void find(ItemPlace<T, D>& place) {
    const int thread = int(threadIdx.x) - (threads - 64);
    const Item item = m.next;
    if (unsigned(thread) < unsigned(ItemPlace<T, D>::around)) {
      int block[D], way = 0;
      const Geometry<T, D>& g = topology().geometry;
      block_coordinates(g, item.block, block);
      bool inside = true;
#pragma unroll
      for (int i = D - 1, rest = thread, step = 1; i >= 0; i--, rest /= 3) {
        const int side = rest % 3 - 1;
        inside = inside && unsigned(block[i] + side) < unsigned(g.blocks[i]);
        way += side * step;
        step *= g.blocks[i];
      }
      const int slot = inside ? topology().table[item.block + way] : -1;
      place.slots[thread] = slot;
      if (inside && slot < 0) lost_ |= Displacement::kLost;
    } else if (thread >= 32 && thread < 32 + (1 << D)) {
      place.following[thread - 32] = schedule_of(topology()).neighbours[(item.slot << D) + thread - 32];
    } else if (thread == 62) {
      m.number = int(gridDim.x) + atomicAdd(taken_, 1);
    } else if (thread == 63) {
      place.begin = item.begin;
      place.end = item.end;
      place.home.template set<Order>(topology(), item.block);
    }
  }

  // Begins to load the positions and the tile; __pipeline_wait_prior() waits for them.
  __device__ void load(const ItemPlace<T, D>& place) {
    int thread = threadIdx.x;
    asm volatile("" : "+r"(thread));  // otherwise all addresses would be kept in local memory between items
    const int n = place.end - place.begin, first = first_row_ + place.begin;
#pragma unroll 1
    for (int k = thread; k < n; k += threads)
#pragma unroll
      for (int i = 0; i < D; i++) __pipeline_memcpy_async(&m.x[i][k], &source.position.at(first + k, i), sizeof(T));
#pragma unroll 1
    for (int i = thread; i < Tile::nodes; i += threads) {
      int node[D], neighbour = 0, to = 0;
#pragma unroll
      for (int axis = D - 1, rest = i, step = 1; axis >= 0; axis--, rest /= Tile::width, step *= 3) {
        const int in_tile = rest % Tile::width;
        to += in_tile * Tile::step(D - 1 - axis);
        const int at = in_tile + kBlockWidth - kHalo;  // from the first node of the block before
        neighbour += at / kBlockWidth * step;
        node[axis] = at % kBlockWidth;
      }
      const int slot = place.slots[neighbour];
      const int64_t row = int64_t(slot < 0 ? 0 : slot) * kBlockNodes<D> + node_in_block<D>(node);
      const T* const velocity = task.nodes.pointer + row * (1 + D);
      if constexpr (D == 3) {
        __pipeline_memcpy_async(m.tile + to, velocity - 1, sizeof(Vec4<T>), slot < 0 ? sizeof(Vec4<T>) : 0);
      } else {
#pragma unroll
        for (int c = 0; c < D; c++)
          __pipeline_memcpy_async(&m.tile[to].e[1 + c], velocity + c, sizeof(T), slot < 0 ? sizeof(T) : 0);
      }
    }
    __pipeline_commit();
  }

  // Sums of G2P for a particle at x.
  __device__ typename Task::Result gather(const Vector<T, D>& x) const {
    const Geometry<T, D>& g = topology().geometry;
    bool in_tile = true;
    int corner = 0;
    T f[D];
#pragma unroll
    for (int i = 0; i < D; i++) {
      const T node = base_node<Order>(g, i, x[i]), from = node - here().home.first[i];
      in_tile = in_tile && from >= T(-kHalo) && from < T(kBlockWidth + kHalo);  // false for NaN
      corner += (int(from) + kHalo) * Tile::step(D - 1 - i);
      f[i] = distance_in_cells(g, i, x[i], node);
    }
    const Weights<Order, T, D> weights(f);
    if (in_tile) return task.compute(weights, Tile{m.tile + corner});
    GridSupport<T, D, D, D == 3> support{task.nodes};
    const int slot = locate_slot<Order>(topology(), here().home.scene, x, support.base, f);
    if (slot < 0) return {};
    const int* const neighbours = schedule_of(topology()).neighbours + (slot << D);
#pragma unroll
    for (int o = 0; o < 1 << D; o++) support.set_slot(o, neighbours[o]);
    return task.compute(weights, support);
  }

  __device__ void move_all() {
    const int n = here().end - here().begin, first = first_row_ + here().begin;
#pragma unroll 1
    for (int k = threadIdx.x; k < n; k += threads) move(k, first + k);
  }

  // Moves particle k of the item, in row p, in place.
  __device__ void move(int k, int p) {
    Vector<T, D> x;
#pragma unroll
    for (int i = 0; i < D; i++) x[i] = m.x[i][k];
    typename Source::Changes changes;
    source.fetch(p, changes);
    auto particle = source.fields.read_at_rest(p, dt_);
    const Motion<T, D> motion = task.motion(gather(x));
    const Vector<T, D> to = task.advanced(p, p, x, motion.velocity, dt_);
#pragma unroll
    for (int i = 0; i < D; i++) task.x_next.at(p, i) = to[i];
    particle.velocity = motion.velocity;
    particle.affine = is_finite<D>(to.e) ? motion.affine : zero_matrix<T, D>();
    particle.stress = source.stress(p, particle.affine, dt_, parameters_, changes);
    source.keep(p, changes);
    int cell;
    T f[D];
    const int row = SharedParticles<S>::row(k);
    const bool at_home = here().home.template locate<Order>(topology().geometry, to, cell, f);
    store_particle<S, T, D>(shared, row, f, source.contribution(particle));
    const int list = list_of<S>(k, at_home, cell);
    shared.next[row] = uint16_t(Fixed ? list : atomicExch(&shared.head[list], row));
    if (!at_home) put_out_of_block(k, row, to);
  }

  // A particle out of its block. It may move less than a cell before it is inspected again.
  __device__ void put_out_of_block(int k, int row, const Vector<T, D>& x) {
    out_of_block_++;
    const Geometry<T, D>& g = topology().geometry;
    bool near = true, around = true, inside = true;
    int base = 0;
#pragma unroll
    for (int i = 0; i < D; i++) {
      const T node = base_node<Order>(g, i, x[i]), from = node - here().home.first[i] + T(kBlockWidth);
      around = around && from >= T(0) && from + T(Order) < T(3 * kBlockWidth);  // false for NaN
      near = near && from > T(0) && from + T(Order + 1) < T(3 * kBlockWidth);
      inside = inside && on_lattice<Order>(g, i, node);
      base = base * 3 * kBlockWidth + int(from);
    }
    if (!near) lost_ |= Displacement::kLost;
    if (!inside) {
      lost_ |= Displacement::kLost | Displacement::kMissed;
    } else if (around) {
      const int s = atomicAdd(&m.out_of_block, 1);
      m.row[s] = uint16_t(row);
      m.base[s] = uint16_t(base);
    } else {
      m.far.particle[atomicAdd(&m.far.count, 1)] = uint16_t(k);
    }
  }

  // A warp adds one at a time.
  __device__ void add_all_out_of_block() const {
    for (int s = threadIdx.x / 32; s < m.out_of_block; s += threads / 32) {
      const int base = m.base[s];
      add_one_out_of_block<S>(nodes(), shared, m.row[s], [&](const int (&offset)[D]) -> int64_t {
        int node[D], block = 0;
#pragma unroll
        for (int i = D - 1, rest = base, step = 1; i >= 0; i--, rest /= 3 * kBlockWidth, step *= 3) {
          const int at = rest % (3 * kBlockWidth) + offset[i];
          block += at / kBlockWidth * step;
          node[i] = at % kBlockWidth;
        }
        const int slot = here().slots[block];
        return slot < 0 ? -1 : int64_t(slot) * kBlockNodes<D> + node_in_block<D>(node);
      });
    }
    add_out_of_block<S>(source, nodes(), topology(), schedule_of(topology()), here().home.scene, shared, m.far,
                        here().begin);
  }
};

// Thread blocks per multiprocessor: a fourth one leaves too few registers, and gains nothing.
constexpr int kG2P2GBlocks = 3;

template <bool Fixed, class Source, class Task, class T, int D>
__global__ void __launch_bounds__(Source::Shape::threads, kG2P2GBlocks)
    g2p2g_kernel(const __grid_constant__ Source source, const __grid_constant__ Task task, const OwnRows own,
                 const int* copy, int* taken) {
  grid_dependency_sync();
  const Topology<T, D>& t = source.topology;
  if (own.is_due(t.particles)) return;  // a new activation follows between G2P and P2G
  extern __shared__ __align__(16) char memory[];
  __shared__ G2P2GMemory<typename Source::Shape> shared;
  G2P2G<Fixed, Source, Task> g2p2g(source, task, shared, memory, *copy ? own.rows : 0, taken);
  const Schedule<const int> schedule = schedule_of(t);
  g2p2g.take_items(schedule);
  const int64_t stride = int64_t(gridDim.x) * blockDim.x;
  for (int64_t i = t.offsets[t.max_blocks] + int64_t(blockIdx.x) * blockDim.x + threadIdx.x; i < t.particles;
       i += stride)
    g2p2g.skip(t.index[i]);
  g2p2g.flush_counters(task.displacement);
}

template <class Source, class Task, class T, int D>
void launch_g2p2g(const Source& source, const Task& task, const G2P2GArguments<T, D>& a, Stream stream) {
  using S = typename Source::Shape;
  const int64_t items = most_items(source.topology.max_blocks, source.topology.particles);
  const auto resident = unsigned(kG2P2GBlocks * device_attribute(cudaDevAttrMultiProcessorCount));
  const auto kernel =
      a.p2g.fixed.largest_mass ? g2p2g_kernel<true, Source, Task, T, D> : g2p2g_kernel<false, Source, Task, T, D>;
  launch_in_chain(kernel, std::min(grid_size(items), resident), S::threads, S::shared_bytes, stream, source, task,
                  a.own, a.copy, a.items_taken);
}

}  // namespace mpm::cuda
