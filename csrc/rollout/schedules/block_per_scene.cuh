#pragma once

#include "grid/contact.h"
#include "rollout/schedules/block_per_scene.h"
#include "transfer/advance_gather.cuh"
#include "transfer/scatter.cuh"

// The kernel with a thread block per scene, for any source of P2G and task of G2P. A substep of a scene is
//   particles   law and contribution of each particle, in lists by cell
//   columns     the rows of cells of a block along the last axis that have particles, in their order; cleared nodes
//   walk        sums over the particles of each column, or of each of its cells, by a thread per leading node, then
//               added to the nodes in turns, no two threads to the same node at a time
//   nodes       grid update and contact
//   particles   G2P, and the blocks that the particles touch next.
// In deterministic activations lists, and therefore sums, have the order of the index tensor.
namespace mpm::cuda {

constexpr int kMostSceneThreads = 512;  // at most

template <class Shape>
struct SceneShape : Shape {
  static constexpr int batch = 0;  // known at run time only
  using Link = int;
  static constexpr int row_bytes = Shape::row_bytes + int(sizeof(Link) - sizeof(typename Shape::Link));
};

// Blocks that a scene has touched since they were numbered, and the nodes and cells of these.
template <class T, int D>
struct SceneBlocks {
  static constexpr int nodes_of_block = kBlockNodes<D>, neighbours = 1 << D;
  static constexpr size_t bytes =  // of a block, in whole vectors
      (nodes_of_block * ((1 + D) * sizeof(T) + sizeof(int)) + (neighbours + 2) * sizeof(int) + 15) / 16 * 16;
  int room;
  T* node;          // [room, nodes, 1 + D]
  int* head;        // [room, nodes] first row in the list of a cell
  int* neighbour;   // [room, 2^D] as in the schedule
  int* block;       // [room] in the table of all scenes
  unsigned* known;  // [room] bits of the neighbours that are numbered

  __device__ SceneBlocks(char* memory, int room) : room(room) {
    node = reinterpret_cast<T*>(memory);
    head = reinterpret_cast<int*>(node + int64_t(room) * nodes_of_block * (1 + D));
    neighbour = head + int64_t(room) * nodes_of_block;
    block = neighbour + int64_t(room) * neighbours;
    known = reinterpret_cast<unsigned*>(block + room);
  }
};

// Values shared by the threads of a scene, beside its particles and nodes.
struct SceneState {
  int begin, end;                                            // particles index[begin, end)
  int blocks;                                                // numbered
  int columns;                                               // with particles
  int grown;                                                 // whether a particle touches a block without a number
  int outside, first_outside, not_finite, first_not_finite;  // of this substep; first as largest complement
  int columns_before[kMostSceneThreads / 32];                // each warp
  char* more_blocks;
  int more_room;
};

// Contact of the nodes of a scene that meet several surfaces, from their velocities before it. Called by all threads.
template <class T, int D>
__device__ __noinline__ void add_contact(const GridUpdateArguments<T, D>& update, const ContactArguments<T, D>& contact,
                                         const SeveralNodes& several, NodeRow<T, D>* rows, int nodes) {
  for (int i = threadIdx.x, turn = 0; any_of_warp(i < nodes); i += blockDim.x, turn++) {
    const int local = i % kBlockNodes<D>;
    SlotUpdate<T, D> there;
    NodeRow<T, D> row{T(0), zero_vector<T, D>()};
    const bool has_mass = i < nodes && several.may_have(turn) && rows[i].mass != T(0);
    if (has_mass) row = rows[i], there = slot_update(update, i / kBlockNodes<D>);
    if (meet_several(several, turn, has_mass, contact, there.scene, there.corner, local, row.value)) rows[i] = row;
  }
}

// The touches of the nodes of a thread, by the turn in which it updates a node, where obstacles rest: finding one takes
// longer than the rest of the update.
template <class T, int D>
class KeptTouches {
 public:
  __device__ explicit KeptTouches(bool rest) : rest_(rest) {}
  // Where nodes are numbered anew.
  __device__ void forget() { has_ = 0; }

  template <class Find>
  __device__ NodeTouch<T, D> get(int turn, const Find& find) {
    if (turn < most && (has_ >> turn & 1)) return kept_[turn];
    const NodeTouch<T, D> found = find();
    if (rest_ && turn < most) kept_[turn] = found, has_ |= 1u << turn;
    return found;
  }

 private:
  static constexpr int most = 4;
  const bool rest_;
  unsigned has_ = 0;  // bits of turns
  NodeTouch<T, D> kept_[most];
};

// Spills is false if the whole scene is in shared memory; all loads and stores are then those of shared memory.
template <class Source, class Task, bool Spills>
class SceneStep {
 public:
  using T = typename Source::Shape::T;
  using S = SceneShape<typename Source::Shape>;
  static constexpr int D = S::D, Order = S::Order, count = kBlockNodes<D>;
  static constexpr int cells = kBlockWidth, rows_of_slab = S::slab / S::support;  // of a column
  using Blocks = SceneBlocks<T, D>;
  using Rows = SharedParticles<S>;

  const Source& source;
  const Task& task;
  const BlockPerSceneArguments<T, D>& a;
  const int scene;
  SceneState& state;
  int* const table;        // [blocks_per_scene] numbers of blocks, -1 without a number
  unsigned* const wanted;  // a bit for each block that needs a number
  Rows rows;
  int* const columns;  // [particles] columns with particles
  Blocks blocks;
  GridUpdateArguments<T, D>& update;  // with the blocks of this scene
  ContactArguments<T, D>& contact;

  __device__ const Topology<T, D>& topology() const { return source.topology; }
  __device__ const Geometry<T, D>& geometry() const { return source.topology.geometry; }
  __device__ int particles() const { return state.end - state.begin; }
  __device__ int particle(int k) const { return topology().index[state.begin + k]; }
  // A thread's particle in the first round, and in the round after that of k; past the end the last one, so that the
  // load is always valid.
  __device__ int first_particle() const { return particle(::min(int(threadIdx.x), particles() - 1)); }
  __device__ int particle_after(int k) const { return particle(::min(k + int(blockDim.x), particles() - 1)); }

  // Cell of a base node in the numbered blocks; `base` becomes that in its block.
  __device__ int cell_of(int (&base)[D]) const {
    const int local = node_in_block<D>(base);
    return table[block_of(base)] * count + local;
  }

  // Block of a base node in this scene's table; `base` becomes that in its block.
  __device__ int block_of(int (&base)[D]) const {
    int block[D];
#pragma unroll
    for (int i = 0; i < D; i++) {
      block[i] = base[i] / kBlockWidth;
      base[i] &= kBlockWidth - 1;
    }
    return block_index(geometry(), 0, block);
  }

  __device__ void touch(const Vector<T, D>& x) const {
    int base[D];
    T f[D];
    if (!locate<Order>(geometry(), x.e, base, f)) return;
    const int block = block_of(base), number = table[block];
    const unsigned touched = touched_blocks<Order, D>(base);
    if (number >= 0 && (touched & ~blocks.known[number]) == 0) return;
    for (int o = 0; o < 1 << D; o++) {
      if (!(touched >> o & 1)) continue;
      const int b = block + further(geometry(), o);
      if (table[b] >= 0) continue;
      atomicOr(&wanted[b / 32], 1u << b % 32);
      atomicOr(&state.grown, 1);
    }
  }

  __device__ void touch_all() const {
    for (int k = threadIdx.x; k < particles(); k += blockDim.x) touch(read_vector(source.position, particle(k)));
  }

  // By one warp: numbers the touched blocks, as many as there is room for.
  __device__ void number_blocks() const {
    const int lane = threadIdx.x;
    int number = 0;
    for (int first = 0; first < geometry().blocks_per_scene; first += 32) {
      const int b = first + lane;
      const bool touched = b < geometry().blocks_per_scene && (table[b] >= 0 || wanted[first / 32] >> lane & 1);
      const unsigned with = __ballot_sync(~0u, touched);
      const int mine = number + __popc(with & ((1u << lane) - 1));
      if (touched) {
        table[b] = mine;
        if (mine < blocks.room) blocks.block[mine] = scene * geometry().blocks_per_scene + b;
      }
      number += __popc(with);
      __syncwarp();
      if (lane == 0) wanted[first / 32] = 0;
    }
    if (lane == 0) state.blocks = number, state.grown = 0;
  }

  __device__ void number() const {
    __syncthreads();
    if (threadIdx.x < 32) number_blocks();
    __syncthreads();
  }

  // Renumbers the blocks if particles touch new ones. If there is no room, blocks without particles are dropped first.
  // If that does not suffice and the scene Spills, blocks move to global memory, and false means that none is left;
  // otherwise false means that the scene has to continue with Spills.
  __device__ bool make_room(int64_t step) {
    if (!state.grown) return true;
    number();
    if (state.blocks > blocks.room) {
      for (int b = threadIdx.x; b < geometry().blocks_per_scene; b += blockDim.x) table[b] = -1;
      __syncthreads();
      touch_all();
      number();
      if (state.blocks > blocks.room && !find_more(step)) return false;
    }
    for (int i = threadIdx.x; i < state.blocks; i += blockDim.x) {
      const int b = blocks.block[i] - scene * geometry().blocks_per_scene;
      unsigned known = 0;
      for (int o = 0; o < 1 << D; o++) {
        const int to = b + further(geometry(), o), number = to < geometry().blocks_per_scene ? table[to] : -1;
        blocks.neighbour[(i << D) + o] = number;
        known |= unsigned(number >= 0) << o;
      }
      blocks.known[i] = known;
    }
    for (int i = threadIdx.x; i < state.blocks * count; i += blockDim.x) blocks.head[i] = Rows::end;
    update.block = contact.block = blocks.block;
    __syncthreads();
    return true;
  }

  // By one thread: takes spare blocks with some headroom, otherwise as many as needed, otherwise none.
  __device__ void take_spare_blocks() const {
    int first = *const_cast<volatile int*>(a.blocks_taken), room, found;
    do {
      found = first;
      const int with_headroom = state.blocks + state.blocks / 4;
      room = found + with_headroom <= a.spare_blocks  ? with_headroom
             : found + state.blocks <= a.spare_blocks ? state.blocks
                                                      : 0;
      first = room > 0 ? atomicCAS(a.blocks_taken, found, found + room) : found;
    } while (first != found);
    state.more_room = room;
    state.more_blocks = a.blocks + int64_t(found) * int64_t(Blocks::bytes);
  }

  // Without Spills the table is cleared for the instance with Spills.
  __device__ bool find_more(int64_t step) {
    if constexpr (Spills) {
      return take_more(step);
    } else {
      for (int b = threadIdx.x; b < geometry().blocks_per_scene; b += blockDim.x) table[b] = -1;
      __syncthreads();
      return false;
    }
  }

  __device__ bool take_more(int64_t step) {
    if (threadIdx.x == 0) {
      take_spare_blocks();
      if (state.more_room == 0) a.errors[scene].full = int(step) + 1, a.errors[scene].wanted = state.blocks;
    }
    __syncthreads();
    if (state.more_room == 0) return false;
    blocks = Blocks(state.more_blocks, state.more_room);
    number();
    return true;
  }

  __device__ void load_particles() const {
    int following = first_particle();
#pragma unroll 1
    for (int k = threadIdx.x; k < particles(); k += blockDim.x) {
      const int p = following;
      following = particle_after(k);
      const Vector<T, D> x = read_vector(source.position, p);
      const auto loaded = source.load(p, scene);
      int base[D];
      T f[D];
      if (!locate<Order>(geometry(), x.e, base, f)) {
        skip(p, x);
        continue;
      }
      const int row = Rows::row(k), cell = cell_of(base);
      store_particle<S, T, D>(rows, row, f, source.contribution(loaded));
      rows.next[row] = atomicExch(&blocks.head[cell], row);
    }
  }

  __device__ void skip(int p, const Vector<T, D>& x) const {
    const bool finite = is_finite<D>(x.e);
    atomicAdd(finite ? &state.outside : &state.not_finite, 1);
    atomicMax(finite ? &state.first_outside : &state.first_not_finite, INT_MAX - p);
  }

  // Stores the errors of the first substep with an error.
  __device__ void report_errors(int64_t step) const {
    SceneErrors& t = a.errors[scene];
    if (threadIdx.x > 0 || state.outside + state.not_finite == 0) return;
    if (t.step == 0)
      t = {int(step) + 1,
           state.outside,
           INT_MAX - state.first_outside,
           state.not_finite,
           INT_MAX - state.first_not_finite,
           t.full,
           t.wanted};
    state.outside = state.not_finite = state.first_outside = state.first_not_finite = 0;
  }

  // Sorts the list of a cell by particle. It mostly has the reverse order, which needs one pass.
  __device__ void sort_list(int cell) const {
    int first = Rows::end;
    for (int row = blocks.head[cell]; row != Rows::end;) {
      const int following = rows.next[row], k = Rows::row(row);  // its own inverse
      int before = Rows::end, after = first;
      while (after != Rows::end && Rows::row(after) < k) before = after, after = rows.next[after];
      rows.next[row] = after;
      if (before == Rows::end)
        first = row;
      else
        rows.next[before] = row;
      row = following;
    }
    blocks.head[cell] = first;
  }

  __device__ bool has_particles(int column) const {
    const int4 first = reinterpret_cast<const int4*>(blocks.head)[column];
    static_assert(kBlockWidth == 4 && Rows::end == -1);
    return (first.x & first.y & first.z & first.w) != Rows::end;
  }

  __device__ void list_columns() const {
    const int of_blocks = state.blocks * count / kBlockWidth, warps = blockDim.x / 32, warp = threadIdx.x / 32,
              lane = threadIdx.x % 32;
    const int share = (of_blocks + warps * 32 - 1) / (warps * 32) * 32;
    const int begin = ::min(warp * share, of_blocks), end = ::min(begin + share, of_blocks);
    int mine = 0;
    for (int first = begin; first < end; first += 32)
      mine += __popc(__ballot_sync(~0u, first + lane < end && has_particles(first + lane)));
    if (lane == 0) state.columns_before[warp] = mine;
    for (int i = threadIdx.x; i < state.blocks * (count * (1 + D) / 4); i += blockDim.x)
      store_vec4(blocks.node + 4 * i, Vec4<T>{});
    __syncthreads();
    int number = __reduce_add_sync(~0u, lane < warp ? state.columns_before[lane] : 0);
    for (int first = begin; first < end; first += 32) {
      const int column = first + lane;
      const bool with = column < end && has_particles(column);
      const unsigned others = __ballot_sync(~0u, with);
      if (with) columns[number + __popc(others & ((1u << lane) - 1))] = column;
      number += __popc(others);
    }
    if (warp == warps - 1 && lane == 0) state.columns = number;
    __syncthreads();
    if (!a.p2g.deterministic) return;
    for (int i = threadIdx.x; i < state.columns * kBlockWidth; i += blockDim.x)
      sort_list(columns[i / kBlockWidth] * kBlockWidth + i % kBlockWidth);
    __syncthreads();
  }

  // Rows of the nodes that a thread adds to: for each row of nodes behind its leading one, the node beside the first
  // cell of the column, and the node beyond the block, -1 if no particle of the column touches it.
  struct Places {
    int near[rows_of_slab], far[rows_of_slab];
  };

  __device__ Places places_of(int column, int lane) const {
    Places places;
    const int first = column * cells;
#pragma unroll
    for (int across = 0; across < rows_of_slab; across++) {
      const int offset[2] = {lane, across};
      int node[D], neighbour = 0;
      node[D - 1] = 0;
#pragma unroll
      for (int i = 0; i < D - 1; i++) {
        node[i] = lattice_index_in_block(first, i) + offset[i];
        neighbour = neighbour * 2 + (node[i] >= kBlockWidth);
      }
      const int* const slots = blocks.neighbour + (first / count << D) + neighbour * 2;
      places.near[across] = slots[0] * count + node_in_block<D>(node);
      places.far[across] = slots[1] < 0 ? -1 : slots[1] * count + node_in_block<D>(node);
    }
    return places;
  }

  __device__ static int lattice_index_in_block(int cell, int axis) {
    return cell >> 2 * (D - 1 - axis) & (kBlockWidth - 1);
  }

  template <int Nodes>
  __device__ void add_to_nodes(int row, const T (*value)[S::channels]) const {
    T* const to = blocks.node + row * (1 + D);
    if constexpr (D == 3 && sizeof(T) == 4) {
      Vec4<T> v[Nodes];
#pragma unroll
      for (int n = 0; n < Nodes; n++) v[n] = load_vec4(to + 4 * n);
#pragma unroll
      for (int n = 0; n < Nodes; n++) {
#pragma unroll
        for (int c = 0; c < 4; c++) v[n].e[c] += value[n][c];
        store_vec4(to + 4 * n, v[n]);
      }
    } else {
#pragma unroll
      for (int n = 0; n < Nodes; n++)
#pragma unroll
        for (int c = 0; c <= D; c++) to[n * (1 + D) + c] += value[n][c];
    }
  }

  // For rows of nodes behind a leading one, with a thread for each cell of a column (the n-th): the sums for the node
  // beside the cell, and for the node beyond the block at the same distance from its first one.
  __device__ static void exchange(int n, const T (*sum)[S::channels], T (&near)[S::channels], T (&far)[S::channels]) {
#pragma unroll
    for (int c = 0; c < S::channels; c++) near[c] = sum[0][c], far[c] = T(0);
#pragma unroll
    for (int k = 1; k <= Order; k++) {
#pragma unroll
      for (int c = 0; c < S::channels; c++) {
        const T from = __shfl_sync(~0u, sum[k][c], (n - k) & (cells - 1), cells);
        near[c] += n >= k ? from : T(0);
        far[c] += n >= k ? T(0) : from;
      }
    }
  }

  // With a thread for each column and leading node.
  __device__ void walk_columns() const {
    constexpr int nodes = cells + Order;
    const int walkers = state.columns * S::support;
    for (int begin = 0; begin < walkers; begin += blockDim.x) {
      const Walker<S> walker(begin + int(threadIdx.x));
      const bool walks = begin + int(threadIdx.x) < walkers;
      const int column = walks ? columns[walker.list] : 0;
      T sum[rows_of_slab * nodes][S::channels] = {};
      if (walks) {
#pragma unroll
        for (int n = 0; n < cells; n++) {
#pragma unroll 1
          for (int row = blocks.head[column * cells + n]; row != Rows::end;) {
            const int following = rows.next[row];
            add_particle<S, nodes>(rows, walker, row, sum + n);
            row = following;
          }
        }
      }
      const Places places = places_of(column, walker.lane);
#pragma unroll
      for (int across = 0; across < rows_of_slab; across++) {
#pragma unroll 1
        for (int lane = 0; lane < S::support; lane++) {
          const bool adds = walks && walker.lane == lane;
          if (adds) add_to_nodes<cells>(places.near[across], sum + across * nodes);
          __syncthreads();
          if (adds && places.far[across] >= 0) add_to_nodes<Order>(places.far[across], sum + across * nodes + cells);
          __syncthreads();
        }
      }
    }
  }

  // With a thread for each cell and leading node, for scenes that have no more of these than threads.
  __device__ void walk_cells() const {
    const int n = threadIdx.x % cells;
    const Walker<S> walker(threadIdx.x / cells);
    const bool walks = walker.list < state.columns;
    const int column = walks ? columns[walker.list] : 0;
    T sum[S::slab][S::channels] = {};
    if (walks) {
#pragma unroll 1
      for (int row = blocks.head[column * cells + n]; row != Rows::end;) {
        const int following = rows.next[row];
        add_particle(rows, walker, row, sum);
        row = following;
      }
    }
    const Places places = places_of(column, walker.lane);
#pragma unroll
    for (int across = 0; across < rows_of_slab; across++) {
      T near[1][S::channels], far[1][S::channels];
      exchange(n, sum + across * S::support, near[0], far[0]);
#pragma unroll 1
      for (int lane = 0; lane < S::support; lane++) {
        const bool adds = walks && walker.lane == lane;
        if (adds) add_to_nodes<1>(places.near[across] + n, near);
        __syncthreads();
        if (adds && n < Order && places.far[across] >= 0) add_to_nodes<1>(places.far[across] + n, far);
        __syncthreads();
      }
    }
  }

  __device__ void walk() const {
    if (state.columns * S::support * cells <= int(blockDim.x))
      walk_cells();
    else
      walk_columns();
  }

  // Returns, to all threads, whether a node meets several surfaces; it has its velocity before contact then, and is
  // added to those of its thread.
  template <bool Obstacles>
  __device__ bool update_nodes(KeptTouches<T, D>& touches, SeveralNodes& several) const {
#pragma unroll 1
    for (int i = threadIdx.x, turn = 0; i < state.blocks * count; i += blockDim.x, turn++) {
      const int slot = i / count, local = i % count;
      NodeRow<T, D>& node = reinterpret_cast<NodeRow<T, D>*>(blocks.node)[i];
      blocks.head[i] = Rows::end;
      if (node.mass == T(0)) {
        node = {T(0), zero_vector<T, D>()};
        continue;
      }
      const SlotUpdate<T, D> there = slot_update(update, slot);
      NodeRow<T, D> row = update_node(update, there, local, node);
      if constexpr (Obstacles) {
        const auto find = [&] { return lone_touch(contact, there.scene, there.corner, local); };
        const NodeTouch<T, D> touch = touches.get(turn, find);
        if (touch.obstacle == touch.several) several.add(turn);
        if (touch.obstacle >= 0) row.value = touch.after(row.value);
      }
      node = row;
    }
    if constexpr (Obstacles) return __syncthreads_or(several.any());
    __syncthreads();
    return false;
  }

  // Inputs of G2P for the particles of the first round, loaded while the nodes are updated.
  __device__ typename Task::Loaded load_first() const { return task.load(first_particle(), scene); }

  __device__ void move_particles(typename Task::Loaded loaded) const {
    constexpr bool quads = D == 3 && sizeof(T) == 4;
    const NodeField<const T> velocity{blocks.node + 1, 1 + D, D};
    int following = first_particle();
#pragma unroll 1
    for (int k = threadIdx.x; k < particles(); k += blockDim.x) {
      const int p = following;
      following = particle_after(k);
      if (k >= int(blockDim.x)) loaded = task.load(p, scene);
      GridSupport<T, Task::K, D, quads> support{velocity};
      T f[D];
      if (!locate<Order>(geometry(), loaded.x.e, support.base, f)) {
        task.skip(p);
        continue;
      }
      const int slot = table[block_of(support.base)];
#pragma unroll
      for (int o = 0; o < 1 << D; o++) support.set_slot(o, blocks.neighbour[(slot << D) + o]);
      touch(task.write(p, loaded, task.compute(loaded, Weights<Order, T, D>(f), support)));
    }
    __syncthreads();
  }
};

// All substeps of particles outside the grid, which do not move.
template <class Source, class Task>
__device__ void skip_tail(const Source& source, const Task& task, int64_t steps) {
  const auto& t = source.topology;
  for (int64_t i = t.offsets[t.max_blocks] + threadIdx.x; i < t.particles; i += blockDim.x) {
    for (int64_t step = 0; step < steps; step++) source.skip(t.index[i]), task.skip(t.index[i]);
  }
}

template <class T, int D>
__device__ void move_clock(const BlockPerSceneArguments<T, D>& a, int scene, int64_t steps) {
  if (threadIdx.x > 0 || !a.scene_time) return;
  for (int64_t step = 0; step < steps; step++) a.scene_time[scene] += a.dt * double(a.scene_dt[scene]);
}

// First slot whose block is at or after a given one; unused slots come last.
template <class T, int D>
__device__ int first_slot(const Topology<T, D>& t, int block) {
  int begin = 0, end = t.max_blocks;
  while (begin < end) {
    const int middle = (begin + end) / 2;
    if (unsigned(t.block[middle]) < unsigned(block))
      begin = middle + 1;
    else
      end = middle;
  }
  return begin;
}

// Bytes of an array of SharedParticles, and of their columns.
template <class S>
MPM_HD int64_t bytes_of_particles(int64_t particles) {
  return (particles + 63) / 64 * 64 * (S::row_bytes + int64_t(sizeof(int)));
}

// Bytes of the table, with a bit for each block.
MPM_HD int64_t bytes_of_table(int64_t blocks) {
  return (blocks + (blocks + 31) / 32 + 3) / 4 * 4 * int64_t(sizeof(int));
}

// Computes the substeps of a scene from `step` on; returns the next one, which is not the end only for lack of shared
// memory.
template <bool Obstacles, class Step>
__device__ __forceinline__ int64_t run_scene(Step& s, int64_t step) {
  using T = typename Step::T;
  constexpr int D = Step::D;
  KeptTouches<T, D> touches(Obstacles && obstacles_rest(s.contact, s.scene));
  s.touch_all();
  __syncthreads();
#pragma unroll 1
  for (; step < s.a.steps; step++) {
    if (s.state.grown) touches.forget();
    if (!s.make_room(step)) return step;
    s.load_particles();
    __syncthreads();
    s.report_errors(step);
    s.list_columns();
    s.walk();
    auto loaded = s.load_first();
    SeveralNodes several;
    if (s.template update_nodes<Obstacles>(touches, several)) {
      add_contact(s.update, s.contact, several, reinterpret_cast<NodeRow<T, D>*>(s.blocks.node),
                  s.state.blocks * Step::count);
      __syncthreads();
      loaded = s.load_first();
    }
    s.move_particles(loaded);
    if (threadIdx.x == 0) s.contact.time += s.a.dt, s.contact.row += s.contact.step_stride;
    move_clock(s.a, s.scene, 1);
    __syncthreads();
  }
  return step;
}

// One thread block per scene, and one for particles outside. `shared` are the bytes of dynamic shared memory.
template <bool Obstacles, class Source, class Task, class T, int D>
__global__ void __launch_bounds__(kMostSceneThreads, 1)
    block_per_scene_kernel(const __grid_constant__ Source source, const __grid_constant__ Task task,
                           const __grid_constant__ BlockPerSceneArguments<T, D> a, int shared) {
  using S = SceneShape<typename Source::Shape>;
  using Blocks = SceneBlocks<T, D>;
  using Rows = SharedParticles<S>;
  extern __shared__ __align__(16) char memory[];
  __shared__ SceneState state;
  __shared__ alignas(16) char update_memory[sizeof(GridUpdateArguments<T, D>)];
  __shared__ alignas(16) char contact_memory[sizeof(ContactArguments<T, D>)];
  const int scene = blockIdx.x;
  if (scene == a.scenes) return skip_tail(source, task, a.steps);
  auto& update = *reinterpret_cast<GridUpdateArguments<T, D>*>(update_memory);
  auto& contact = *reinterpret_cast<ContactArguments<T, D>*>(contact_memory);
  const Topology<T, D>& t = source.topology;
  const int per_scene = t.geometry.blocks_per_scene;
  if (threadIdx.x == 0) {
    state = {};
    state.begin = t.offsets[first_slot(t, scene * per_scene)];
    state.end = t.offsets[first_slot(t, (scene + 1) * per_scene)];
    update = a.update;
    contact = a.contact;
    contact.time = a.time;
  }
  int* const table = reinterpret_cast<int*>(memory);
  unsigned* const wanted = reinterpret_cast<unsigned*>(table + per_scene);
  for (int b = threadIdx.x; b < per_scene; b += blockDim.x) table[b] = -1;
  for (int b = threadIdx.x; b < (per_scene + 31) / 32; b += blockDim.x) wanted[b] = 0;
  __syncthreads();
  const int particles = state.end - state.begin;
  if (particles == 0) return move_clock(a, scene, a.steps);
  const int64_t table_bytes = bytes_of_table(per_scene), row_bytes = bytes_of_particles<S>(particles);
  const int64_t left = shared - table_bytes;
  const bool fits = row_bytes + int64_t(Blocks::bytes) <= left;
  const int batch = (particles + 63) / 64 * 64;
  const auto columns_in = [&](char* rows) { return reinterpret_cast<int*>(rows + size_t(batch) * S::row_bytes); };
  const int room = int((left - (fits ? row_bytes : 0)) / int64_t(Blocks::bytes));
  int64_t step = 0;
  if (fits) {
    char* const rows = memory + table_bytes;
    SceneStep<Source, Task, false> s{source,
                                     task,
                                     a,
                                     scene,
                                     state,
                                     table,
                                     wanted,
                                     Rows(rows, nullptr, batch),
                                     columns_in(rows),
                                     Blocks(rows + row_bytes, room),
                                     update,
                                     contact};
    step = run_scene<Obstacles>(s, 0);
  }
  if (step == a.steps) return;
  const int64_t before = (state.begin + int64_t(64) * scene) * (S::row_bytes + int64_t(sizeof(int))) / 16 * 16;
  char* const rows = a.rows + before;
  SceneStep<Source, Task, true> s{source,
                                  task,
                                  a,
                                  scene,
                                  state,
                                  table,
                                  wanted,
                                  Rows(rows, nullptr, batch),
                                  columns_in(rows),
                                  Blocks(memory + table_bytes, int(left / int64_t(Blocks::bytes))),
                                  update,
                                  contact};
  step = run_scene<Obstacles>(s, step);
  move_clock(a, scene, a.steps - step);
}

// Few scenes have a multiprocessor each; of many, as many as fit share one.
template <class Source, class Task, class T, int D>
void launch_block_per_scene(const Source& source, const Task& task, const BlockPerSceneArguments<T, D>& a,
                            Stream stream) {
  using S = SceneShape<typename Source::Shape>;
  static_assert(S::row_bytes + sizeof(int) <= kMostSceneRow && int64_t(SceneBlocks<T, D>::bytes) <= kMostSceneBlock);
  if (source.topology.particles == 0 || a.scenes == 0) return;
  const int most = device_attribute(cudaDevAttrMaxSharedMemoryPerBlockOptin) - 4096;
  const int all = device_attribute(cudaDevAttrMaxSharedMemoryPerMultiprocessor);
  const int processors = device_attribute(cudaDevAttrMultiProcessorCount);
  const int64_t particles = (source.topology.particles + a.scenes - 1) / a.scenes;
  // A pool that has grown has half as many blocks more than were needed.
  const int64_t blocks = std::min<int64_t>(a.update.geometry.blocks_per_scene,
                                           3 * int64_t(source.topology.max_blocks) / (4 * a.scenes) + 2);
  const int64_t wanted =
      bytes_of_table(a.update.geometry.blocks_per_scene) + bytes_of_particles<S>(particles + particles / 16) +
      blocks * int64_t(SceneBlocks<T, D>::bytes) + 5 * 1024;  // and the static shared memory of the kernel
  // The order of sums depends on the number of threads, which is fixed for deterministic scenes.
  const bool in_order = a.p2g.deterministic;
  const int64_t beside = std::min<int64_t>({all / wanted, (a.scenes + processors - 1) / processors, in_order ? 1 : 4});
  const int together = int(std::max<int64_t>(beside, 1));
  const int shared = std::min(most, all / together - 5 * 1024);
  // Alone on its multiprocessor, a scene of a few particles is faster with all threads, for the nodes.
  const int64_t useful = together == 1 ? kMostSceneThreads : std::max<int64_t>(128, (particles + 31) / 32 * 32);
  const int threads =
      in_order ? kMostSceneThreads : int(std::min<int64_t>(kMostSceneThreads / together / 32 * 32, useful));
  const auto kernel = a.obstacles ? block_per_scene_kernel<true, Source, Task, T, D>
                                  : block_per_scene_kernel<false, Source, Task, T, D>;
  launch(kernel, unsigned(a.scenes + 1), unsigned(threads), size_t(shared), stream, source, task, a, shared);
}

}  // namespace mpm::cuda
