#pragma once

#include "cuda/launch.cuh"
#include "cuda/launchers.h"
#include "cuda/momentum.cuh"

// G2P, gather, and the two adjoints that read nodes. A thread takes a particle and sums over its support one axis at a
// time. Particles come in one of two orders, which `activate` chooses: item by item, with the nodes of the home block
// in shared memory; or, when neighbours in memory are no neighbours in space, in the order of memory, so that at least
// the particle fields are read and written at full width.
namespace mpm::cuda {

template <class T>
struct alignas(16) Quad {
  T e[4];
};

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

// Which sums over the nodes are wanted, with N a weight, r a distance, g a node value:
//   value     Σ N g
//   moment    Σ N g r, and
//   gradient  Σ ∇N g, both without the first `Plain` channels
//   slope     Σ ∇N Σ_c g_c (a_c + B_c · r), B being absent (None, Constant) or not (Affine)
enum class Form { none, constant, affine };

template <int Order_, class T_, int D_, int K_, int Plain_, bool Moment_, bool Gradient_, Form Slope_>
struct SumShape {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_, Plain = Plain_;
  static constexpr bool Moment = Moment_, Gradient = Gradient_;
  static constexpr Form Slope = Slope_;
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

// For each of the blocks that are left when the leading axes are decided, the row that the base node would have if the
// nodes went on beyond the block; a node of the support is a constant distance further.
template <int Blocks>
struct Rows {
  int row[Blocks];
};

// Whether nodes are fetched as one aligned quadruple: four channels, or a velocity that lies behind the mass.
template <int K, class T>
bool is_vector(const NodeField<const T>& n) {
  const auto aligned = [&](int shift) { return reinterpret_cast<uintptr_t>(n.pointer - shift) % (4 * sizeof(T)) == 0; };
  return n.stride == 4 && ((K == 4 && aligned(0)) || (K == 3 && aligned(1)));
}

template <bool Quads, int K, class T>
__device__ void load_node(const NodeField<const T>& nodes, int row, int offset, T (&node)[K]) {
  if constexpr (Quads) {
    const Quad<T> quad = *reinterpret_cast<const Quad<T>*>(nodes.pointer + int64_t(row) * 4 + offset * 4 - (K == 3));
#pragma unroll
    for (int c = 0; c < K; c++) node[c] = quad.e[K == 3 ? c + 1 : c];
  } else {
    const T* const from = nodes.pointer + int64_t(row + offset) * int(nodes.stride);
#pragma unroll
    for (int c = 0; c < K; c++) node[c] = from[c];
  }
}

// Nodes in global memory, in the home block and the blocks after it.
template <class T, int K, int D, bool Quads>
struct GridSupport {
  static constexpr int blocks = 1 << D, width = kBlockWidth;
  const NodeField<const T>& nodes;
  int base[D];  // base node in the home block
  Rows<blocks> rows;

  __device__ void set_slot(int block, int slot) {
    int row = slot * kBlockNodes<D> + node_in_block<D>(base);
#pragma unroll
    for (int i = 0, step = 1; i < D; i++, step *= kBlockWidth) row -= (block >> i & 1) * kBlockWidth * step;
    rows.row[block] = row;
  }
  __device__ bool is_far(int axis, int node) const { return node > 0 && base[axis] + node >= kBlockWidth; }
  __device__ void load(int row, int offset, T (&node)[K]) const { load_node<Quads>(nodes, row, offset, node); }
};

// K node channels in shared memory, padded so that one load fetches them.
template <class T, int K>
struct alignas(K == 1   ? sizeof(T)
               : K == 2 ? 2 * sizeof(T)
                        : 16) NodeValue {
  T e[K == 3 ? 4 : K];
};

// Nodes in shared memory: those of the home block and the next Order along each axis.
template <int Order, class T, int K>
struct TileSupport {
  static constexpr int blocks = 1, width = kBlockWidth + Order;
  const NodeValue<T, K>* corner;  // the base node
  Rows<1> rows;

  __device__ bool is_far(int, int) const { return false; }
  __device__ void load(int, int offset, T (&node)[K]) const {
    const NodeValue<T, K> v = corner[offset];
#pragma unroll
    for (int c = 0; c < K; c++) node[c] = v.e[c];
  }
};

template <class S, int Axis, int Blocks, class Support, class T>
__device__ void sum_axis(const Support& support, const Rows<Blocks>& rows, int offset,
                         const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K], const T (&linear)[S::K][S::D],
                         Sums<S>& out);

template <class S, int Axis, int Node, int Blocks, class Support, class T>
__device__ void sum_node(const Support& support, const Rows<Blocks>& rows, int offset,
                         const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K], const T (&linear)[S::K][S::D],
                         Sums<S>& out) {
  constexpr bool first = Node == 0, differentiable = S::Slope != Form::none;
  constexpr int half = Blocks > 1 ? Blocks / 2 : 1;
  const bool far = support.is_far(Axis, Node);
  Rows<half> side;
#pragma unroll
  for (int o = 0; o < half; o++) side.row[o] = far ? rows.row[Blocks - half + o] : rows.row[o];
  T below[S::K];
#pragma unroll
  for (int c = 0; c < S::K; c++)
    below[c] = S::Slope == Form::affine ? constant[c] + linear[c][Axis] * w.distance[Axis][Node] : constant[c];
  Sums<S> in;
  sum_axis<S, Axis + 1>(support, side, offset * Support::width + Node, w, below, linear, in);
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
__device__ void sum_axis(const Support& support, const Rows<Blocks>& rows, int offset,
                         const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K], const T (&linear)[S::K][S::D],
                         Sums<S>& out) {
  if constexpr (Axis == S::D) {
    T node[S::K];
    support.load(rows.row[0], offset, node);
#pragma unroll
    for (int c = 0; c < S::K; c++) {
      out.value[c] = node[c];
      if (S::Slope != Form::none) {
        const T part = constant[c] * node[c];
        out.potential = c == 0 ? part : out.potential + part;
      }
    }
  } else {
    sum_node<S, Axis, 0>(support, rows, offset, w, constant, linear, out);
  }
}

// slope_i += Σ_j ∂_i ∂_j N (Σ_c g_c gradient_cj): the derivative of the gradient term.
template <class S, class Support, class T>
__device__ void add_hessian(const Support& support, const Weights<S::Order, T, S::D>& w,
                            const T (&gradient)[S::K][S::D], T (&slope)[S::D]) {
  using H = SumShape<S::Order, T, S::D, S::K, S::K, false, false, Form::constant>;
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

// ---- The two orders

constexpr int kGatherThreads = 128;

// Thread blocks to fit in a multiprocessor at once, which limits registers: measured for float and quadratic weights.
template <class Task>
constexpr int kResident = Task::Order == 2 && sizeof(typename Task::T) == 4 ? Task::resident : 2;

// Task: topology, nodes, position; load(p, scene), what it needs of a particle; compute(loaded, weights, support), what
// the particle gets; write(p, loaded, result), with a result of zeros where positions are not those of the activation;
// leave_out(p) for a particle outside.
template <bool Quads, class Task>
__device__ void gather_in_memory_order(const Task& task, const Schedule<const int>& schedule) {
  using T = typename Task::T;
  constexpr int D = Task::D;
  const Topology<T, D>& t = task.topology;
  const int64_t stride = int64_t(gridDim.x) * kGatherThreads;
#pragma unroll 1
  for (int64_t i = int64_t(blockIdx.x) * kGatherThreads + threadIdx.x; i < t.particles; i += stride) {
    const int p = int(i), slot = schedule.home[p];
    const Vector<T, D> x = read_vector(task.position, p);
    const int home = slot < 0 ? -1 : t.block[slot], scene = scene_of(t, home);
    GridSupport<T, Task::K, D, Quads> support{task.nodes};
    T f[D];
    if (slot < 0 || !locate_at_home<Task::Order>(t, scene, home, x, support.base, f)) {
      task.leave_out(p);
      continue;
    }
    const auto loaded = task.load(p, scene);
#pragma unroll
    for (int q = 0; q < (1 << D) / 4; q++) {
      const int4 v = reinterpret_cast<const int4*>(schedule.neighbours + (slot << D))[q];
      support.set_slot(4 * q, v.x);
      support.set_slot(4 * q + 1, v.y);
      support.set_slot(4 * q + 2, v.z);
      support.set_slot(4 * q + 3, v.w);
    }
    task.write(p, loaded, task.compute(loaded, Weights<Task::Order, T, D>(f), support));
  }
}

template <bool Quads, int Order, class T, int K, int D>
__device__ void load_tile(const NodeField<const T>& nodes, const int* slots, NodeValue<T, K>* tile) {
  constexpr int width = kBlockWidth + Order, size = D == 2 ? width * width : width * width * width;
  for (int i = threadIdx.x; i < size; i += kGatherThreads) {
    int node[D], neighbour = 0;
#pragma unroll
    for (int axis = D - 1, rest = i; axis >= 0; axis--) {
      node[axis] = rest % width;
      neighbour |= (node[axis] >= kBlockWidth) << (D - 1 - axis);
      rest /= width;
    }
    T value[K] = {};
    if (slots[neighbour] >= 0)
      load_node<Quads>(nodes, slots[neighbour] * kBlockNodes<D> + node_in_block<D>(node), 0, value);
    NodeValue<T, K> v{};
#pragma unroll
    for (int c = 0; c < K; c++) v.e[c] = value[c];
    tile[i] = v;
  }
}

template <bool Quads, class Task>
__device__ void gather_by_items(const Task& task, const Schedule<const int>& schedule) {
  using T = typename Task::T;
  constexpr int D = Task::D, K = Task::K, width = kBlockWidth + Task::Order;
  __shared__ NodeValue<T, K> tile[D == 2 ? width * width : width * width * width];
  __shared__ int slots[1 << D];
  const Topology<T, D>& t = task.topology;
  const int items = *schedule.item_count;
  for (int i = blockIdx.x; i < items; i += gridDim.x) {
    const int4 item = reinterpret_cast<const int4*>(schedule.items)[i];
    const int begin = item.y, end = item.z, home = item.w, scene = scene_of(t, home);
    // Positions are loaded one round ahead and the particles' indices two, so that loads overlap.
    int k = begin + threadIdx.x;
    const auto particle_at = [&](int k) { return t.index[k < end ? k : begin]; };
    int p = particle_at(k), p_next = particle_at(k + kGatherThreads);
    Vector<T, D> x = read_vector(task.position, p);
    __syncthreads();  // the tile before is done
    if (threadIdx.x < 1 << D) slots[threadIdx.x] = schedule.neighbours[(item.x << D) + threadIdx.x];
    __syncthreads();
    load_tile<Quads, Task::Order, T, K, D>(task.nodes, slots, tile);
    __syncthreads();
#pragma unroll 1
    for (; k < end; k += kGatherThreads) {
      const auto loaded = task.load(p, scene);
      const Vector<T, D> x_next = read_vector(task.position, p_next);
      const int p_after = particle_at(k + 2 * kGatherThreads);
      int base[D], corner = 0;
      T f[D];
      const bool at_home = locate_at_home<Task::Order>(t, scene, home, x, base, f);
#pragma unroll
      for (int axis = 0; axis < D; axis++) corner = corner * width + base[axis];
      const TileSupport<Task::Order, T, K> support{tile + corner};
      const auto result = task.compute(loaded, Weights<Task::Order, T, D>(f), support);
      task.write(p, loaded, at_home ? result : typename Task::Result{});
      p = p_next;
      p_next = p_after;
      x = x_next;
    }
  }
  const int64_t stride = int64_t(gridDim.x) * kGatherThreads;
  for (int64_t i = t.offsets[t.capacity] + int64_t(blockIdx.x) * kGatherThreads + threadIdx.x; i < t.particles;
       i += stride)
    task.leave_out(t.index[i]);
}

template <bool Quads, class Task>
__global__ void __launch_bounds__(kGatherThreads, kResident<Task>) gather_kernel(const Task task) {
  const Schedule<const int> schedule = schedule_of(task.topology);
  if (*schedule.scattered)
    gather_in_memory_order<Quads>(task, schedule);
  else
    gather_by_items<Quads>(task, schedule);
}

template <class Task>
void launch_gather(const Task& task, Stream stream) {
  const int64_t particles = task.topology.particles;
  if (particles == 0) return;
  const int64_t pieces = std::max(most_items(task.topology.capacity, particles), particles / kGatherThreads);
  if constexpr (Task::K == 3 || Task::K == 4) {
    if (is_vector<Task::K>(task.nodes))
      return launch(gather_kernel<true, Task>, grid_size(pieces), kGatherThreads, 0, stream, task);
  }
  launch(gather_kernel<false, Task>, grid_size(pieces), kGatherThreads, 0, stream, task);
}

// The channels [first, ...) of a node field.
template <class T>
NodeField<const T> nodes_from(NodeField<const T> n, int first) {
  n.pointer += first;
  return n;
}

// ---- Gather

template <int Order_, class T_, int D_, int K_, bool Gradient>
struct FieldGather {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_;
  static constexpr int resident = Gradient ? 5 : 6;
  using Shape = SumShape<Order, T, D, K, 0, true, Gradient, Form::none>;
  struct Loaded {};
  using Result = Sums<Shape>;
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  Columns<T, K> value;
  Columns<T, K * D> moment, gradient;
  T moment_scale, gradient_scale;  // from cells
  T lost;

  FieldGather(const GatherArguments<T, D>& a, int first)
      : topology(a.topology),
        nodes(nodes_from(a.nodes, first)),
        position(a.x),
        value(channels_from(a.value, first)),
        moment(channels_from(a.moment, first), D),
        gradient(channels_from(a.gradient, first), D),
        moment_scale(T(a.moment_scale * double(a.topology.geometry.dx))),
        gradient_scale(a.topology.geometry.inverse_dx),
        lost(T(a.lost)) {}

  __device__ Loaded load(int, int) const { return {}; }
  template <class Support>
  __device__ Result compute(Loaded, const Weights<Order, T, D>& w, const Support& support) const {
    const T constant[K] = {}, linear[K][D] = {};
    Result s;
    sum_axis<Shape, 0>(support, support.rows, 0, w, constant, linear, s);
    return s;
  }
  __device__ void write(int p, const Loaded&, const Result& s) const {
#pragma unroll
    for (int k = 0; k < K; k++) {
      value.write(p, k, s.value[k]);
#pragma unroll
      for (int i = 0; i < D; i++) {
        moment.write(p, k * D + i, moment_scale * s.moment[k][i]);
        if (Gradient) gradient.write(p, k * D + i, gradient_scale * s.gradient[k][i]);
      }
    }
  }
  __device__ void leave_out(int p) const {
    const T nothing = is_finite<D>(read_vector(position, p).e) ? T(0) : lost;
#pragma unroll
    for (int k = 0; k < K; k++) value.write(p, k, nothing);
#pragma unroll
    for (int k = 0; k < K * D; k++) {
      moment.write(p, k, nothing);
      gradient.write(p, k, nothing);
    }
  }
};

template <int Order, class T, int D>
void gather(const GatherArguments<T, D>& a, Stream stream) {
  for_channels<D>(a.nodes.channels, a.gradient.pointer, [&]<int K, bool Gradient>(int first) {
    launch_gather(FieldGather<Order, T, D, K, Gradient>(a, first), stream);
  });
}

// ---- Position gradient

template <int Order_, class T_, int D_, int K_, bool Gradient>
struct FieldPositionGradient {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_;
  static constexpr int resident = Gradient ? 3 : 5;
  using Shape = SumShape<Order, T, D, K, K, false, false, Form::affine>;
  struct Loaded {
    T value[K], moment[K][D], gradient[K][D];  // moments and gradients per cell
  };
  using Result = mpm::Vector<T, D>;
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  Columns<const T, K> value;
  Columns<const T, K * D> moment, gradient;
  Columns<T, D> out;
  T moment_scale, inverse_dx;
  bool more;  // adds to the channels before

  FieldPositionGradient(const PositionGradientArguments<T, D>& a, int first)
      : topology(a.topology),
        nodes(nodes_from(a.nodes, first)),
        position(a.x),
        value(channels_from(a.value, first)),
        moment(channels_from(a.moment, first), D),
        gradient(channels_from(a.gradient, first), D),
        out(a.position_gradient),
        moment_scale(T(a.moment_scale * double(a.topology.geometry.dx))),
        inverse_dx(a.topology.geometry.inverse_dx),
        more(first > 0) {}

  __device__ Loaded load(int p, int) const {
    Loaded l;
#pragma unroll
    for (int k = 0; k < K; k++) {
      l.value[k] = value.at(p, k);
#pragma unroll
      for (int i = 0; i < D; i++) {
        l.moment[k][i] = moment.present() ? moment_scale * moment.at(p, k * D + i) : T(0);
        l.gradient[k][i] = Gradient ? inverse_dx * gradient.at(p, k * D + i) : T(0);
      }
    }
    return l;
  }
  template <class Support>
  __device__ Result compute(const Loaded& l, const Weights<Order, T, D>& w, const Support& support) const {
    Sums<Shape> s;
    sum_axis<Shape, 0>(support, support.rows, 0, w, l.value, l.moment, s);
    if (Gradient) add_hessian<Shape>(support, w, l.gradient, s.slope);
    Result r;
#pragma unroll
    for (int i = 0; i < D; i++) {
#pragma unroll
      for (int k = 0; k < K; k++) s.slope[i] -= l.moment[k][i] * s.value[k];
      r[i] = inverse_dx * s.slope[i];
    }
    return r;
  }
  __device__ void write(int p, const Loaded&, const Result& r) const {
#pragma unroll
    for (int i = 0; i < D; i++) out.at(p, i) = more ? out.at(p, i) + r[i] : r[i];
  }
  __device__ void leave_out(int p) const { write(p, {}, {}); }
};

template <int Order, class T, int D>
void position_gradient(const PositionGradientArguments<T, D>& a, Stream stream) {
  for_channels<D>(a.nodes.channels, a.gradient.pointer, [&]<int K, bool Gradient>(int first) {
    launch_gather(FieldPositionGradient<Order, T, D, K, Gradient>(a, first), stream);
  });
}

// ---- Adjoint of P2G

template <int Order_, class T_, int D_, bool Gradient>
struct MomentumAdjoint {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = 1 + D;
  static constexpr int resident = Gradient ? 2 : 4;
  using Shape = SumShape<Order, T, D, K, 1, true, Gradient, Form::affine>;
  using Loaded = ParticleMomentum<T, D>;
  struct Result {
    mpm::Vector<T, D> x;
    ParticleMomentum<T, D> particle;
  };
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  MomentumFields<Order, T, D> fields;
  Columns<T, 1> mass, volume, dt;
  Columns<T, D> x, velocity;
  Columns<T, D * D> affine, stress;

  explicit MomentumAdjoint(const P2GBackwardArguments<T, D>& a)
      : topology(a.forward.topology),
        nodes(a.grad_nodes),
        position(a.forward.x),
        fields(a.forward),
        mass(a.mass),
        volume(a.volume),
        dt(a.dt),
        x(a.x),
        velocity(a.velocity),
        affine(a.affine, D),
        stress(a.stress, D) {}

  __device__ Loaded load(int p, int scene) const { return fields.read(p, scene, fields.stress.present()); }
  template <class Support>
  __device__ Result compute(const Loaded& particle, const Weights<Order, T, D>& w, const Support& support) const {
    const NodeMomentum<T, D> m = fields.to_nodes(particle, fields.form, fields.stress.present());
    T value[K], moment[K][D], gradient[K][D];
    value[0] = m.mass;
#pragma unroll
    for (int i = 0; i < D; i++) {
      value[1 + i] = m.momentum[i];
      moment[0][i] = gradient[0][i] = T(0);
#pragma unroll
      for (int j = 0; j < D; j++) {
        moment[1 + i][j] = m.moment[i][j];
        gradient[1 + i][j] = m.gradient[i][j];
      }
    }
    Sums<Shape> s;
    sum_axis<Shape, 0>(support, support.rows, 0, w, value, moment, s);
    if (Gradient) add_hessian<Shape>(support, w, gradient, s.slope);
    Result r;
    NodeMomentum<T, D> sums;
    sums.mass = s.value[0];
#pragma unroll
    for (int i = 0; i < D; i++) {
      sums.momentum[i] = s.value[1 + i];
#pragma unroll
      for (int j = 0; j < D; j++) {
        s.slope[j] -= moment[1 + i][j] * s.value[1 + i];
        sums.moment[i][j] = s.moment[1 + i][j];
        sums.gradient[i][j] = Gradient ? s.gradient[1 + i][j] : T(0);
      }
    }
#pragma unroll
    for (int j = 0; j < D; j++) r.x[j] = fields.inverse_dx * s.slope[j];
    r.particle = fields.adjoint(particle, sums);
    return r;
  }
  __device__ void write(int p, const Loaded&, const Result& r) const {
    mass.write(p, 0, r.particle.mass);
    volume.write(p, 0, r.particle.volume);
    dt.write(p, 0, r.particle.dt);
#pragma unroll
    for (int i = 0; i < D; i++) {
      x.write(p, i, r.x[i]);
      velocity.write(p, i, r.particle.velocity[i]);
#pragma unroll
      for (int j = 0; j < D; j++) {
        affine.write(p, i * D + j, r.particle.affine[i][j]);
        stress.write(p, i * D + j, r.particle.stress[i][j]);
      }
    }
  }
  __device__ void leave_out(int p) const { write(p, {}, {}); }
};

template <int Order, class T, int D>
void p2g_backward(const P2GBackwardArguments<T, D>& a, Stream stream) {
  if (has_gradient(a.forward))
    launch_gather(MomentumAdjoint<Order, T, D, true>(a), stream);
  else
    launch_gather(MomentumAdjoint<Order, T, D, false>(a), stream);
}

#define INSTANTIATE_GATHER(Order, T, D)                                               \
  template void gather<Order, T, D>(const GatherArguments<T, D>&, Stream);            \
  template void p2g_backward<Order, T, D>(const P2GBackwardArguments<T, D>&, Stream); \
  template void position_gradient<Order, T, D>(const PositionGradientArguments<T, D>&, Stream);

}  // namespace mpm::cuda
