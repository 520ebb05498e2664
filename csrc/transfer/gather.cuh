#pragma once

#include "cuda/programmatic_launch.cuh"
#include "cuda/vec4.cuh"
#include "transfer/momentum.cuh"

// G2P, gather, and the two adjoints that read nodes. A thread processes one particle and sums over its support one axis
// at a time. The order of particles is one of two, chosen by `activate`: item by item, with the nodes of the base block
// in shared memory; or, when neighbours in memory are not neighbours in space, in memory order, so that at least the
// particle fields are read and written at full width.
namespace mpm::cuda {

// Weights of the nodes of the support, their derivatives per cell, and the distances of the nodes in cells.
template <int Order, class T, int D>
struct Weights {
  static constexpr int support = Order + 1;
  T weight[D][support], first[D][support], second[D][support], distance[D][support];

  __device__ explicit Weights(const T* f) {
#pragma unroll
    for (int i = 0; i < D; i++) {
      BSpline<Order>::weights(f[i], weight[i]);
      BSpline<Order>::first_derivatives(f[i], first[i]);
      BSpline<Order>::second_derivatives(f[i], second[i]);
#pragma unroll
      for (int k = 0; k < support; k++) distance[i][k] = T(k) - f[i];
    }
  }
};

// Requested sums over the nodes, with N a weight, r a distance, g a node value:
//   value     Σ N g
//   moment    Σ N g r, and
//   gradient  Σ ∇N g, both without the first `Plain` channels
//   slope     Σ ∇N Σ_c g_c (a_c + B_c · r), B being absent (None, Constant) or not (Affine)
enum class SlopeForm { none, constant, affine };

template <int Order_, class T_, int D_, int K_, int Plain_, bool Moment_, bool Gradient_, SlopeForm Slope_>
struct SumShape {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_, Plain = Plain_;
  static constexpr bool Moment = Moment_, Gradient = Gradient_;
  static constexpr SlopeForm Slope = Slope_;
};

template <class S>
struct Sums {
  using T = typename S::T;
  T value[S::K], moment[S::K][S::D], gradient[S::K][S::D];
  T potential, slope[S::D];
};

template <bool First, class T>
__device__ void accumulate(T& sum, T weight, T value) {
  sum = First ? weight * value : sum + weight * value;
}

// For each of the remaining blocks after the leading axes are fixed: the row that the base node would have if the nodes
// continued beyond the block; a node of the support is a constant distance further.
template <int Blocks>
struct BlockRows {
  int row[Blocks];
};

// Whether nodes are loaded as one aligned quadruple: four channels, or a velocity that follows the mass.
template <int K, class T>
bool is_vector(const NodeField<const T>& n) {
  const auto aligned = [&](int shift) { return reinterpret_cast<uintptr_t>(n.pointer - shift) % (4 * sizeof(T)) == 0; };
  return n.stride == 4 && ((K == 4 && aligned(0)) || (K == 3 && aligned(1)));
}

template <bool Quads, int K, class T>
__device__ void load_node(const NodeField<const T>& nodes, int row, int offset, T (&node)[K]) {
  if constexpr (Quads) {
    const Vec4<T> quad = load_vec4(nodes.pointer + int64_t(row) * 4 + offset * 4 - (K == 3));
#pragma unroll
    for (int c = 0; c < K; c++) node[c] = quad.e[K == 3 ? c + 1 : c];
  } else {
    const T* const from = nodes.pointer + int64_t(row + offset) * int(nodes.stride);
#pragma unroll
    for (int c = 0; c < K; c++) node[c] = from[c];
  }
}

// Nodes between a node and the next one along an axis that is followed by `axes` axes, in a cube.
constexpr int step_in_cube(int width, int axes) { return axes > 0 ? width * step_in_cube(width, axes - 1) : 1; }

// Nodes in global memory, in the base block and the blocks after it.
template <class T, int K, int D, bool Quads>
struct GridSupport {
  static constexpr int blocks = 1 << D;
  const NodeField<const T>& nodes;
  int base[D];  // base node in the base block
  BlockRows<blocks> rows;

  __device__ void set_slot(int block, int slot) {
    int row = slot * kBlockNodes<D> + node_in_block<D>(base);
#pragma unroll
    for (int i = 0, step = 1; i < D; i++, step *= kBlockWidth) row -= (block >> i & 1) * kBlockWidth * step;
    rows.row[block] = row;
  }
  template <class Other>
  __device__ void copy_places(const Other& support) {
    rows = support.rows;
#pragma unroll
    for (int i = 0; i < D; i++) base[i] = support.base[i];
  }
  static constexpr int step(int axes_after) { return step_in_cube(kBlockWidth, axes_after); }
  __device__ bool is_far(int axis, int node) const { return node > 0 && base[axis] + node >= kBlockWidth; }
  __device__ void load(int row, int offset, T (&node)[K]) const { load_node<Quads>(nodes, row, offset, node); }
};

// K node channels in shared memory, padded so that one load reads them.
template <class T, int K>
struct alignas(K == 1   ? sizeof(T)
               : K == 2 ? 2 * sizeof(T)
                        : 16) NodeValue {
  T e[K == 3 ? 4 : K];
};

// Nodes in shared memory: those of the base block and the next Order along each axis, or a cube of another width.
template <int Order, class T, int K, int Width = kBlockWidth + Order>
struct TileSupport {
  static constexpr int blocks = 1, width = Width;
  const NodeValue<T, K>* corner;  // the base node
  BlockRows<1> rows;

  static constexpr int step(int axes_after) { return step_in_cube(width, axes_after); }
  __device__ bool is_far(int, int) const { return false; }
  __device__ void load(int, int offset, T (&node)[K]) const {
    const NodeValue<T, K> v = corner[offset];
#pragma unroll
    for (int c = 0; c < K; c++) node[c] = v.e[c];
  }
};

template <class S, int Axis, int Blocks, class Support, class T>
__device__ void sum_axis(const Support& support, const BlockRows<Blocks>& rows, int offset,
                         const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K], const T (&linear)[S::K][S::D],
                         Sums<S>& out);

template <class S, int Axis, int Node, int Blocks, class Support, class T>
__device__ void sum_node(const Support& support, const BlockRows<Blocks>& rows, int offset,
                         const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K], const T (&linear)[S::K][S::D],
                         Sums<S>& out) {
  constexpr bool first = Node == 0, differentiable = S::Slope != SlopeForm::none;
  constexpr int half = Blocks > 1 ? Blocks / 2 : 1;
  const bool far = support.is_far(Axis, Node);
  BlockRows<half> side;
#pragma unroll
  for (int o = 0; o < half; o++) side.row[o] = far ? rows.row[Blocks - half + o] : rows.row[o];
  T below[S::K];
#pragma unroll
  for (int c = 0; c < S::K; c++)
    below[c] = S::Slope == SlopeForm::affine ? constant[c] + linear[c][Axis] * w.distance[Axis][Node] : constant[c];
  Sums<S> in;
  sum_axis<S, Axis + 1>(support, side, offset + Node * Support::step(S::D - 1 - Axis), w, below, linear, in);
  const T n = w.weight[Axis][Node], dn = w.first[Axis][Node];
#pragma unroll
  for (int c = 0; c < S::K; c++) {
    accumulate<first>(out.value[c], n, in.value[c]);
    if (c < S::Plain) continue;
    if (S::Moment) accumulate<first>(out.moment[c][Axis], n * w.distance[Axis][Node], in.value[c]);
    if (S::Gradient) accumulate<first>(out.gradient[c][Axis], dn, in.value[c]);
#pragma unroll
    for (int i = Axis + 1; i < S::D; i++) {
      if (S::Moment) accumulate<first>(out.moment[c][i], n, in.moment[c][i]);
      if (S::Gradient) accumulate<first>(out.gradient[c][i], n, in.gradient[c][i]);
    }
  }
  if (differentiable) {
    if (Axis > 0) accumulate<first>(out.potential, n, in.potential);
    accumulate<first>(out.slope[Axis], dn, in.potential);
#pragma unroll
    for (int i = Axis + 1; i < S::D; i++) accumulate<first>(out.slope[i], n, in.slope[i]);
  }
  if constexpr (Node < S::Order) sum_node<S, Axis, Node + 1>(support, rows, offset, w, constant, linear, out);
}

// Sums over the axes from `Axis` on.
template <class S, int Axis, int Blocks, class Support, class T>
__device__ void sum_axis(const Support& support, const BlockRows<Blocks>& rows, int offset,
                         const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K], const T (&linear)[S::K][S::D],
                         Sums<S>& out) {
  if constexpr (Axis == S::D) {
    T node[S::K];
    support.load(rows.row[0], offset, node);
#pragma unroll
    for (int c = 0; c < S::K; c++) {
      out.value[c] = node[c];
      if (S::Slope != SlopeForm::none) {
        const T part = constant[c] * node[c];
        out.potential = c == 0 ? part : out.potential + part;
      }
    }
  } else {
    sum_node<S, Axis, 0>(support, rows, offset, w, constant, linear, out);
  }
}

// Sums without slopes.
template <class S, class Support, class T>
__device__ Sums<S> sum_support(const Support& support, const Weights<S::Order, T, S::D>& w) {
  static_assert(S::Slope == SlopeForm::none);
  const T constant[S::K] = {}, linear[S::K][S::D] = {};
  Sums<S> sums;
  sum_axis<S, 0>(support, support.rows, 0, w, constant, linear, sums);
  return sums;
}

// slope_i += Σ_j ∂_i ∂_j N (Σ_c g_c gradient_cj): the derivative of the gradient term.
template <class S, class Support, class T>
__device__ void add_hessian(const Support& support, const Weights<S::Order, T, S::D>& w,
                            const T (&gradient)[S::K][S::D], T (&slope)[S::D]) {
  using H = SumShape<S::Order, T, S::D, S::K, S::K, false, false, SlopeForm::constant>;
#pragma unroll
  for (int j = 0; j < S::D; j++) {
    Weights<S::Order, T, S::D> v = w;
    T constant[S::K];
#pragma unroll
    for (int k = 0; k <= S::Order; k++) {
      v.weight[j][k] = w.first[j][k];
      v.first[j][k] = w.second[j][k];
    }
#pragma unroll
    for (int c = 0; c < S::K; c++) constant[c] = gradient[c][j];
    Sums<H> sums;
    sum_axis<H, 0>(support, support.rows, 0, v, constant, gradient, sums);
#pragma unroll
    for (int i = 0; i < S::D; i++) slope[i] += sums.slope[i];
  }
}

// Between two sums over a support: the second one loads the nodes once more. Otherwise the compiler would store all of
// them in registers, which are too few.
__device__ inline void forget_nodes() { asm volatile("" ::: "memory"); }

// Position gradient of Σ_i g_i · N_i (value + moment · r) + gradient · ∇N_i in cells, for a form with S::SlopeForm
// affine.
template <class S, bool Gradient, class Support, class T>
__device__ void position_slope(const Support& support, const Weights<S::Order, T, S::D>& w, const T (&value)[S::K],
                               const T (&moment)[S::K][S::D], const T (&gradient)[S::K][S::D], Sums<S>& s) {
  sum_axis<S, 0>(support, support.rows, 0, w, value, moment, s);
  if (Gradient) add_hessian<S>(support, w, gradient, s.slope);
#pragma unroll
  for (int k = 0; k < S::K; k++)
#pragma unroll
    for (int i = 0; i < S::D; i++) s.slope[i] -= moment[k][i] * s.value[k];
}

// ---- The two orders

// Threads of a block. In 2-D a base block mostly has 64 particles, four a cell.
constexpr int kMostGatherThreads = 128;
template <int D>
constexpr int kGatherThreads = D == 2 ? 64 : kMostGatherThreads;

// Number of thread blocks that should fit in a multiprocessor at once, which limits registers: measured for float and
// quadratic weights with the threads of a block in 3-D.
template <class Task>
constexpr int kResident = (Task::Order == 2 && sizeof(typename Task::T) == 4 ? Task::resident : 2) *
                          (kMostGatherThreads / kGatherThreads<Task::D>);

// Counts of particle places by the threads of whole warps; `lost` are bits of Drift::Loss.
__device__ inline void add_to_displacement(Displacement* displacement, int out_of_block, int lost) {
  const int all = __reduce_add_sync(~0u, out_of_block);
  if (all > 0 && threadIdx.x % 32 == 0) atomicAdd(&displacement->out_of_block, all);
  if (lost) atomicOr(&displacement->lost, lost);
}

// Whether particles that move may stay in their activation for another step.
template <int Order, class T, int D>
class Follower {
 public:
  // Move to x from a base block whose active neighbours are the bits of `active`.
  __device__ void follow(const Topology<T, D>& t, const BaseBlock<T, D>& home, unsigned active, const Vector<T, D>& x) {
    bool inside = true;
    unsigned touched = 1;  // same order as touched_blocks()
#pragma unroll
    for (int i = D - 1; i >= 0; i--) {
      const T node = base_node<Order>(t.geometry, i, x[i]);
      inside = inside && node >= home.first[i] && node < home.end[i];  // false for NaN
      if (node >= home.first[i] + T(kBlockWidth - Order)) touched |= touched << (1 << (D - 1 - i));
    }
    if (inside)
      lost_ = lost_ || (touched & ~active) != 0;
    else
      leave(t, home.scene, x);
  }

  __device__ void flush_counters(Displacement* displacement) const {
    add_to_displacement(displacement, out_of_block_, lost_ ? Displacement::kLost : 0);
  }

  // Bits of the active neighbours of a slot.
  __device__ static unsigned active_blocks(const Topology<T, D>& t, int slot) {
    const int4* const neighbours = reinterpret_cast<const int4*>(schedule_of(t).neighbours + (slot << D));
    unsigned active = 0;
#pragma unroll
    for (int q = 0; q < (1 << D) / 4; q++) {
      const int4 v = neighbours[q];
      active |= unsigned(v.x >= 0) << (4 * q) | unsigned(v.y >= 0) << (4 * q + 1) | unsigned(v.z >= 0) << (4 * q + 2) |
                unsigned(v.w >= 0) << (4 * q + 3);
    }
    return active;
  }

 private:
  __device__ void leave(const Topology<T, D>& t, int scene, const Vector<T, D>& x) {
    int base[D];
    T f[D];
    const int slot = locate_slot<Order>(t, scene, x, base, f);
    out_of_block_++;
    lost_ = lost_ || slot < 0 || (touched_blocks<Order, D>(base) & ~active_blocks(t, slot)) != 0;
  }

  int out_of_block_ = 0;
  bool lost_ = false;
};

// Task: topology, nodes, position; load(p, scene), inputs of a particle; compute(loaded, weights, support), its result;
// write(p, loaded, result), with a result of zeros where positions are not those of the activation; skip(p) for a
// particle outside. Particles may be displaced, that is, in active blocks other than those of the activation. If there
// are counters of the displacement, write(...) returns the new place of the particle, which is followed. With `Others`,
// that many channels of the nodes `others` have a separate support, the last argument of compute(...). If it has a test
// whether an activation is due, particles are in the order of items, except for one activation. If it may load ahead,
// it states whether the previous kernel writes only nodes.
template <class Task>
constexpr bool may_be_displaced = requires { requires Task::displaced; };
template <class Task>
constexpr bool is_followed = may_be_displaced<Task> && requires(const Task& task) { task.displacement; };
template <class Task>
constexpr int kOthers = 0;
template <class Task>
  requires requires { Task::Others; }
constexpr int kOthers<Task> = Task::Others;
template <class Task>
constexpr bool may_load_ahead =
    requires(const Task& task) { task.loads_ahead; } && !requires(const Task& task) { task.is_due(); };
template <class Task>
__device__ bool loads_ahead(const Task& task) {
  if constexpr (may_load_ahead<Task>) return task.loads_ahead;
  return false;
}
template <class Task>
using FollowerOf = Follower<Task::Order, typename Task::T, Task::D>;

// From the nodes in global memory, for a particle with its base node in a slot.
template <bool Quads, class Task, class T>
__device__ auto gather_from_grid(const Task& task, const Schedule<const int>& schedule, int p, int scene, int slot,
                                 GridSupport<T, Task::K, Task::D, Quads>& support, const T* f) {
  constexpr int D = Task::D;
  const auto loaded = task.load(p, scene);
#pragma unroll
  for (int q = 0; q < (1 << D) / 4; q++) {
    const int4 v = reinterpret_cast<const int4*>(schedule.neighbours + (slot << D))[q];
    support.set_slot(4 * q, v.x);
    support.set_slot(4 * q + 1, v.y);
    support.set_slot(4 * q + 2, v.z);
    support.set_slot(4 * q + 3, v.w);
  }
  const Weights<Task::Order, T, D> weights(f);
  if constexpr (kOthers<Task> > 0) {
    GridSupport<T, kOthers<Task>, D, Quads> others{task.others};
    others.copy_places(support);
    return task.write(p, loaded, task.compute(loaded, weights, support, others));
  } else {
    return task.write(p, loaded, task.compute(loaded, weights, support));
  }
}

template <bool Quads, class Task>
__device__ void gather_in_memory_order(const Task& task, const Schedule<const int>& schedule,
                                       FollowerOf<Task>& follower) {
  using T = typename Task::T;
  constexpr int D = Task::D;
  const Topology<T, D>& t = task.topology;
  grid_dependency_sync();
  const int64_t stride = int64_t(gridDim.x) * kGatherThreads<D>;
#pragma unroll 1
  for (int64_t i = int64_t(blockIdx.x) * kGatherThreads<D> + threadIdx.x; i < t.particles; i += stride) {
    const int p = int(i);
    int slot = schedule.base_slot[p];
    const Vector<T, D> x = read_vector(task.position, p);
    const int base_block = slot < 0 ? -1 : t.block[slot], scene = scene_of(t, base_block);
    GridSupport<T, Task::K, D, Quads> support{task.nodes};
    T f[D];
    if (slot >= 0 && !locate_in_block<Task::Order>(t, scene, base_block, x, support.base, f))
      slot = may_be_displaced<Task> ? locate_slot<Task::Order>(t, scene, x, support.base, f) : -1;
    if (slot < 0) {
      task.skip(p);
      continue;
    }
    if constexpr (is_followed<Task>) {
      const Vector<T, D> to = gather_from_grid<Quads>(task, schedule, p, scene, slot, support, f);
      BaseBlock<T, D> home;
      home.template set<Task::Order>(t, base_block);
      follower.follow(t, home, FollowerOf<Task>::active_blocks(t, schedule.base_slot[p]), to);
    } else {
      gather_from_grid<Quads>(task, schedule, p, scene, slot, support, f);
    }
  }
}

// Channels of a node, counted from the first one of a base block; `slots` are those of the block and its neighbours.
// Zero where a block is not active.
template <bool Quads, int K, class T, int D>
__device__ NodeValue<T, K> load_near(const NodeField<const T>& nodes, const int* slots, const int (&node)[D]) {
  const int slot = slots[neighbour_with(node)];
  T value[K] = {};
  if (slot >= 0) load_node<Quads>(nodes, slot * kBlockNodes<D> + node_in_block<D>(node), 0, value);
  NodeValue<T, K> v{};
#pragma unroll
  for (int c = 0; c < K; c++) v.e[c] = value[c];
  return v;
}

template <bool Quads, int Order, class T, int K, int D, int Threads = kGatherThreads<D>>
__device__ void load_tile(const NodeField<const T>& nodes, const int* slots, NodeValue<T, K>* tile) {
  constexpr int width = kBlockWidth + Order, size = D == 2 ? width * width : width * width * width;
  for (int i = threadIdx.x; i < size; i += Threads) {
    int node[D];
    split<width>(i, node);
    tile[i] = load_near<Quads, K>(nodes, slots, node);
  }
}

// Strays of an item, processed after its other particles.
template <bool Quads, class Task, int Most>
__device__ void gather_out_of_block(const Task& task, const Schedule<const int>& schedule,
                                    const OutOfBlockList<Most>& out_of_block, int begin,
                                    const BaseBlock<typename Task::T, Task::D>& home, unsigned active,
                                    FollowerOf<Task>& follower) {
  using T = typename Task::T;
  const Topology<T, Task::D>& t = task.topology;
  __syncthreads();
#pragma unroll 1
  for (int s = threadIdx.x; s < out_of_block.count; s += kGatherThreads<Task::D>) {
    const int p = t.index[begin + out_of_block.particle[s]];
    GridSupport<T, Task::K, Task::D, Quads> support{task.nodes};
    T f[Task::D];
    const int slot = locate_slot<Task::Order>(t, home.scene, read_vector(task.position, p), support.base, f);
    if (slot < 0) {
      task.skip(p);
      continue;
    }
    if constexpr (is_followed<Task>)
      follower.follow(t, home, active, gather_from_grid<Quads>(task, schedule, p, home.scene, slot, support, f));
    else
      gather_from_grid<Quads>(task, schedule, p, home.scene, slot, support, f);
  }
}

template <bool Quads, class Task>
__device__ void gather_by_items(const Task& task, const Schedule<const int>& schedule, FollowerOf<Task>& follower) {
  using T = typename Task::T;
  constexpr int D = Task::D, K = Task::K, others = kOthers<Task>, width = kBlockWidth + Task::Order;
  constexpr int size = D == 2 ? width * width : width * width * width;
  __shared__ OutOfBlockList<may_be_displaced<Task> ? kItemParticles : 1> out_of_block;
  __shared__ BaseBlock<T, D> home;
  __shared__ NodeValue<T, K> tile[size];
  __shared__ NodeValue<T, others ? others : 1> others_tile[others ? size : 1];
  __shared__ int slots[1 << D];
  const Topology<T, D>& t = task.topology;
  const int items = *schedule.item_count;
  for (int i = blockIdx.x; i < items; i += gridDim.x) {
    const int4 item = reinterpret_cast<const int4*>(schedule.items)[i];
    const int begin = item.y, end = item.z, base_block = item.w, scene = scene_of(t, base_block);
    // Positions are loaded one round ahead and the indices of particles two, so that loads overlap.
    int k = begin + threadIdx.x;
    const auto particle_at = [&](int k) { return t.index[k < end ? k : begin]; };
    int p = particle_at(k), p_next = particle_at(k + kGatherThreads<D>);
    Vector<T, D> x = read_vector(task.position, p);
    __syncthreads();  // the previous tile is done
    if (threadIdx.x < 1 << D) slots[threadIdx.x] = schedule.neighbours[(item.x << D) + threadIdx.x];
    if (may_be_displaced<Task> && threadIdx.x == 32) {
      home.template set<Task::Order>(t, base_block);
      out_of_block.count = 0;
    }
    const unsigned active = is_followed<Task> ? FollowerOf<Task>::active_blocks(t, item.x) : 0;
    typename Task::Loaded loaded;
    if constexpr (may_load_ahead<Task>) loaded = task.load(p, scene);
    __syncthreads();
    grid_dependency_sync();
    load_tile<Quads, Task::Order, T, K, D>(task.nodes, slots, tile);
    if constexpr (others > 0) load_tile<Quads, Task::Order, T, others, D>(task.others, slots, others_tile);
    __syncthreads();
#pragma unroll 1
    for (const int first = k; k < end; k += kGatherThreads<D>) {
      if (!may_load_ahead<Task> || k != first) loaded = task.load(p, scene);
      const Vector<T, D> x_next = read_vector(task.position, p_next);
      const int p_after = particle_at(k + 2 * kGatherThreads<D>);
      int base[D], corner = 0;
      T f[D];
      const bool in_block = locate_in_block<Task::Order>(t, scene, base_block, x, base, f);
#pragma unroll
      for (int axis = 0; axis < D; axis++) corner = corner * width + base[axis];
      const TileSupport<Task::Order, T, K> support{tile + corner};
      const Weights<Task::Order, T, D> weights(f);
      const auto result = [&] {
        if constexpr (others > 0)
          return task.compute(loaded, weights, support, TileSupport<Task::Order, T, others>{others_tile + corner});
        else
          return task.compute(loaded, weights, support);
      }();
      if constexpr (!may_be_displaced<Task>) {
        task.write(p, loaded, in_block ? result : typename Task::Result{});
      } else if (in_block) {
        if constexpr (is_followed<Task>)
          follower.follow(t, home, active, task.write(p, loaded, result));
        else
          task.write(p, loaded, result);
      } else {
        out_of_block.particle[atomicAdd(&out_of_block.count, 1)] = uint16_t(k - begin);
      }
      p = p_next;
      p_next = p_after;
      x = x_next;
    }
    if constexpr (may_be_displaced<Task>)
      gather_out_of_block<Quads>(task, schedule, out_of_block, begin, home, active, follower);
  }
  grid_dependency_sync();
  const int64_t stride = int64_t(gridDim.x) * kGatherThreads<D>;
  for (int64_t i = t.offsets[t.max_blocks] + int64_t(blockIdx.x) * kGatherThreads<D> + threadIdx.x; i < t.particles;
       i += stride)
    task.skip(t.index[i]);
}

template <bool Quads, class Task>
__global__ void __launch_bounds__(kGatherThreads<Task::D>, kResident<Task>) gather_kernel(const Task task) {
  if (!loads_ahead(task)) grid_dependency_sync();
  const Schedule<const int> schedule = schedule_of(task.topology);
  FollowerOf<Task> follower;
  if constexpr (requires { task.is_due(); }) {
    if (!task.is_due()) return;
    gather_by_items<Quads>(task, schedule, follower);
  } else if (*schedule.scattered) {
    gather_in_memory_order<Quads>(task, schedule, follower);
  } else {
    gather_by_items<Quads>(task, schedule, follower);
  }
  if constexpr (is_followed<Task>) follower.flush_counters(task.displacement);
}

template <class Task, class Kernel>
void launch_gather(const Task& task, Kernel* kernel, int64_t pieces, Stream stream) {
  launch_in_chain(kernel, grid_size(task, pieces), kGatherThreads<Task::D>, 0, stream, task);
}

template <class Task>
int64_t gather_pieces(const Task& task) {
  const int64_t particles = task.topology.particles;
  return std::max(most_items(task.topology.max_blocks, particles), particles / kGatherThreads<Task::D>);
}

// Of nodes that are loaded as vectors.
template <class Task>
void launch_gather_of_vectors(const Task& task, Stream stream) {
  if (task.topology.particles > 0) launch_gather(task, gather_kernel<true, Task>, gather_pieces(task), stream);
}

template <class Task>
void launch_gather(const Task& task, Stream stream) {
  if (task.topology.particles == 0) return;
  if constexpr (Task::K == 3 || Task::K == 4) {
    bool vectors = is_vector<Task::K>(task.nodes);
    if constexpr (kOthers<Task> > 0) vectors = vectors && is_vector<kOthers<Task>>(task.others);
    if (vectors) return launch_gather_of_vectors(task, stream);
  }
  launch_gather(task, gather_kernel<false, Task>, gather_pieces(task), stream);
}

}  // namespace mpm::cuda
