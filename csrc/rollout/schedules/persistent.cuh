#pragma once

#include "cuda/barrier.cuh"
#include "grid/contact.h"
#include "grid/status.h"
#include "rollout/plan.h"
#include "rollout/schedules/persistent.h"
#include "transfer/advance_gather.cuh"
#include "transfer/scatter.cuh"

// The kernel of substeps that last in their activation. A substep is
//   P2G     of each item by a thread block; then a barrier
//   G2P     of the same item, with the grid update and contact of each node of its tile.
// The barrier of the next P2G shows whether the activation still lasts. If not, that P2G is dropped; the changes by the
// law are stored only afterwards. Where thread blocks have several items, or scenes clocks of their own, there is
// a second barrier.
// A substep of few particles is one chain of loads and sums that wait for each other. So the grid data
// of an item are loaded once if a thread block has no other item, and cells have more threads in 3-D than in P2G alone.
#if CUDART_VERSION >= 13000
namespace mpm::cuda {

// The velocity of nodes after grid update and contact, computed where it is read.
template <class T, int D>
struct NodeVelocities {
  const GridUpdateArguments<T, D>& update;
  const ContactArguments<T, D>& contact;
  bool obstacles;
  NodeRows<T, D> nodes;

  // By all threads of a warp; zero where not wanted.
  __device__ Vector<T, D> at(bool wanted, const SlotUpdate<T, D>& there, int slot, int local) const {
    NodeRow<T, D> node{T(0), zero_vector<T, D>()};
    if (wanted) node = nodes.at(int64_t(slot) * kBlockNodes<D> + local);
    const bool has_mass = node.mass != T(0);
    Vector<T, D> v = zero_vector<T, D>();
    if (has_mass) v = update_node(update, there, local, node).value;
    if (obstacles) apply_contact(has_mass, contact, there.scene, there.corner, local, v);
    return v;
  }
};

// P2G with threads that share the particles of a cell and leading node.
template <class S>
using SharingShape = ScatterShape<S::Order, typename S::T, S::D, S::Plain, S::Linear, S::Gradient, S::D == 2 ? 4 : 2>;

// Values shared by the threads of an item, beside its particles, sums and nodes.
template <class S>
struct ItemMemory {
  static constexpr int D = S::D, most = S::threads;
  using T = typename S::T;
  int slots[1 << D];
  SlotUpdate<T, D> there[1 << D];
  BaseBlock<T, D> home;
  int head[S::lists + 1];
  int out_of_block;           // particles out of the block of the item:
  int row[most], base[most];  // rows of their contributions, and their base nodes, -1 without one
};

// The phases of a substep of one item, whose particles have a thread each.
template <class Source, class Task>
class ItemStep {
 public:
  using S = SharingShape<typename Source::Shape>;
  using T = typename S::T;
  static constexpr int D = S::D, Order = Task::Order, width = kBlockWidth + Order, threads = S::threads;
  static constexpr int tile_nodes = D == 2 ? width * width : width * width * width;
  // The support of a particle out of block has the row length of the tile, so that G2P treats both alike.
  static constexpr int support_nodes = S::support * S::slab,
                       span = (D == 2 ? 0 : Order * width * width) + Order * width + Order + 1;
  static constexpr int out_of_block_at_once = (int(S::shared_bytes / sizeof(NodeValue<T, D>)) - tile_nodes) / span;
  static_assert(threads >= persistent_item<D>(kMostPersistentParticles) && S::batch >= threads &&
                out_of_block_at_once > 0);

  const Source& source;
  const Task& task;
  const GridUpdateArguments<T, D>& update;
  ItemMemory<S>& m;
  char* const memory;

  __device__ ItemStep(const Source& source, const Task& task, const GridUpdateArguments<T, D>& update,
                      ItemMemory<S>& memory_of_item, char* memory)
      : source(source), task(task), update(update), m(memory_of_item), memory(memory) {}

  // By all threads, after they have finished the previous item.
  __device__ void begin(int number) {
    const Schedule<const int> schedule = schedule_of(topology());
    const int4 e = reinterpret_cast<const int4*>(schedule.items)[number];
    count_ = e.z - e.y;
    exists_ = int(threadIdx.x) < count_;
    particle_ = exists_ ? topology().index[e.y + threadIdx.x] : 0;
    if (threadIdx.x < 1 << D) {
      const int slot = schedule.neighbours[(e.x << D) + threadIdx.x];
      m.slots[threadIdx.x] = slot;
      if (slot >= 0) m.there[threadIdx.x] = slot_update(update, slot);
    }
    if (threadIdx.x == 32) m.home.template set<Order>(topology(), e.w);
    if (threadIdx.x == 64) m.out_of_block = 0;
    empty_lists<S>(m.head);
    if (exists_) x_ = read_vector(source.position, particle_);
    __syncthreads();
    active_ = 0;
#pragma unroll
    for (int o = 0; o < 1 << D; o++) active_ |= unsigned(m.slots[o] >= 0) << o;
  }

  // Loads the inputs of link(), which stay in registers if each particle has a thread.
  __device__ void load() {
    if (!exists_) return;
    state_ = source.read(particle_, m.home.scene, particle_);
    parameters_ = source.parameters(particle_);
    source.fetch(particle_, changes_);
  }

  // Stores the contributions of the particles in shared memory. The changes by the law are not stored yet, since the
  // P2G may be dropped.
  __device__ void link() {
    const SharedParticles<S> shared(memory, m.head);
    if (exists_) {
      auto loaded = state_;
      loaded.stress = source.stress(particle_, loaded.affine, loaded.dt, parameters_, changes_);
      find();
      const int row = SharedParticles<S>::row(threadIdx.x);
      store_particle<S, T, D>(shared, row, f_, source.contribution(loaded));
      const int list = list_of<S>(threadIdx.x, out_of_block_ < 0, cell_);
      shared.next[row] = uint16_t(in_order() ? list : atomicExch(&m.head[list], row));
    }
    __syncthreads();
    if (!in_order()) return;
    if (threadIdx.x < 32) link_in_order(shared, count_);
    __syncthreads();
  }

  __device__ void keep() const {
    if (exists_) source.keep(particle_, changes_);
  }

  // P2G of linked particles.
  __device__ void scatter(T* nodes) {
    const SharedParticles<S> shared(memory, m.head);
    const NodeSums<T> field{{nodes, 1 + D, 1 + D}, source.nodes.fixed};
    add_particles(field, shared, m.slots, false, [&] { add_out_of_block(field, shared); });
    empty_lists<S>(m.head);
  }

  // G2P of the particles; `found` if link() has located them.
  __device__ void gather(const NodeVelocities<T, D>& velocities, bool found, FollowerOf<Task>& follower) {
    NodeValue<T, D>* const tile = reinterpret_cast<NodeValue<T, D>*>(memory);
    if (!found) {
      if (exists_) find();
      __syncthreads();
    }
    const int out_of_block = m.out_of_block;
    int first = 0;
    do {
      const int count = ::min(out_of_block - first, out_of_block_at_once);
      load_velocities(velocities, tile, first, first == 0 ? tile_nodes : 0, count);
      __syncthreads();
      const bool mine = out_of_block_ < 0 ? first == 0 : out_of_block_ >= first && out_of_block_ < first + count;
      if (exists_ && mine)
        move(out_of_block_ < 0 ? tile + corner() : tile + tile_nodes + (out_of_block_ - first) * span, follower);
      first += out_of_block_at_once;
      __syncthreads();
    } while (first < out_of_block);
    if (threadIdx.x == 0) m.out_of_block = 0;
    __syncthreads();
  }

 private:
  __device__ const Topology<T, D>& topology() const { return source.topology; }

  __device__ bool in_order() const { return is_fixed(source.nodes); }

  // Locates the particle.
  __device__ void find() {
    out_of_block_ = -1;
    if (m.home.template locate<Order>(topology().geometry, x_, cell_, f_)) return;
    int base[D];
    const int slot = locate_slot<Order>(topology(), m.home.scene, x_, base, f_);
    out_of_block_ = atomicAdd(&m.out_of_block, 1);
    m.row[out_of_block_] = SharedParticles<S>::row(threadIdx.x);
    m.base[out_of_block_] = slot < 0 ? -1 : slot * kBlockNodes<D> + node_in_block<D>(base);
  }

  // A warp adds one at a time.
  __device__ void add_out_of_block(const NodeSums<T>& nodes, const SharedParticles<S>& shared) const {
    for (int s = threadIdx.x / 32; s < m.out_of_block; s += threads / 32)
      if (m.base[s] >= 0) add_one_out_of_block(nodes, schedule_of(topology()), shared, m.row[s], m.base[s]);
  }

  template <int Width>
  __device__ static void split(int i, int (&offset)[D]) {
#pragma unroll
    for (int axis = D - 1; axis >= 0; axis--, i /= Width) offset[axis] = i % Width;
  }

  __device__ static int in_tile(const int (&offset)[D]) {
    int place = 0;
#pragma unroll
    for (int axis = 0; axis < D; axis++) place = place * width + offset[axis];
    return place;
  }

  // Computes the velocities of the first nodes of the tile, and of the supports of `count` particles out of block.
  __device__ void load_velocities(const NodeVelocities<T, D>& velocities, NodeValue<T, D>* tile, int first_out_of_block,
                                  int of_tile, int count) const {
    const int nodes = of_tile + count * support_nodes, in_warps = (nodes + 31) / 32 * 32;
#pragma unroll 1
    for (int i = threadIdx.x; i < in_warps; i += threads) {
      const bool exists = i < nodes;
      int offset[D], base = 0, place = i;
      const int* slots = m.slots;
      const bool is_out_of_block = i >= of_tile;
      if (!exists) {
        base = -1;
      } else if (is_out_of_block) {
        const int s = (i - of_tile) / support_nodes;
        split<Order + 1>((i - of_tile) % support_nodes, offset);
        place = tile_nodes + s * span + in_tile(offset);
        base = m.base[first_out_of_block + s];
        slots = schedule_of(topology()).neighbours + (int64_t(base / kBlockNodes<D>) << D);
      } else {
        split<width>(i, offset);
      }
      const bool found = base >= 0;
      int node[D], neighbour = 0;
#pragma unroll
      for (int axis = D - 1, rest = base; axis >= 0; axis--, rest /= kBlockWidth) {
        node[axis] = (is_out_of_block ? rest % kBlockWidth : 0) + offset[axis];
        neighbour |= (node[axis] >= kBlockWidth) << (D - 1 - axis);
      }
      const int slot = found ? slots[neighbour] : -1;
      SlotUpdate<T, D> there;
      if (slot >= 0) there = is_out_of_block ? slot_update(update, slot) : m.there[neighbour];
      const Vector<T, D> v = velocities.at(slot >= 0, there, slot, node_in_block<D>(node));
      if (!found) continue;
      NodeValue<T, D> value{};
#pragma unroll
      for (int axis = 0; axis < D; axis++) value.e[axis] = v[axis];
      tile[place] = value;
    }
  }

  __device__ int corner() const {
    int offset[D];
    split<kBlockWidth>(cell_, offset);
    return in_tile(offset);
  }

  __device__ void move(const NodeValue<T, D>* corner, FollowerOf<Task>& follower) {
    if (out_of_block_ >= 0 && m.base[out_of_block_] < 0) {
      task.skip(particle_);
      return source.fields.read_motion(particle_, state_);
    }
    const auto loaded = task.at(x_, m.home.scene);
    const auto sums = task.compute(Weights<Order, T, D>(f_), TileSupport<Order, T, D>{corner});
    const Motion<T, D> motion = task.motion(sums);
    state_.velocity = motion.velocity;
    state_.affine = motion.affine;
    x_ = task.write(particle_, loaded, sums);
    follower.follow(topology(), m.home, active_, x_);
  }

  int count_ = 0;        // particles of the item
  bool exists_ = false;  // whether this thread has one
  int particle_ = 0;
  unsigned active_ = 0;  // bits of the neighbours of the block that are
  Vector<T, D> x_;
  T f_[D];
  int cell_ = 0, out_of_block_ = -1;
  ParticleMomentum<T, D> state_;
  typename Source::Parameters parameters_;
  typename Source::Changes changes_;
};

// Number of used slots from `begin` to `end`; these come first.
template <class T, int D>
__device__ int used_slots(const Topology<T, D>& t, int begin, int end) {
  const int first = begin;
  while (begin < end) {
    const int middle = (begin + end) / 2;
    if (t.block[middle] >= 0)
      begin = middle + 1;
    else
      end = middle;
  }
  return begin - first;
}

// The nodes of the slots in use: the first ones, and the first ones of the margin. By a grid of `blocks` thread blocks.
template <class T, int D>
struct UsedNodes {
  int count, near, gap;  // gap: from the last one to the first one of the margin

  __device__ UsedNodes(int used, int of_margin, int max_blocks)
      : count((used + of_margin) * kBlockNodes<D>),
        near(used * kBlockNodes<D>),
        gap((max_blocks - used) * kBlockNodes<D>) {}
  __device__ void empty(T* nodes, const FixedPoint& fixed, int blocks) const {
    NodeRow<T, D>* const rows = reinterpret_cast<NodeRow<T, D>*>(nodes);
    for (int i = int(blockIdx.x * blockDim.x + threadIdx.x); i < count; i += blocks * int(blockDim.x))
      NodeRows<T, D>::empty(rows, i < near ? i : i + gap, fixed);
  }
};

template <class T, int D>
__device__ void write_persistent_status(const PersistentLoop<T, D>& a, int scenes, int steps) {
  for (int row = threadIdx.x; row <= scenes; row += blockDim.x) {
    copy_status(a.activated + row * kStatusSize, a.status + row * kStatusSize);
    if (row == 0) a.status[kActivations] += steps - 1;
  }
}

// Barriers of the kernel, with the displacement counters of thread blocks: in shared memory, with two counters in turn,
// so that other blocks of a cluster can read one while the next one is in use.
class CountingBarrier {
 public:
  static_assert(kLargestCluster <= 32);

  __device__ CountingBarrier(unsigned long long* arrived, int blocks, bool cluster, Displacement* counted)
      : barrier_{arrived, unsigned(blocks)}, cluster_(cluster), counted_(counted) {
    if (threadIdx.x < 2) counted[threadIdx.x] = {};
  }

  __device__ Displacement* counted() { return counted_ + turn_; }
  // Returns the sum of the counters of all thread blocks since the previous barrier.
  __device__ Displacement wait() {
    Displacement* const mine = counted();
    turn_ = 1 - turn_;
    const Displacement all = cluster_ ? sum_of_cluster(mine) : sum_of_grid(*mine);
    if (threadIdx.x == 0) *counted() = {};
    return all;
  }

 private:
  __device__ Displacement sum_of_cluster(Displacement* mine) {
    __shared__ Displacement all;
    wait_for_cluster();
    if (threadIdx.x < 32) {
      const Displacement one = threadIdx.x < gridDim.x ? *in_block_of_cluster(mine, threadIdx.x) : Displacement{};
      const int out_of_block = __reduce_add_sync(~0u, one.out_of_block), lost = __reduce_or_sync(~0u, one.lost);
      if (threadIdx.x == 0) all = {out_of_block, lost};
    }
    __syncthreads();
    return all;
  }
  __device__ Displacement sum_of_grid(const Displacement& mine) {
    const unsigned sum = barrier_.wait([&] { return unsigned(mine.out_of_block) + (mine.lost ? kLost : 0); });
    const int out_of_block = int(sum % kLost), before = out_of_block_before_last_;  // of every other barrier
    out_of_block_before_last_ = out_of_block_before_;
    out_of_block_before_ = out_of_block;
    return {out_of_block - before, sum >= kLost};
  }

  static constexpr unsigned kLost =
      1 << 22;  // more than all particles out of block of a launch; 1023 blocks may add as much
  static_assert(int64_t(kStepsOfALaunch) * kMostPersistentParticles / kParticlesPerOutOfBlock +
                    kMostPersistentParticles <
                kLost);

  Barrier barrier_;
  const bool cluster_;
  Displacement* const counted_;
  int turn_ = 0, out_of_block_before_ = 0, out_of_block_before_last_ = 0;
};

template <class Source, class Task, class T, int D>
__global__ void __launch_bounds__(ItemStep<Source, Task>::threads, kItemsOfProcessor<D>)
    persistent_kernel(const __grid_constant__ Source source, const __grid_constant__ Task task,
                      const __grid_constant__ PersistentLoop<T, D> a) {
  using Step = ItemStep<Source, Task>;
  constexpr int threads = Step::threads;
  extern __shared__ __align__(16) char memory[];
  __shared__ ItemMemory<typename Step::S> shared;
  __shared__ int of_margin;
  __shared__ Displacement counted[2];
  __shared__ alignas(16) char contact_memory[sizeof(ContactArguments<T, D>)];
  grid_dependency_sync();
  const Topology<T, D>& t = source.topology;
  const bool cluster = is_cluster();
  const int items = *schedule_of(t).item_count, first = *a.steps_so_far;
  const int blocks = cluster ? int(gridDim.x) : ::max(1, ::min(items, int(gridDim.x)));
  const bool leads = blockIdx.x == 0 && threadIdx.x == 0, alone = items <= blocks;
  if (first >= a.steps && leads && a.loop) cudaGraphSetConditional(a.loop, 0);
  if (first >= a.steps || int(blockIdx.x) >= blocks) return;
  auto& contact = *reinterpret_cast<ContactArguments<T, D>*>(contact_memory);
  if (threadIdx.x == 0 && a.obstacles) contact = a.contact;
  if (threadIdx.x == 32) of_margin = used_slots(t, a.blocks, t.max_blocks);
  __syncthreads();
  const UsedNodes<T, D> used(::min(a.activated[kBlocksNow], a.blocks), of_margin, a.blocks);
  CountingBarrier barrier(a.arrived, blocks, cluster, counted);
  Step item(source, task, a.update, shared, memory);
  const bool keeps = alone && int(blockIdx.x) < items;  // an item of its own
  if (keeps) item.begin(blockIdx.x), item.load(), item.link();
  const auto each_item = [&](const auto& phase) {
    for (int i = blockIdx.x; i < items; i += blocks) {
      if (!alone) item.begin(i);
      phase();
      if (!alone) __syncthreads();
    }
  };
  const int64_t tail = t.offsets[t.max_blocks] + int64_t(blockIdx.x) * threads + threadIdx.x;
  const auto each_outside = [&](const auto& skip) {
    for (int64_t i = tail; i < t.particles; i += int64_t(blocks) * threads) skip(t.index[i]);
  };
  const auto lasts = [&](const Displacement& all) {
    return all.lost == 0 && all.out_of_block * kParticlesPerOutOfBlock <= t.particles;
  };
  const bool ahead = alone && !a.scene_time;
  int step = first;
  for (bool more = true; more;) {
    used.empty(a.nodes[(step + 1) % 3], source.nodes.fixed, blocks);
    each_item([&] {
      if (!alone) item.load(), item.link(), item.keep();
      item.scatter(a.nodes[step % 3]);
    });
    if (threadIdx.x == 0 && a.step_time) contact.time = a.step_time[step];
    if (threadIdx.x == 0 && a.obstacles) contact.row = a.contact.row + step * a.contact.step_stride;
    if (!lasts(barrier.wait())) break;

    if (keeps) item.keep();
    each_outside([&](int p) { source.skip(p); });
    const NodeVelocities<T, D> velocities{
        a.update,
        contact,
        a.obstacles,
        {reinterpret_cast<const NodeRow<T, D>*>(a.nodes[step % 3]), source.nodes.fixed}};
    FollowerOf<Task> follower;
    each_item([&] { item.gather(velocities, alone, follower); });
    each_outside([&](int p) { task.skip(p); });
    follower.flush_counters(barrier.counted());
    step++;
    more = step < a.steps && step - first < kStepsOfALaunch;
    if (keeps && more) item.link();  // of the next substep
    if (ahead && more) continue;
    more = lasts(barrier.wait()) && more;
    if (blockIdx.x == 0 && a.scene_time)
      for (int b = threadIdx.x; b < t.scenes; b += threads) a.scene_time[b] += a.update.dt * double(a.scene_dt[b]);
  }
  for (T* nodes : a.nodes) used.empty(nodes, source.nodes.fixed, blocks);
  if (blockIdx.x == 0) write_persistent_status(a, t.scenes, step - first);
  if (cluster) wait_for_cluster();  // other blocks may still read the counters of this one
  if (!leads) return;
  *a.steps_so_far = step;
  a.displacement->lost = Displacement::kLost;  // requests a new activation
  if (a.loop) cudaGraphSetConditional(a.loop, step < a.steps);
}

template <class Source, class Task, class T, int D>
void launch_persistent(const Source& source, const Task& task, const PersistentArguments<T, D>& a, Stream stream) {
  using Step = ItemStep<Source, Task>;
  const int64_t particles = source.topology.particles, items = most_items(source.topology.max_blocks, particles);
  const int64_t most = particles <= kMostClusterParticles ? kLargestCluster : items;
  launch_at_once(persistent_kernel<Source, Task, T, D>, unsigned(std::min(items, most)), Step::threads,
                 Step::S::shared_bytes, stream, source, task, static_cast<const PersistentLoop<T, D>&>(a));
}

}  // namespace mpm::cuda
#endif
