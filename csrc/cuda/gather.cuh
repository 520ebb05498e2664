#pragma once

#include "cuda/launch.cuh"
#include "cuda/launchers.h"
#include "cuda/momentum.cuh"

// G2P, gather, and the two adjoints that read nodes. One thread block loads the nodes of an item's home into shared memory;
// each thread then takes a particle and sums over its support one axis at a time.
namespace mpm::cuda {

// K node channels, padded so that one load fetches them.
template <class T, int K>
struct alignas(K == 1 ? sizeof(T) : K == 2 ? 2 * sizeof(T) : 16) NodeValue {
  T e[K == 3 ? 4 : K];
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

template <class S, int Axis, class T>
__device__ void sum_axis(const NodeValue<T, S::K>* tile, const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K],
                         const T (&linear)[S::K][S::D], Sums<S>& out);

template <class S, int Axis, int Node, class T>
__device__ void sum_node(const NodeValue<T, S::K>* tile, const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K],
                         const T (&linear)[S::K][S::D], Sums<S>& out) {
  constexpr bool first = Node == 0, differentiable = S::Slope != Form::none;
  constexpr int width = Tile<S::Order, S::D>::width;
  constexpr int stride = Axis == S::D - 1 ? 1 : (Axis == S::D - 2 ? width : width * width);
  T below[S::K];
#pragma unroll
  for (int c = 0; c < S::K; c++)
    below[c] = S::Slope == Form::affine ? constant[c] + linear[c][Axis] * w.distance[Axis][Node] : constant[c];
  Sums<S> in;
  sum_axis<S, Axis + 1>(tile + Node * stride, w, below, linear, in);
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
  if constexpr (Node < S::Order) sum_node<S, Axis, Node + 1>(tile, w, constant, linear, out);
}

// Sums over the axes from `Axis` on.
template <class S, int Axis, class T>
__device__ void sum_axis(const NodeValue<T, S::K>* tile, const Weights<S::Order, T, S::D>& w, const T (&constant)[S::K],
                         const T (&linear)[S::K][S::D], Sums<S>& out) {
  if constexpr (Axis == S::D) {
    const NodeValue<T, S::K> node = *tile;
#pragma unroll
    for (int c = 0; c < S::K; c++) {
      out.value[c] = node.e[c];
      if (S::Slope != Form::none) {
        const T part = constant[c] * node.e[c];
        out.potential = c == 0 ? part : out.potential + part;
      }
    }
  } else {
    sum_node<S, Axis, 0>(tile, w, constant, linear, out);
  }
}

// slope_i += Σ_j ∂_i ∂_j N (Σ_c g_c gradient_cj): the derivative of the gradient term.
template <class S, class T>
__device__ void add_hessian(const NodeValue<T, S::K>* tile, const Weights<S::Order, T, S::D>& w,
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
    sum_axis<H, 0>(tile, v, constant, gradient, sums);
#pragma unroll
    for (int i = 0; i < S::D; i++) slope[i] += sums.slope[i];
  }
}

// ---- Tiles

// How a node is fetched at once: from `shift` words before its first channel, or channel by channel (shift < 0).
template <int K, class T>
int vector_shift(const NodeField<const T>& n) {
  if (n.stride % 4 != 0) return -1;
  const auto aligned = [&](int shift) { return reinterpret_cast<uintptr_t>(n.pointer - shift) % (4 * sizeof(T)) == 0; };
  if (K == 4 && aligned(0)) return 0;
  // A velocity that lies behind the mass: its row starts one word earlier, in the same aligned quadruple.
  if (K == 3 && aligned(1)) return 1;
  return -1;
}

template <class T, int K>
__device__ NodeValue<T, K> load_node(const NodeField<const T>& nodes, int64_t row, int vector_shift) {
  NodeValue<T, K> v{};
  const T* const from = nodes.pointer + row * nodes.stride;
  if (K >= 3 && vector_shift >= 0) {
    const NodeValue<T, 4> quad = *reinterpret_cast<const NodeValue<T, 4>*>(from - vector_shift);
#pragma unroll
    for (int c = 0; c < K; c++) v.e[c] = quad.e[K == 3 ? c + 1 : c];
    return v;
  }
#pragma unroll
  for (int c = 0; c < K; c++) v.e[c] = from[c];
  return v;
}

constexpr int kGatherThreads = 128;

// Task: topology(), position(), nodes(); load(p, scene), what it needs of a particle; compute(loaded, weights, tile), what a
// particle gets, with the tile at the base node of the particle; write(p, result), by value zero for particles outside.
template <class Task>
__global__ void __launch_bounds__(kGatherThreads) gather_kernel(const Task task, int vector_shift) {
  using T = typename Task::T;
  constexpr int D = Task::D, K = Task::K;
  using Nodes = Tile<Task::Order, D>;
  __shared__ NodeValue<T, K> tile[Nodes::nodes];
  __shared__ int slots[1 << D];
  const Topology<T, D>& t = task.topology();
  const int items = t.schedule[0];
  for (int i = blockIdx.x; i < items; i += gridDim.x) {
    const Item item = item_at(t, i);
    const Home<D> home = home_of(t, item);
    // Positions are loaded one round ahead and their particles' indices two, so that loads overlap.
    int k = item.begin + threadIdx.x;
    const auto particle_at = [&](int k) { return k < item.end ? t.index[k] : t.index[item.begin]; };
    int64_t p = particle_at(k), p_next = particle_at(k + kGatherThreads);
    Vector<T, D> x = read_vector<T, D>(task.position(), p);
    __syncthreads();  // the tile before is done
    load_slots(t, home, slots);
    __syncthreads();
    for (int n = threadIdx.x; n < Nodes::nodes; n += kGatherThreads) {
      int node[D];
      Nodes::node(n, node);
      const int64_t row = node_row<D>(slots, node);
      tile[n] = row < 0 ? NodeValue<T, K>{} : load_node<T, K>(task.nodes(), row, vector_shift);
    }
    __syncthreads();
#pragma unroll 1
    for (; k < item.end; k += kGatherThreads) {
      const auto loaded = task.load(p, home.scene);
      const Vector<T, D> x_next = read_vector<T, D>(task.position(), p_next);
      const int64_t p_after = particle_at(k + 2 * kGatherThreads);
      int base[D], corner = 0;
      T f[D];
      const bool at_home = locate_at_home<Task::Order>(t, home, x, base, f);
#pragma unroll
      for (int i = 0; i < D; i++) corner = corner * Nodes::width + base[i];
      const auto result = task.compute(loaded, Weights<Task::Order, T, D>(f), tile + corner);
      task.write(p, at_home ? result : typename Task::Result{});
      p = p_next;
      p_next = p_after;
      x = x_next;
    }
  }
  const int64_t stride = int64_t(gridDim.x) * kGatherThreads;
  for (int64_t k = t.offsets[t.capacity] + int64_t(blockIdx.x) * kGatherThreads + threadIdx.x; k < t.particles; k += stride)
    task.write(t.index[k], typename Task::Result{});
}

template <class Task>
void launch_gather(const Task& task, Stream stream) {
  const auto& t = task.topology();
  if (t.particles == 0) return;
  launch(gather_kernel<Task>, grid_size(std::max<int64_t>(most_items(t.capacity, t.particles), 1)), kGatherThreads, 0, stream,
         task, vector_shift<Task::K>(task.nodes()));
}

// ---- Gather

template <int Order_, class T_, int D_, int K_, bool Gradient>
struct FieldGather {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_;
  using Shape = SumShape<Order, T, D, K, 0, true, Gradient, Form::none>;
  struct Loaded {};
  using Result = Sums<Shape>;
  GatherArguments<T, D> a;
  T moment_scale;  // from moments per cell

  __host__ __device__ const Topology<T, D>& topology() const { return a.topology; }
  __host__ __device__ const NodeField<const T>& nodes() const { return a.nodes; }
  __device__ const Field<const T>& position() const { return a.x; }
  __device__ Loaded load(int64_t, int) const { return {}; }
  __device__ Result compute(Loaded, const Weights<Order, T, D>& w, const NodeValue<T, K>* tile) const {
    const T constant[K] = {}, linear[K][D] = {};
    Result s;
    sum_axis<Shape, 0>(tile, w, constant, linear, s);
    return s;
  }
  __device__ void write(int64_t p, const Result& s) const {
#pragma unroll
    for (int k = 0; k < K; k++) {
      cuda::write(a.value, s.value[k], p, k);
#pragma unroll
      for (int i = 0; i < D; i++) {
        cuda::write(a.moment, moment_scale * s.moment[k][i], p, k, i);
        if (Gradient) cuda::write(a.gradient, a.topology.geometry.inverse_dx * s.gradient[k][i], p, k, i);
      }
    }
  }
};

template <int Order, int K, class T, int D>
void gather_channels(GatherArguments<T, D> a, int first, Stream stream) {
  a.nodes.pointer += first;
  a.value = channels_from(a.value, first);
  a.moment = channels_from(a.moment, first);
  a.gradient = channels_from(a.gradient, first);
  const T moment_scale = T(a.moment_scale * double(a.topology.geometry.dx));
  if (a.gradient.pointer)
    launch_gather(FieldGather<Order, T, D, K, true>{a, moment_scale}, stream);
  else
    launch_gather(FieldGather<Order, T, D, K, false>{a, moment_scale}, stream);
}

template <int Order, class T, int D>
void gather(const GatherArguments<T, D>& a, Stream stream) {
  int first = 0;
  for (; first + D <= a.nodes.channels; first += D) gather_channels<Order, D>(a, first, stream);
  for (; first < a.nodes.channels; first++) gather_channels<Order, 1>(a, first, stream);
}

// ---- Position gradient

template <int Order_, class T_, int D_, int K_, bool Gradient>
struct FieldPositionGradient {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_;
  using Shape = SumShape<Order, T, D, K, K, false, false, Form::affine>;
  struct Loaded {
    T value[K], moment[K][D], gradient[K][D];  // moments and gradients per cell
  };
  using Result = Vector<T, D>;
  PositionGradientArguments<T, D> a;
  T moment_scale;  // to moments per cell
  bool more;       // adds to the channels before

  __host__ __device__ const Topology<T, D>& topology() const { return a.topology; }
  __host__ __device__ const NodeField<const T>& nodes() const { return a.nodes; }
  __device__ const Field<const T>& position() const { return a.x; }
  __device__ Loaded load(int64_t p, int) const {
    Loaded l;
#pragma unroll
    for (int k = 0; k < K; k++) {
      l.value[k] = read(a.value, p, k);
#pragma unroll
      for (int i = 0; i < D; i++) {
        l.moment[k][i] = a.moment.pointer ? moment_scale * read(a.moment, p, k, i) : T(0);
        l.gradient[k][i] = Gradient ? a.topology.geometry.inverse_dx * read(a.gradient, p, k, i) : T(0);
      }
    }
    return l;
  }
  __device__ Result compute(const Loaded& l, const Weights<Order, T, D>& w, const NodeValue<T, K>* tile) const {
    Sums<Shape> s;
    sum_axis<Shape, 0>(tile, w, l.value, l.moment, s);
    if (Gradient) add_hessian<Shape>(tile, w, l.gradient, s.slope);
    Result r;
#pragma unroll
    for (int i = 0; i < D; i++) {
#pragma unroll
      for (int k = 0; k < K; k++) s.slope[i] -= l.moment[k][i] * s.value[k];
      r[i] = a.topology.geometry.inverse_dx * s.slope[i];
    }
    return r;
  }
  __device__ void write(int64_t p, const Result& r) const {
#pragma unroll
    for (int i = 0; i < D; i++) {
      T& out = a.position_gradient.pointer[p * a.position_gradient.stride[0] + i * a.position_gradient.stride[1]];
      out = more ? out + r[i] : r[i];
    }
  }
};

template <int Order, int K, class T, int D>
void position_gradient_channels(PositionGradientArguments<T, D> a, int first, Stream stream) {
  a.nodes.pointer += first;
  a.value = channels_from(a.value, first);
  a.moment = channels_from(a.moment, first);
  a.gradient = channels_from(a.gradient, first);
  const T moment_scale = T(a.moment_scale * double(a.topology.geometry.dx));
  if (a.gradient.pointer)
    launch_gather(FieldPositionGradient<Order, T, D, K, true>{a, moment_scale, first > 0}, stream);
  else
    launch_gather(FieldPositionGradient<Order, T, D, K, false>{a, moment_scale, first > 0}, stream);
}

template <int Order, class T, int D>
void position_gradient(const PositionGradientArguments<T, D>& a, Stream stream) {
  int first = 0;
  for (; first + D <= a.nodes.channels; first += D) position_gradient_channels<Order, D>(a, first, stream);
  for (; first < a.nodes.channels; first++) position_gradient_channels<Order, 1>(a, first, stream);
}

// ---- Adjoint of P2G

template <int Order_, class T_, int D_, bool Gradient>
struct MomentumAdjoint {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = 1 + D;
  using Shape = SumShape<Order, T, D, K, 1, true, Gradient, Form::affine>;
  using Loaded = ParticleMomentum<T, D>;
  struct Result {
    Vector<T, D> x;
    ParticleMomentum<T, D> particle;
  };
  P2GBackwardArguments<T, D> a;

  __host__ __device__ const Topology<T, D>& topology() const { return a.forward.topology; }
  __host__ __device__ const NodeField<const T>& nodes() const { return a.grad_nodes; }
  __device__ const Field<const T>& position() const { return a.forward.x; }
  __device__ Loaded load(int64_t p, int scene) const { return read_momentum(a.forward, p, scene); }
  __device__ Result compute(const Loaded& particle, const Weights<Order, T, D>& w, const NodeValue<T, K>* tile) const {
    const Geometry<T, D>& g = a.forward.topology.geometry;
    const NodeMomentum<T, D> m = node_momentum<Order>(a.forward, particle);
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
    sum_axis<Shape, 0>(tile, w, value, moment, s);
    if (Gradient) add_hessian<Shape>(tile, w, gradient, s.slope);
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
    for (int j = 0; j < D; j++) r.x[j] = g.inverse_dx * s.slope[j];
    r.particle = adjoint<Order>(particle, sums, a.forward.form, a.forward.affine.pointer != nullptr,
                                a.forward.stress.pointer != nullptr, g.dx, g.inverse_dx);
    return r;
  }
  __device__ void write(int64_t p, const Result& r) const {
    cuda::write(a.mass, r.particle.mass, p);
    cuda::write(a.volume, r.particle.volume, p);
    cuda::write(a.dt, r.particle.dt, p);
#pragma unroll
    for (int i = 0; i < D; i++) {
      cuda::write(a.x, r.x[i], p, i);
      cuda::write(a.velocity, r.particle.velocity[i], p, i);
#pragma unroll
      for (int j = 0; j < D; j++) {
        cuda::write(a.affine, r.particle.affine[i][j], p, i, j);
        cuda::write(a.stress, r.particle.stress[i][j], p, i, j);
      }
    }
  }
};

template <int Order, class T, int D>
void p2g_backward(const P2GBackwardArguments<T, D>& a, Stream stream) {
  if (has_gradient(a.forward))
    launch_gather(MomentumAdjoint<Order, T, D, true>{a}, stream);
  else
    launch_gather(MomentumAdjoint<Order, T, D, false>{a}, stream);
}

#define INSTANTIATE_GATHER(Order, T, D)                                                \
  template void gather<Order, T, D>(const GatherArguments<T, D>&, Stream);             \
  template void p2g_backward<Order, T, D>(const P2GBackwardArguments<T, D>&, Stream); \
  template void position_gradient<Order, T, D>(const PositionGradientArguments<T, D>&, Stream);

}  // namespace mpm::cuda
