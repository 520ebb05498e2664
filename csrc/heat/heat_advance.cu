#include "heat/kernels.h"
#include "heat/operator.cuh"
#include "heat/source.cuh"
#include "transfer/advance_gather.cuh"

// G2P of the motion and P2G of heat, which reads the rate of strain that G2P computes: a thread block processes the
// particles of an item as P2G does (csrc/transfer/scatter.cuh), and sums the velocities of their nodes as it loads
// them.
namespace mpm::cuda {
namespace {

// Without Moves, P2G or the laws update F, J and the volumes.
template <int Order_, class T_, int D_, bool Moves>
struct HeatAdvance {
  using T = T_;
  static constexpr int Order = Order_, D = D_;
  using Source = HeatSource<Order, T, D>;
  using Shape = typename Source::Shape;
  using Motion = AdvanceGather<Order, T, D, false, true, Moves>;
  static constexpr int threads = Shape::threads, most = kSmallItemParticles<D>;  // of an item
  // Thread blocks of a multiprocessor at once, which limits registers.
  static constexpr int resident = Order != 2 || sizeof(T) != 4 ? 1 : D == 2 ? 9 : Moves ? 3 : 4;
  static constexpr bool quads = D == 3;  // the rows of the grid of a rollout are whole vectors then
  struct Loaded {
    typename Motion::Loaded motion;
    typename Source::Particle heat;
    T rest;
  };
  struct Written {
    Vector<T, D> x;
    HeatWeights<T> weights;
    typename Source::OfNodes of_nodes;
  };
  Motion motion;
  Source heat;
  Columns<const T, 1> rest;
  Columns<T, 1> volume_next;
  PackedItems<T, D> packed{};
  bool packs;

  explicit HeatAdvance(const HeatAdvanceArguments<T, D>& a)
      : motion(a.advance), heat(a.to_nodes), rest(a.rest), volume_next(a.volume_next), packs(a.workspace != nullptr) {
    if (packs) packed = packed_in(a.workspace, a.to_nodes.topology, false);
  }

  __device__ Loaded load(int p, int scene) const {
    return {motion.load(p, scene), heat.read(p, scene), Moves ? rest.at(p) : T(0)};
  }
  __device__ Written write(int p, const Loaded& l, const typename Motion::Result& sums) const {
    Written w;
    const T rate = strain_rate_of(motion.motion(sums).affine);  // of the form MLS
    w.x = motion.write(p, p, p, l.motion, sums, [&](const Matrix<T, D>& F, const T& J) {
      volume_next.at(p) = l.rest * (motion.J_next.present() ? J : motion.F_next.present() ? determinant(F) : T(1));
    });
    w.of_nodes = heat.contribution(p, l.heat, rate, w.weights);
    return w;
  }
  __device__ void skip(int p) const {
    motion.skip(p);
    heat.skip(p, p);
    if (Moves) volume_next.at(p) = heat.volume.at(p);
  }
};

// Shared memory of a thread block beside the particles and the sums.
template <class K>
struct AdvanceMemory {
  using T = typename K::T;
  static constexpr int D = K::D, width = K::Shape::width, nodes = D == 2 ? width * width : width * width * width;
  ScatterMemory<typename K::Shape, true> scatter;
  NodeValue<T, D> velocities[nodes];
  PackedOrder<HeatShape<K::Order, T, D>, K::most> order;
  PackedParticle<T, D> packed[K::most];  // in the order of the item
};

// The passes over the particles of an item.
template <class K>
struct AdvanceItem {
  using T = typename K::T;
  using S = typename K::Shape;
  static constexpr int Order = K::Order, D = K::D, threads = K::threads;
  static_assert(S::batch == K::most);
  const K& k;
  AdvanceMemory<K>& m;
  const SharedParticles<S> shared;
  const int begin, count, slot, block;
  unsigned active;
  Follower<Order, T, D>& follower;
  T largest = T(0);  // diffusion number

  __device__ const Topology<T, D>& topology() const { return k.heat.topology; }
  __device__ int scene() const { return m.scatter.base_block.scene; }
  __device__ int particle(int i) const { return topology().index[begin + i]; }

  __device__ void prepare() {
    if (threadIdx.x == 32) m.scatter.base_block.template set<Order>(topology(), block);
    if (threadIdx.x == 0) m.scatter.out_of_block.count = 0;
    if (threadIdx.x < 1 << D)
      m.scatter.slots[threadIdx.x] = schedule_of(topology()).neighbours[(slot << D) + threadIdx.x];
    empty_lists<S>(m.scatter.head);
    for (int c = threadIdx.x; c <= kBlockNodes<D>; c += threads) m.order.count[c] = 0;
    __syncthreads();
    load_tile<K::quads, Order, T, D, D, threads>(k.motion.nodes, m.scatter.slots, m.velocities);
    __syncthreads();
  }

  // Moves particle i, p of all, and stores its contribution to the nodes.
  __device__ void finish(int i, int p, const T* f, const typename K::Loaded& loaded,
                         const typename K::Motion::Result& sums) {
    const typename K::Written w = k.write(p, loaded, sums);
    follower.follow(topology(), m.scatter.base_block, active, w.x);
    largest = larger_or_nan(largest, w.weights.number);
    store_particle<S, T, D>(shared, shared.row(i), f, w.of_nodes);
    PackedParticle<T, D>& q = m.packed[i];
#pragma unroll
    for (int d = 0; d < D; d++) q.f[d] = f[d];
    q.conductance = scaled_conductance<Order>(w.weights.conductance, topology().geometry.inverse_dx);
  }

  __device__ void process_in_block() {
    int following = int(threadIdx.x) < count ? particle(threadIdx.x) : 0;
#pragma unroll 1
    for (int i = threadIdx.x; i < count; i += threads) {
      const int p = following;
      if (i + threads < count) following = particle(i + threads);
      const typename K::Loaded loaded = k.load(p, scene());
      int cell;
      T f[D];
      const bool in_block = m.scatter.base_block.template locate<Order>(topology().geometry, loaded.motion.x, cell, f);
      const int row = shared.row(i), list = list_of<S>(i, in_block, cell);
      m.order.rank[i] = uint16_t(cell * K::most + atomicAdd(&m.order.count[cell], 1));
      shared.next[row] = uint16_t(atomicExch(&m.scatter.head[list], row));
      if (!in_block) {
        m.scatter.out_of_block.particle[atomicAdd(&m.scatter.out_of_block.count, 1)] = uint16_t(i);
        continue;
      }
      int corner = 0;
#pragma unroll
      for (int d = D - 1, rest = cell, step = 1; d >= 0; d--, rest /= kBlockWidth, step *= S::width)
        corner += rest % kBlockWidth * step;
      const TileSupport<Order, T, D> support{m.velocities + corner};
      finish(i, p, f, loaded, k.motion.compute(Weights<Order, T, D>(f), support));
    }
    __syncthreads();
  }

  // Some particles at a time, whose nodes are in shared memory then: a thread would wait for one node after another.
  __device__ void process_out_of_block() {
    constexpr int together = AdvanceMemory<K>::nodes / kSupportNodes<Order, D>;
    const OutOfBlockList<S::batch>& list = m.scatter.out_of_block;
#pragma unroll 1
    for (int first = 0; first < list.count; first += together) {
      const int number = ::min(together, list.count - first);
      for (int s = threadIdx.x / 32; s < number; s += threads / 32)
        copy_support(particle(list.particle[first + s]), m.velocities + s * kSupportNodes<Order, D>);
      __syncthreads();
      if (threadIdx.x < number)
        process_out_of_block(list.particle[first + threadIdx.x], m.velocities + threadIdx.x * kSupportNodes<Order, D>);
      __syncthreads();
    }
  }

  // Copies the nodes of a particle's support, by a warp.
  __device__ void copy_support(int p, NodeValue<T, D>* to) const {
    int base[D];
    T f[D];
    const int slot = locate_slot<Order>(topology(), scene(), read_vector(k.heat.position, p), base, f);
    if (slot < 0) return;
    for (int n = lane_index(); n < kSupportNodes<Order, D>; n += 32) {
      int node[D];
      split<Order + 1>(n, node);
#pragma unroll
      for (int i = D - 1; i >= 0; i--) node[i] += base[i];
      to[n] = load_near<K::quads, D>(k.motion.nodes, schedule_of(topology()).neighbours + (int64_t(slot) << D), node);
    }
  }

  __device__ void process_out_of_block(int i, const NodeValue<T, D>* nodes) {
    const int p = particle(i);
    int base[D];
    T f[D];
    if (locate_slot<Order>(topology(), scene(), read_vector(k.heat.position, p), base, f) < 0) {
      k.skip(p);
      m.packed[i] = {};
      return;
    }
    const TileSupport<Order, T, D, Order + 1> support{nodes};
    finish(i, p, f, k.load(p, scene()), k.motion.compute(Weights<Order, T, D>(f), support));
  }

  // Copies the packed particles into the order of the products.
  __device__ void pack(int number) const {
    using Cells = HeatShape<Order, T, D>;
    for (int c = threadIdx.x; c < Cells::cells; c += threads)
      k.packed.counts[int64_t(number) * Cells::cells + c] = uint16_t(m.order.count[c]);
    for (int i = threadIdx.x; i < count; i += threads) {
      const int cell = m.order.rank[i] / K::most, rank = m.order.rank[i] % K::most;
      store_packed(k.packed, m.order, begin, begin + count, cell, rank, m.packed[i], [&] { return particle(i); });
    }
  }

  __device__ void add_to_nodes(int number) {
    if (k.packs && threadIdx.x < 32) set_rows(m.order);
    add_particles(
        k.heat.nodes, shared, m.scatter.slots, false,
        [&] {
          add_out_of_block<S>(k.heat, k.heat.nodes, topology(), schedule_of(topology()), scene(), shared,
                              m.scatter.out_of_block, begin);
        },
        [&] {
          if (k.packs) pack(number);
        });
    raise_by_warp(k.heat.largest + scene(), largest);
    __syncthreads();
  }
};

template <class K>
__global__ void __launch_bounds__(K::threads, K::resident) advance_kernel(const __grid_constant__ K k) {
  using S = typename K::Shape;
  constexpr int D = K::D;
  grid_dependency_sync();
  extern __shared__ __align__(16) char memory[];
  __shared__ AdvanceMemory<K> m;
  const auto& t = k.heat.topology;
  const Schedule<const int> schedule = schedule_of(t);
  Follower<K::Order, typename K::T, D> follower;
  const int items = *schedule.item_count;
  for (int i = blockIdx.x; i < items; i += gridDim.x) {
    const Item item = reinterpret_cast<const Item*>(schedule.items)[i];
    AdvanceItem<K> work{k,
                        m,
                        SharedParticles<S>(memory, m.scatter.head),
                        item.begin,
                        item.end - item.begin,
                        item.slot,
                        item.block,
                        Follower<K::Order, typename K::T, D>::active_blocks(t, item.slot),
                        follower};
    work.prepare();
    work.process_in_block();
    work.process_out_of_block();
    work.add_to_nodes(i);
  }
  const int64_t stride = int64_t(gridDim.x) * K::threads;
  for (int64_t i = t.offsets[t.max_blocks] + int64_t(blockIdx.x) * K::threads + threadIdx.x; i < t.particles;
       i += stride)
    k.skip(t.index[i]);
  if (k.motion.displacement) follower.flush_counters(k.motion.displacement);
}

template <class K, class T, int D>
void launch_advance(const HeatAdvanceArguments<T, D>& a, int64_t items, Stream stream) {
  constexpr size_t dynamic = K::Shape::shared_bytes;
  static_assert(dynamic + sizeof(AdvanceMemory<K>) <= 99 * 1024);
  launch_in_chain(advance_kernel<K>, grid_size(items), K::threads, dynamic, stream, K(a));
}

}  // namespace

template <int Order, class T, int D>
void heat_advance(const HeatAdvanceArguments<T, D>& a, Stream stream) {
  const Topology<T, D>& t = a.to_nodes.topology;
  const int64_t items = most_items(t.max_blocks, t.particles);
  if (items == 0) return;
  if constexpr (kAdvancesHeat<T, D>) {
    constexpr bool has_fused_laws = Order == 2 && sizeof(T) == sizeof(float);
    if constexpr (has_fused_laws)
      if (a.advance.late) return launch_advance<HeatAdvance<Order, T, D, false>>(a, items, stream);
    launch_advance<HeatAdvance<Order, T, D, true>>(a, items, stream);
  } else {
    throw std::logic_error("G2P of the motion and P2G of heat have no kernel in float64 in 3-D");
  }
}

MPM_INSTANTIATE_ORDERS(heat_advance, HeatAdvanceArguments)

}  // namespace mpm::cuda
