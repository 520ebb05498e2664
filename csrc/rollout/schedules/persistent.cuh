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
//
// The search for several surfaces is a deep call, and nvcc keeps in memory what is live across one. So the first kernel
// of scenes with obstacles has no such call: an item with a node that meets several surfaces does not complete its G2P,
// and the kernel ends at the next barrier. A second kernel completes these items and computes the rest of the
// activation.
//
// A substep of few particles is one chain of loads and sums that wait for each other. So the grid data of an item are
// loaded once if a thread block has no other item, and cells have more threads in 3-D than in P2G alone.
#if CUDART_VERSION >= 13000
namespace mpm::cuda {

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

template <class T, int D>
__device__ void store(const Vector<T, D>& v, NodeValue<T, D>& value) {
  value = {};
#pragma unroll
  for (int axis = 0; axis < D; axis++) value.e[axis] = v[axis];
}

// The contacts that a kernel computes.
enum class Contacts { none, one_surface, several_surfaces };

struct TileNode {
  int place;           // in the tile, or beyond that in the support of a particle out of block; -1 outside the grid
  int slot = -1;       // -1 where it has none
  int local = 0;       // in its slot
  int neighbour = -1;  // of the block of the item; -1 of a particle out of block
};

// The nodes that an item reads: those of its tile, and then those of the supports of `out_of_block` particles.
template <class S>
struct TileNodes {
  using T = typename S::T;
  static constexpr int D = S::D, Order = S::Order, width = kBlockWidth + Order;
  static constexpr int tile = D == 2 ? width * width : width * width * width;
  // The support of a particle out of block has the row length of the tile, so that G2P treats both alike.
  static constexpr int support = S::support * S::slab,
                       span = (D == 2 ? 0 : Order * width * width) + Order * width + Order + 1;

  const ItemMemory<S>& m;
  const int* neighbours;
  int first_out_of_block, of_tile, out_of_block;

  __device__ int count() const { return of_tile + out_of_block * support; }

  __device__ TileNode at(int i) const {
    int offset[D], base = 0;
    TileNode node;
    const int* slots = m.slots;
    const bool of_particle = i >= of_tile;
    if (of_particle) {
      const int s = (i - of_tile) / support;
      split<Order + 1>((i - of_tile) % support, offset);
      node.place = tile + s * span + in_tile(offset);
      base = m.base[first_out_of_block + s];
      slots = neighbours + (int64_t(base / kBlockNodes<D>) << D);
      if (base < 0) node.place = -1;
    } else {
      split<width>(i, offset);
      node.place = i;
    }
    int at[D], neighbour = 0;
#pragma unroll
    for (int axis = D - 1, rest = base; axis >= 0; axis--, rest /= kBlockWidth) {
      at[axis] = (of_particle ? rest % kBlockWidth : 0) + offset[axis];
      neighbour |= (at[axis] >= kBlockWidth) << (D - 1 - axis);
    }
    if (node.place >= 0) node.slot = slots[neighbour];
    node.local = node_in_block<D>(at);
    if (!of_particle) node.neighbour = neighbour;
    return node;
  }
  __device__ SlotUpdate<T, D> update_of(const TileNode& node, const GridUpdateArguments<T, D>& update) const {
    return node.neighbour < 0 ? slot_update(update, node.slot) : m.there[node.neighbour];
  }

  __device__ static int in_tile(const int (&offset)[D]) {
    int place = 0;
#pragma unroll
    for (int axis = 0; axis < D; axis++) place = place * width + offset[axis];
    return place;
  }
};

// The velocity of nodes after the grid update and contact, computed where it is read.
template <Contacts C, class T, int D>
struct NodeVelocities {
  const GridUpdateArguments<T, D>& update;
  const ContactArguments<T, D>& contact;
  NodeRows<T, D> nodes;
  const KnownTouch<T, D>* touches;

  // Of a node that meets several surfaces, that before contact; `several` is set. The kernel of one surface has the
  // contact of those whose surfaces are known.
  __device__ Vector<T, D> at(const SlotUpdate<T, D>& there, const TileNode& place, bool& several) const {
    KnownTouch<T, D> known;
    if constexpr (C != Contacts::none) known = touch_of(place);
    const NodeRow<T, D> node = row(place);
    if (node.mass == T(0)) return zero_vector<T, D>();
    const Vector<T, D> v = update_node(update, there, place.local, node).value;
    if constexpr (C == Contacts::none) return v;
    if constexpr (C == Contacts::one_surface) return known.after(contact, v, several);
    several = known.touch.obstacle == known.touch.several;
    return known.touch.obstacle >= 0 ? known.touch.after(v) : v;
  }
  __device__ NodeRow<T, D> row(const TileNode& place) const { return nodes.at(number(place)); }

 private:
  __device__ static int64_t number(const TileNode& place) { return int64_t(place.slot) * kBlockNodes<D> + place.local; }
  // Past the first cache, since another multiprocessor has written it during this kernel.
  __device__ KnownTouch<T, D> touch_of(const TileNode& place) const {
    constexpr int vectors = sizeof(KnownTouch<T, D>) / sizeof(uint4);
    KnownTouch<T, D> known;
    const uint4* const stored = reinterpret_cast<const uint4*>(touches + number(place));
#pragma unroll
    for (int k = 0; k < vectors; k++) reinterpret_cast<uint4*>(&known)[k] = __ldcg(stored + k);
    return known;
  }
};

// Contact of the nodes that meet several surfaces, from their velocities before it. Called by all threads.
template <class S, class T, int D>
__device__ __noinline__ void add_contact(const TileNodes<S>& nodes,
                                         const NodeVelocities<Contacts::several_surfaces, T, D>& velocities,
                                         const SeveralNodes& several, NodeValue<T, D>* tile) {
  for (int i = threadIdx.x, turn = 0; any_of_warp(i < nodes.count()); i += S::threads, turn++) {
    TileNode node{-1};
    if (i < nodes.count() && several.may_have(turn)) node = nodes.at(i);
    SlotUpdate<T, D> there;
    Vector<T, D> v = zero_vector<T, D>();
    const bool has_mass = node.slot >= 0 && velocities.row(node).mass != T(0);
    if (has_mass) {
      there = nodes.update_of(node, velocities.update);
#pragma unroll
      for (int axis = 0; axis < D; axis++) v[axis] = tile[node.place].e[axis];
    }
    if (meet_several(several, turn, has_mass, velocities.contact, there.scene, there.corner, node.local, v))
      store(v, tile[node.place]);
  }
}

// The phases of a substep of one item, whose particles have a thread each.
template <class Source, class Task>
class ItemStep {
 public:
  using S = SharingShape<typename Source::Shape>;
  using T = typename S::T;
  static constexpr int D = S::D, Order = Task::Order, threads = S::threads;
  static constexpr int tile_nodes = TileNodes<S>::tile, span = TileNodes<S>::span;
  static_assert(Order == S::Order);
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

  // Called by all threads, after they have finished the previous item.
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

  // G2P of the particles; `found` if link() has located them. Returns false, to all threads, where no particle has
  // moved, because a node meets several surfaces and C is one_surface.
  template <Contacts C>
  __device__ bool gather(const NodeVelocities<C, T, D>& velocities, bool found, FollowerOf<Task>& follower) {
    NodeValue<T, D>* const tile = reinterpret_cast<NodeValue<T, D>*>(memory);
    if (!found) {
      if (exists_) find();
      __syncthreads();
    }
    const int out_of_block = m.out_of_block;
    if (C == Contacts::one_surface && !meet_known_surfaces(velocities, tile, out_of_block)) return false;
    int first = 0;
    do {
      const int count = ::min(out_of_block - first, out_of_block_at_once);
      if (!load_velocities(velocities, tile, first, first == 0 ? tile_nodes : 0, count)) return false;
      const bool mine = out_of_block_ < 0 ? first == 0 : out_of_block_ >= first && out_of_block_ < first + count;
      if (exists_ && mine)
        move(out_of_block_ < 0 ? tile + corner() : tile + tile_nodes + (out_of_block_ - first) * span, follower);
      first += out_of_block_at_once;
      __syncthreads();
    } while (first < out_of_block);
    if (threadIdx.x == 0) m.out_of_block = 0;
    __syncthreads();
    return true;
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

  // Computes the velocities of the first nodes of the tile, and of the supports of `count` particles out of block. By
  // all threads; false as gather().
  template <Contacts C>
  __device__ bool load_velocities(const NodeVelocities<C, T, D>& velocities, NodeValue<T, D>* tile,
                                  int first_out_of_block, int of_tile, int count) {
    const TileNodes<S> nodes{m, schedule_of(topology()).neighbours, first_out_of_block, of_tile, count};
    SeveralNodes several;
#pragma unroll 1
    for (int i = threadIdx.x, turn = 0; i < nodes.count(); i += threads, turn++) {
      const TileNode node = nodes.at(i);
      if (node.place < 0) continue;
      Vector<T, D> v = zero_vector<T, D>();
      bool meets_several = false;
      if (node.slot >= 0) {
        v = velocities.at(nodes.update_of(node, update), node, meets_several);
      }
      if (meets_several) several.add(turn);
      store(v, tile[node.place]);
    }
    if constexpr (C == Contacts::one_surface) return !__syncthreads_or(several.any());
    if constexpr (C == Contacts::several_surfaces)
      if (__syncthreads_or(several.any())) add_contact(nodes, velocities, several, tile);
    __syncthreads();
    return true;
  }

  // Whether the nodes of the particles out of block that G2P reads in later turns have known surfaces alone. By all
  // threads, before a particle moves.
  template <Contacts C>
  __device__ bool meet_known_surfaces(const NodeVelocities<C, T, D>& velocities, NodeValue<T, D>* tile,
                                      int out_of_block) {
    for (int first = out_of_block_at_once; first < out_of_block; first += out_of_block_at_once)
      if (!load_velocities(velocities, tile, first, 0, ::min(out_of_block - first, out_of_block_at_once))) return false;
    return true;
  }

  __device__ int corner() const {
    int offset[D];
    split<kBlockWidth>(cell_, offset);
    return TileNodes<S>::in_tile(offset);
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
    visit(blocks, [&](int i) { NodeRows<T, D>::empty(rows, i, fixed); });
  }
  // Finds what nodes meet, once for all items that read them. Stored twice where obstacles rest, for later substeps.
  __device__ void find_touches(const GridUpdateArguments<T, D>& update, const ContactArguments<T, D>& contact,
                               KnownTouch<T, D>* touches, KnownTouch<T, D>* also, int blocks) const {
    visit(blocks, [&](int i) {
      const SlotUpdate<T, D> there = slot_update(update, i / kBlockNodes<D>);
      if (!there.active) return;
      const KnownTouch<T, D> found(contact, there.scene, there.corner, i % kBlockNodes<D>);
      touches[i] = found;
      if (also) also[i] = found;
    });
  }

 private:
  template <class Visit>
  __device__ void visit(int blocks, const Visit& visit_node) const {
    for (int i = int(blockIdx.x * blockDim.x + threadIdx.x); i < count; i += blocks * int(blockDim.x))
      visit_node(i < near ? i : i + gap);
  }
};

// Whether the obstacles of all scenes stay where they are. By all threads of a thread block.
template <class T, int D>
__device__ bool all_rest(const ContactArguments<T, D>& contact, int scenes) {
  bool rest = true;
  for (int b = threadIdx.x; b < scenes; b += blockDim.x) rest = rest && obstacles_rest(contact, b);
  return __syncthreads_and(rest);
}

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
  // Those of the previous barrier.
  __device__ const Displacement* counted_before() const { return counted_ + (1 - turn_); }
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

template <Contacts C, class Source, class Task, class T, int D>
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
  if (C == Contacts::several_surfaces && a.handover->steps == 0) return;
  const Topology<T, D>& t = source.topology;
  const bool cluster = is_cluster();
  const int items = *schedule_of(t).item_count, first = *a.steps_so_far;
  const int blocks = cluster ? int(gridDim.x) : ::max(1, ::min(items, int(gridDim.x)));
  const bool leads = blockIdx.x == 0 && threadIdx.x == 0, alone = items <= blocks;
  const bool continues = C == Contacts::several_surfaces && a.handover->requested;
  if (first >= a.steps && !continues && leads && a.loop) cudaGraphSetConditional(a.loop, 0);
  if ((first >= a.steps && !continues) || int(blockIdx.x) >= blocks) return;
  if (C == Contacts::one_surface && (!alone || a.scene_time)) {
    if (leads) a.handover->steps = 1;
    return;
  }
  auto& contact = *reinterpret_cast<ContactArguments<T, D>*>(contact_memory);
  if (C != Contacts::none && threadIdx.x == 0) contact = a.contact;
  if (threadIdx.x == 32) of_margin = used_slots(t, a.blocks, t.max_blocks);
  __syncthreads();
  const UsedNodes<T, D> used(::min(a.activated[kBlocksNow], a.blocks), of_margin, a.blocks);
  CountingBarrier barrier(a.arrived, blocks, cluster, counted);
  Step item(source, task, a.update, shared, memory);
  const auto lasts = [&](const Displacement& all) {
    return all.lost == 0 && all.out_of_block * kParticlesPerOutOfBlock <= t.particles;
  };
  const auto set_contact = [&](int step) {
    if (C == Contacts::none || threadIdx.x > 0) return;
    if (a.step_time) contact.time = a.step_time[step];
    contact.row = a.contact.row + step * a.contact.step_stride;
  };
  const auto velocities = [&](int step) {
    return NodeVelocities<C, T, D>{a.update,
                                   contact,
                                   {reinterpret_cast<const NodeRow<T, D>*>(a.nodes[step % 3]), source.nodes.fixed},
                                   a.touches[step % 2]};
  };
  const bool has_item = int(blockIdx.x) < items, keeps = alone && has_item;  // an item of its own
  bool more = true;
  if constexpr (C == Contacts::several_surfaces) {
    if (continues) {  // G2P of items that the other kernel has not completed
      FollowerOf<Task> follower;
      set_contact(first - 1);
      if (has_item && a.handover->incomplete[blockIdx.x]) {
        item.begin(blockIdx.x);
        item.gather(velocities(first - 1), false, follower);
      }
      follower.flush_counters(barrier.counted());
      more = lasts(barrier.wait()) && !a.handover->lost && first < a.steps;
    }
  }
  if (keeps && more) {
    item.begin(blockIdx.x);
    item.load();
    item.link();
  }
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
  const bool ahead = alone && !a.scene_time;
  bool rest = false;  // whether obstacles stay where they are
  int step = first;
  bool complete = true;
  while (more) {
    set_contact(step);
    used.empty(a.nodes[(step + 1) % 3], source.nodes.fixed, blocks);
    each_item([&] {
      if (!alone) item.load(), item.link(), item.keep();
      if (complete) item.scatter(a.nodes[step % 3]);
    });
    if (C != Contacts::none && !rest) {
      __syncthreads();  // after set_contact()
      rest = step == first && all_rest(contact, t.scenes);
      used.find_touches(a.update, contact, a.touches[step % 2], rest ? a.touches[(step + 1) % 2] : nullptr, blocks);
    }
    if (!lasts(barrier.wait())) break;

    if (keeps) item.keep();
    each_outside([&](int p) { source.skip(p); });
    FollowerOf<Task> follower;
    each_item([&] { complete = item.gather(velocities(step), alone, follower); });
    each_outside([&](int p) { task.skip(p); });
    follower.flush_counters(barrier.counted());
    if (C == Contacts::one_surface && !complete && threadIdx.x == 0) a.handover->request(*barrier.counted());
    step++;
    more = step < a.steps && step - first < kStepsOfALaunch;
    if (keeps && more && complete) item.link();  // of the next substep
    if (ahead && more) continue;
    more = lasts(barrier.wait()) && more;
    if (blockIdx.x == 0 && a.scene_time)
      for (int b = threadIdx.x; b < t.scenes; b += threads) a.scene_time[b] += a.update.dt * double(a.scene_dt[b]);
  }
  const bool hands_over = C == Contacts::one_surface && a.handover->is_requested();
  if (hands_over && threadIdx.x == 0) a.handover->end(*barrier.counted_before());
  for (T* const nodes : a.nodes)
    if (!hands_over || nodes != a.nodes[(step + 2) % 3]) used.empty(nodes, source.nodes.fixed, blocks);
  const int before = C == Contacts::several_surfaces ? a.handover->steps - 1 : 0;
  if (blockIdx.x == 0) write_persistent_status(a, t.scenes, before + step - first);
  if (cluster) wait_for_cluster();  // other blocks may still read the counters of this one
  if (!leads) return;
  *a.steps_so_far = step;
  if (hands_over) a.handover->steps = 1 + step - first;
  a.displacement->lost = Displacement::kLost;  // requests a new activation
  if (a.loop) cudaGraphSetConditional(a.loop, step < a.steps);
}

template <class Source, class Task, class T, int D>
void launch_persistent(const Source& source, const Task& task, const PersistentArguments<T, D>& a, Stream stream) {
  using Step = ItemStep<Source, Task>;
  const int64_t particles = source.topology.particles, items = most_items(source.topology.max_blocks, particles);
  const int64_t most = particles <= kMostClusterParticles ? kLargestCluster : items;
  const auto launch_kernel = [&](auto kernel, PersistentLoop<T, D> loop) {
    launch_at_once(kernel, unsigned(std::min(items, most)), Step::threads, Step::S::shared_bytes, stream, source, task,
                   loop);
  };
  if (!a.obstacles) return launch_kernel(persistent_kernel<Contacts::none, Source, Task, T, D>, a);
  launch_kernel(persistent_kernel<Contacts::one_surface, Source, Task, T, D>, a);
  PersistentLoop<T, D> rest = a;
  rest.arrived = a.arrived + 2;
  launch_kernel(persistent_kernel<Contacts::several_surfaces, Source, Task, T, D>, rest);
}

}  // namespace mpm::cuda
#endif
