#pragma once

#include "rollout/g2p2g.h"
#include "transfer/advance_gather.cuh"
#include "transfer/scatter.cuh"

// The kernel of G2P2G: a thread block takes the particles of an item, as P2G does. Their velocities come from a tile
// that goes a node further than they could when they were activated, so that those that have left their block since are
// mostly still in it.
namespace mpm::cuda {

constexpr int kHalo = 1;

// The nodes around a base block, and where the particles of an item are.
template <class S>
struct G2P2GMemory {
  static constexpr int D = S::D, width = S::width + 2 * kHalo, nodes = D == 2 ? width * width : width * width * width;
  static constexpr int around = D == 2 ? 9 : 27;
  using T = typename S::T;
  int slots[around];      // of the blocks around, -1 where they are not active
  int following[1 << D];  // of those that P2G reaches
  int head[S::lists + 1];
  BaseBlock<T, D> home;
  Strays<S::batch> strays;  // after G2P
  NodeValue<T, D> tile[nodes];
};

template <class Source, class Task>
class G2P2G {
 public:
  using S = typename Source::Shape;
  using T = typename S::T;
  using Memory = G2P2GMemory<S>;
  static constexpr int D = S::D, Order = S::Order, threads = S::threads;
  static_assert(S::batch >= kItemParticles);

  __device__ G2P2G(const Source& source, const Task& task, Memory& m, char* memory, int first_row)
      : source(source), task(task), m(m), shared(memory, m.head), first_row_(first_row) {}

  // By all threads.
  __device__ void take(const Item& item) {
    const int n = item.end - item.begin, first = first_row_ + item.begin;
    Vector<T, D> following;
    if (int(threadIdx.x) < n) following = read_vector(source.position, first + int(threadIdx.x));
    const bool complete = begin(item);
    load_tile();
    __syncthreads();
#pragma unroll 1
    for (int k = threadIdx.x; k < n; k += threads) {
      const Vector<T, D> x = following;
      if (k + threads < n) following = read_vector(source.position, first + k + threads);
      move(k, first + k, x, complete);
    }
    __syncthreads();
    add_particles(source.nodes, shared, m.following, false, [&] {
      add_strays<S>(source, topology(), schedule_of(topology()), m.home.scene, shared, m.strays, item.begin);
    });
    __syncthreads();
  }

  // Particles that are left out are at rest.
  __device__ void leave_out(int p) const { source.leave_out_at_rest(p); }

  // By whole warps.
  __device__ void tell(Drift* drift) const {
    const int strays = __reduce_add_sync(~0u, strays_);
    if (strays > 0 && threadIdx.x % 32 == 0) atomicAdd(&drift->strays, strays);
    if (lost_) atomicOr(&drift->lost, lost_);
  }

 private:
  const Source& source;
  const Task& task;
  Memory& m;
  const SharedParticles<S> shared;
  const int first_row_;
  int strays_ = 0, lost_ = 0;

  __device__ const Topology<T, D>& topology() const { return source.topology; }

  // Whether all blocks around that the domain has are active.
  __device__ bool begin(const Item& item) {
    bool active = true;
    if (threadIdx.x < Memory::around) {
      int block[D], way = 0;
      const Geometry<T, D>& g = topology().geometry;
      block_coordinates(g, item.block, block);
      bool inside = true;
#pragma unroll
      for (int i = D - 1, rest = threadIdx.x, step = 1; i >= 0; i--, rest /= 3) {
        const int side = rest % 3 - 1;
        inside = inside && unsigned(block[i] + side) < unsigned(g.blocks[i]);
        way += side * step;
        step *= g.blocks[i];
      }
      const int slot = inside ? topology().table[item.block + way] : -1;
      m.slots[threadIdx.x] = slot;
      active = !inside || slot >= 0;
    }
    if (threadIdx.x >= 32 && threadIdx.x < 32 + (1 << D))
      m.following[threadIdx.x - 32] = schedule_of(topology()).neighbours[(item.slot << D) + threadIdx.x - 32];
    if (threadIdx.x == 64) m.home.template set<Order>(topology(), item.block);
    if (threadIdx.x == 96) m.strays.count = 0;
    empty_lists<S>(m.head);
    return __syncthreads_and(active);
  }

  __device__ void load_tile() {
#pragma unroll
    for (int first = 0; first < Memory::nodes; first += threads) {
      const int i = first + threadIdx.x;
      if (i >= Memory::nodes) break;
      int node[D], neighbour = 0;
#pragma unroll
      for (int axis = D - 1, rest = i, step = 1; axis >= 0; axis--, rest /= Memory::width, step *= 3) {
        const int at = rest % Memory::width + kBlockWidth - kHalo;  // from the first node of the block before
        neighbour += at / kBlockWidth * step;
        node[axis] = at % kBlockWidth;
      }
      const int slot = m.slots[neighbour];
      T value[D] = {};
      if (slot >= 0) load_node<D == 3>(task.nodes, slot * kBlockNodes<D> + node_in_block<D>(node), 0, value);
      NodeValue<T, D> v{};
#pragma unroll
      for (int c = 0; c < D; c++) v.e[c] = value[c];
      m.tile[i] = v;
    }
  }

  // What a particle at x gets from the nodes.
  __device__ typename Task::Result gather(const Vector<T, D>& x, const typename Task::Loaded& loaded) const {
    const Geometry<T, D>& g = topology().geometry;
    bool in_tile = true;
    int corner = 0;
    T f[D];
#pragma unroll
    for (int i = 0; i < D; i++) {
      const T node = base_node<Order>(g, i, x[i]), from = node - m.home.first[i];
      in_tile = in_tile && from >= T(-kHalo) && from < T(kBlockWidth + kHalo);  // false for NaN
      corner = corner * Memory::width + int(from) + kHalo;
      f[i] = distance_in_cells(g, i, x[i], node);
    }
    const Weights<Order, T, D> weights(f);
    if (in_tile) return task.compute(loaded, weights, TileSupport<Order, T, D, kHalo>{m.tile + corner});
    GridSupport<T, D, D, D == 3> support{task.nodes};
    const int slot = locate_slot<Order>(topology(), m.home.scene, x, support.base, f);
    if (slot < 0) return {};
    const int* const neighbours = schedule_of(topology()).neighbours + (slot << D);
#pragma unroll
    for (int o = 0; o < 1 << D; o++) support.set_slot(o, neighbours[o]);
    return task.compute(loaded, weights, support);
  }

  // Particle k of the item, in row p, where it was.
  __device__ void move(int k, int p, const Vector<T, D>& x, bool complete) {
    typename Source::Changes changes;
    source.fetch(p, changes);
    auto particle = source.fields.read_at_rest(p, m.home.scene);
    const auto loaded = task.at(x, m.home.scene);
    const Motion<T, D> motion = task.motion(gather(x, loaded));
    const Vector<T, D> to = advance_position(x, motion.velocity, loaded.dt);
#pragma unroll
    for (int i = 0; i < D; i++) task.x_next.at(p, i) = to[i];
    particle.velocity = motion.velocity;
    particle.affine = is_finite<D>(to.e) ? motion.affine : zero_matrix<T, D>();
    particle.stress = source.stress(p, particle.affine, particle.dt, changes);
    source.keep(p, changes);
    int cell;
    T f[D];
    const bool at_home = m.home.template locate<Order>(topology().geometry, to, cell, f);
    const int row = SharedParticles<S>::row(k);
    store_particle<S, T, D>(shared, row, f, source.contribution(particle));
    shared.next[row] = uint16_t(atomicExch(&shared.head[list_of<S>(k, at_home, cell)], row));
    if (!complete) lost_ |= Drift::kLost;
    if (!at_home) stray(k, to);
  }

  // A particle that is not in its block any more. It may go less than a cell before it is looked at again.
  __device__ void stray(int k, const Vector<T, D>& x) {
    m.strays.particle[atomicAdd(&m.strays.count, 1)] = uint16_t(k);
    strays_++;
    const Geometry<T, D>& g = topology().geometry;
    bool near = true, inside = true;
#pragma unroll
    for (int i = 0; i < D; i++) {
      const T node = base_node<Order>(g, i, x[i]), from = node - m.home.first[i];
      near = near && from > T(-kBlockWidth) && from + T(Order + 1) < T(2 * kBlockWidth);
      inside = inside && on_lattice<Order>(g, i, node);
    }
    if (!near) lost_ |= Drift::kLost;
    if (!inside) lost_ |= Drift::kLost | Drift::kMissed;
  }
};

// Thread blocks per multiprocessor: a fourth one leaves too few registers, and gains nothing.
constexpr int kG2P2GBlocks = 3;

template <class Source, class Task, class T, int D>
__global__ void __launch_bounds__(Source::Shape::threads, kG2P2GBlocks)
    g2p2g_kernel(const __grid_constant__ Source source, const __grid_constant__ Task task, const OwnRows own,
                 const int* copy) {
  wait_for_kernel_before();
  const Topology<T, D>& t = source.topology;
  if (own.is_due(t.particles)) return;  // and there is a new activation between G2P and P2G
  extern __shared__ __align__(16) char memory[];
  __shared__ G2P2GMemory<typename Source::Shape> shared;
  G2P2G<Source, Task> g2p2g(source, task, shared, memory, *copy ? own.rows : 0);
  const Schedule<const int> schedule = schedule_of(t);
  const int count = *schedule.item_count;
  for (int i = blockIdx.x; i < count; i += gridDim.x) {
    const int4 e = reinterpret_cast<const int4*>(schedule.items)[i];
    g2p2g.take({e.x, e.y, e.z, e.w});
  }
  const int64_t stride = int64_t(gridDim.x) * blockDim.x;
  for (int64_t i = t.offsets[t.max_blocks] + int64_t(blockIdx.x) * blockDim.x + threadIdx.x; i < t.particles;
       i += stride)
    g2p2g.leave_out(t.index[i]);
  g2p2g.tell(task.drift);
}

template <class Source, class Task, class T, int D>
void launch_g2p2g(const Source& source, const Task& task, const G2P2GArguments<T, D>& a, Stream stream) {
  using S = typename Source::Shape;
  const int64_t items = most_items(source.topology.max_blocks, source.topology.particles);
  launch_in_chain(g2p2g_kernel<Source, Task, T, D>, grid_size(items), S::threads, S::shared_bytes, stream, source, task,
                  a.own, a.copy);
}

}  // namespace mpm::cuda
