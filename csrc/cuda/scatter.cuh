#pragma once

#include "cuda/launch.cuh"
#include "cuda/launchers.h"
#include "cuda/momentum.cuh"

// P2G and scatter. One thread block takes the particles of one item, sorts them by cell in shared memory, and adds up
// columns of nodes in registers: each column of cells has one thread per leading node of the support, (Order + 1)^(D -
// 1), which walks the particles of the column's four cells. The columns are then added to a tile of nodes, and the tile
// to the grid: one vector reduction per node, however many particles there are.
//
// A node gets N_i (a + B · i) + G · ∇N_i from a particle, i being the distance from the base node in cells: `Linear`
// channels of this kind after `Plain` ones with B = G = 0. Deterministic mode adds blocks of one colour at a time, no
// two of which share a node, with the particles in the order of the index tensor.
namespace mpm::cuda {

template <class T>
struct alignas(16) Quad {
  T e[4];
};

template <class T, int D, int Plain, int Linear>
struct Contribution {
  T plain[Plain > 0 ? Plain : 1];
  T value[Linear];
  T moment[Linear][D];    // per cell
  T gradient[Linear][D];  // of the gradient per cell
};

template <int Order_, class T_, int D_, int Plain_, int Linear_, bool Gradient_>
struct ScatterShape {
  using T = T_;
  static constexpr int Order = Order_, D = D_, Plain = Plain_, Linear = Linear_;
  static constexpr bool Gradient = Gradient_;
  static constexpr int channels = Plain + Linear, support = Order + 1;
  static constexpr int width =
      kBlockWidth + Order;  // nodes of the tile along an axis, from the first of the home block

  // Threads.
  static constexpr int columns = D == 2 ? 4 : 16, lanes = D == 2 ? support : support * support;
  static constexpr int slices = D == 2 ? 8 : 1;  // threads that share the particles of one cell
  static constexpr int walkers = columns * lanes * slices, threads = (walkers + 31) / 32 * 32;

  // A particle in shared memory: words that all threads of its column read, in quads, and words of which each reads its
  // own.
  static constexpr int derivatives = Gradient ? 2 : 1;
  static constexpr int last_weights = 0, plain = last_weights + derivatives * support, linear = plain + Plain;
  static constexpr int linear_words = 1 + D * derivatives, words = linear + Linear * linear_words;
  static constexpr int quads = (words + 3) / 4, own_words = (D - 1) * support * derivatives;
  static constexpr int row_bytes = (quads * 4 + own_words) * int(sizeof(T)) + 6;
  static constexpr int fitting = 90 * 1024 / row_bytes / 32 * 32;
  static constexpr int batch = fitting < kItemParticles ? fitting : kItemParticles;
  static constexpr int rows =
      batch + batch / 32;  // one row skipped in 32, so that neighbouring columns use other banks

  // Sums of the columns, in the same memory.
  static constexpr int column_stride = width | 1;
  static constexpr int sums = walkers * column_stride;  // per channel

  static constexpr size_t particle_bytes = size_t(rows) * (quads * 4 + own_words) * sizeof(T) + size_t(batch) * 6;
  static constexpr size_t sum_bytes = size_t(channels) * sums * sizeof(T);
  static constexpr size_t shared_bytes = particle_bytes > sum_bytes ? particle_bytes : sum_bytes;
};

template <class S>
struct SharedParticles {
  using T = typename S::T;
  Quad<T>* quads;    // [quads, rows]
  T* own;            // [own_words, rows]
  uint16_t* cell;    // [batch] in the order of the index tensor
  uint16_t* rank;    // [batch] among the particles of its cell
  uint16_t* sorted;  // [batch] row of the particle at each place by cell

  __device__ explicit SharedParticles(char* memory) {
    quads = reinterpret_cast<Quad<T>*>(memory);
    own = reinterpret_cast<T*>(quads + S::quads * S::rows);
    cell = reinterpret_cast<uint16_t*>(own + S::own_words * S::rows);
    rank = cell + S::batch;
    sorted = rank + S::batch;
  }
  __device__ static int row(int t) { return t + t / 32; }
};

template <class S, class T, int D>
__device__ void store_particle(const SharedParticles<S>& shared, int row, const T f[D],
                               const Contribution<T, D, S::Plain, S::Linear>& c) {
  T word[S::quads * 4] = {}, weight[D][S::support], slope[D][S::support];
#pragma unroll
  for (int i = 0; i < D; i++) {
    BSpline<S::Order>::weights(f[i], weight[i]);
    if (S::Gradient) BSpline<S::Order>::first_derivatives(f[i], slope[i]);
  }
#pragma unroll
  for (int k = 0; k < S::support; k++) {
    word[S::last_weights + k] = weight[D - 1][k];
    if (S::Gradient) word[S::last_weights + S::support + k] = slope[D - 1][k];
#pragma unroll
    for (int i = 0; i < D - 1; i++) {
      shared.own[(i * S::support + k) * S::rows + row] = weight[i][k];
      if (S::Gradient) shared.own[((D - 1 + i) * S::support + k) * S::rows + row] = slope[i][k];
    }
  }
#pragma unroll
  for (int k = 0; k < S::Plain; k++) word[S::plain + k] = c.plain[k];
#pragma unroll
  for (int k = 0; k < S::Linear; k++) {
    T* const w = word + S::linear + k * S::linear_words;
    w[0] = c.value[k];
#pragma unroll
    for (int i = 0; i < D; i++) {
      w[0] -= c.moment[k][i] * f[i];
      w[1 + i] = c.moment[k][i];
      if (S::Gradient) w[1 + D + i] = c.gradient[k][i];
    }
  }
#pragma unroll
  for (int q = 0; q < S::quads; q++)
    shared.quads[q * S::rows + row] = {word[4 * q], word[4 * q + 1], word[4 * q + 2], word[4 * q + 3]};
}

// One thread of a column: which of the leading nodes it adds to, and which of the particles it takes.
template <class S>
struct Walker {
  using T = typename S::T;
  int column, slice;
  int leading[2];
  const T* own[S::D - 1];  // its words of the particle in row 0
  bool active;

  __device__ explicit Walker(const SharedParticles<S>& shared) {
    const int lane = threadIdx.x % S::lanes;
    column = threadIdx.x / S::lanes % S::columns;
    slice = threadIdx.x / (S::lanes * S::columns);
    leading[0] = S::D == 2 ? lane : lane / S::support;
    leading[1] = lane % S::support;
    active = threadIdx.x < S::walkers;
#pragma unroll
    for (int i = 0; i < S::D - 1; i++) own[i] = shared.own + (i * S::support + leading[i]) * S::rows;
  }
};

// What one thread adds to the nodes of its column from one particle, whose base node has coordinate Z along the last
// axis.
template <class S, int Z, class T>
__device__ void add_particle(const SharedParticles<S>& shared, const Walker<S>& walker, int row,
                             T (&sum)[S::width][S::channels]) {
  constexpr int D = S::D;
  T word[S::quads * 4];
#pragma unroll
  for (int q = 0; q < S::quads; q++) {
    const Quad<T> v = shared.quads[q * S::rows + row];
#pragma unroll
    for (int e = 0; e < 4; e++) word[4 * q + e] = v.e[e];
  }
  T own[D - 1], slope[D - 1], w = T(1);
#pragma unroll
  for (int i = 0; i < D - 1; i++) {
    own[i] = walker.own[i][row];
    w *= own[i];
    if (S::Gradient) slope[i] = walker.own[i][(D - 1) * S::support * S::rows + row];
  }
  const T* const last = word + S::last_weights;
#pragma unroll
  for (int c = 0; c < S::Plain; c++) {
    const T v = w * word[S::plain + c];
#pragma unroll
    for (int k = 0; k < S::support; k++) sum[Z + k][c] += last[k] * v;
  }
#pragma unroll
  for (int c = 0; c < S::Linear; c++) {
    const T* const v = word + S::linear + c * S::linear_words;
    T at = v[0];
#pragma unroll
    for (int i = 0; i < D - 1; i++) at += v[1 + i] * T(walker.leading[i]);
    at *= w;
    const T step = w * v[D];
    if (S::Gradient) {
#pragma unroll
      for (int i = 0; i < D - 1; i++) {
        T across = slope[i];
#pragma unroll
        for (int j = 0; j < D - 1; j++)
          if (j != i) across *= own[j];
        at += across * v[1 + D + i];
      }
      const T along = w * v[2 * D];
#pragma unroll
      for (int k = 0; k < S::support; k++) sum[Z + k][S::Plain + c] += last[S::support + k] * along;
    }
#pragma unroll
    for (int k = 0; k < S::support; k++) {
      sum[Z + k][S::Plain + c] += last[k] * at;
      at += step;
    }
  }
}

template <class S, int Z, class T>
__device__ void walk_column(const SharedParticles<S>& shared, const Walker<S>& walker, const int* cell_start,
                            T (&sum)[S::width][S::channels]) {
  const int end = cell_start[Z + 1];
#pragma unroll 1
  for (int r = cell_start[Z] + walker.slice; r < end; r += S::slices)
    add_particle<S, Z>(shared, walker, shared.sorted[r], sum);
  if constexpr (Z + 1 < kBlockWidth) walk_column<S, Z + 1>(shared, walker, cell_start, sum);
}

// Ranks in the order of the index tensor; by one warp.
inline __device__ void rank_in_order(const uint16_t* cell, uint16_t* rank, int* count, int n) {
  for (int t = threadIdx.x; t - int(threadIdx.x) < n; t += 32) {
    const int c = t < n ? cell[t] : -1;
    const unsigned group = __match_any_sync(~0u, c);
    const int before = __popc(group & ((1u << threadIdx.x) - 1));
    const int counted = c >= 0 ? count[c] : 0;
    __syncwarp();
    if (c >= 0) {
      rank[t] = uint16_t(counted + before);
      if (before == 0) count[c] = counted + __popc(group);
    }
    __syncwarp();
  }
}

// Counts to exclusive sums, in place; by one warp. The count after the last cell is that of particles not at home.
template <int Cells>
__device__ void starts_from_counts(int* count) {
  constexpr int per_lane = (Cells + 31) / 32;
  const int first = threadIdx.x * per_lane;
  int own[per_lane], total = 0;
#pragma unroll
  for (int k = 0; k < per_lane; k++) {
    own[k] = first + k < Cells ? count[first + k] : 0;
    total += own[k];
  }
  int before = total;
#pragma unroll
  for (int o = 1; o < 32; o *= 2) {
    const int v = __shfl_up_sync(~0u, before, o);
    if (int(threadIdx.x) >= o) before += v;
  }
  const int all = __shfl_sync(~0u, before, 31);
  before -= total;
#pragma unroll
  for (int k = 0; k < per_lane; k++) {
    if (first + k < Cells) count[first + k] = before;
    before += own[k];
  }
  if (threadIdx.x == 0) count[Cells] = all;
}

// Loads the particles index[begin, begin + n) into shared memory and sorts them by cell. `cell_start` holds 4^D + 1
// ints.
template <class S, class Source, class T, int D>
__device__ void load_sorted(const Source& source, const Topology<T, D>& t, int home, const SharedParticles<S>& shared,
                            int* cell_start, int begin, int n, bool in_order) {
  constexpr int cells = kBlockNodes<D>;
  const int scene = scene_of(t, home);
  for (int c = threadIdx.x; c <= cells; c += S::threads) cell_start[c] = 0;
  __syncthreads();
  int next = int(threadIdx.x) < n ? t.index[begin + threadIdx.x] : 0;
#pragma unroll 1
  for (int k = threadIdx.x; k < n; k += S::threads) {
    const int p = next;
    if (k + S::threads < n) next = t.index[begin + k + S::threads];
    int base[D];
    T f[D];
    // Loaded and stored wherever the particle is, so that no load waits for another.
    const Vector<T, D> x = read_vector(source.position, p);
    const auto loaded = source.load(p, scene);
    const bool at_home = locate_at_home<S::Order>(t, scene, home, x, base, f);
    store_particle<S, T, D>(shared, SharedParticles<S>::row(k), f, source.contribution(loaded));
    const int cell = at_home ? node_in_block<D>(base) : cells;
    shared.cell[k] = uint16_t(cell);
    if (!in_order) shared.rank[k] = uint16_t(atomicAdd(&cell_start[cell], 1));
  }
  __syncthreads();
  if (threadIdx.x < 32) {
    if (in_order) rank_in_order(shared.cell, shared.rank, cell_start, n);
    starts_from_counts<cells>(cell_start);
  }
  __syncthreads();
  for (int k = threadIdx.x; k < n; k += S::threads)
    shared.sorted[cell_start[shared.cell[k]] + shared.rank[k]] = uint16_t(SharedParticles<S>::row(k));
  __syncthreads();
}

// One channel of one node of the tile: the sum over the columns that reach it.
template <class S, class T>
__device__ T tile_sum(const T* sums, int channel, const int leading[S::D - 1], int z) {
  constexpr int D = S::D;
  const T* const from = sums + channel * S::sums + z;
  T sum = T(0);
#pragma unroll
  for (int lane = 0; lane < S::lanes; lane++) {
    const int node[2] = {D == 2 ? lane : lane / S::support, lane % S::support};
    int column = 0;
    bool inside = true;
#pragma unroll
    for (int i = 0; i < D - 1; i++) {
      const int cell = leading[i] - node[i];
      inside = inside && unsigned(cell) < unsigned(kBlockWidth);
      column = column * kBlockWidth + cell;
    }
    if (!inside) continue;
#pragma unroll
    for (int slice = 0; slice < S::slices; slice++)
      sum += from[((slice * S::columns + column) * S::lanes + lane) * S::column_stride];
  }
  return sum;
}

template <class T>
__device__ void add_to_nodes(T* to, T value, bool in_order) {
  if (in_order)
    *to += value;
  else
    atomicAdd(to, value);
}

template <class T>
__device__ void add_to_nodes(T* to, const T value[4], bool in_order) {
#if __CUDA_ARCH__ >= 900
  if constexpr (sizeof(T) == 4) {
    if (!in_order) {
      atomicAdd(reinterpret_cast<float4*>(to), make_float4(value[0], value[1], value[2], value[3]));
      return;
    }
  }
#endif
#pragma unroll
  for (int e = 0; e < 4; e++) add_to_nodes(to + e, value[e], in_order);
}

// Adds the tile to the grid, four words at a time. The four nodes of a block along the last axis are contiguous, so
// rows of the tile are, too, whatever the number of channels.
template <class S, class T, int D>
__device__ void flush_tile(const NodeField<T>& nodes, const int slots[1 << D], const T* sums, bool in_order) {
  constexpr int K = S::channels, width = S::width;
  constexpr int near_quads = K, far_quads = (S::Order * K + 3) / 4, quads = near_quads + far_quads;
  constexpr int tile_rows = D == 2 ? width : width * width;
  const bool dense = nodes.stride == K && reinterpret_cast<uintptr_t>(nodes.pointer) % 16 == 0;
  for (int t = threadIdx.x; t < tile_rows * quads; t += S::threads) {
    const int tile_row = t / quads, quad = t % quads, far = quad >= near_quads;
    const int first_word = (far ? quad - near_quads : quad) * 4;
    const int leading[2] = {D == 2 ? tile_row : tile_row / width, tile_row % width};
    int neighbour = 0, node[D] = {};
#pragma unroll
    for (int i = 0; i < D - 1; i++) {
      neighbour = neighbour * 2 + (leading[i] >= kBlockWidth);
      node[i] = leading[i];
    }
    const int slot = slots[neighbour * 2 + far];
    if (slot < 0) continue;
    const int64_t row = int64_t(slot) * kBlockNodes<D> + node_in_block<D>(node);
    T value[4];
    bool any = false;
#pragma unroll
    for (int e = 0; e < 4; e++) {
      const int word = first_word + e, z = far * kBlockWidth + word / K;
      value[e] = z < width ? tile_sum<S>(sums, word % K, leading, z) : T(0);
      any = any || value[e] != T(0);
    }
    if (!any) continue;
    if (dense) {
      add_to_nodes(nodes.pointer + row * K + first_word, value, in_order);
    } else {
#pragma unroll
      for (int e = 0; e < 4; e++) {
        const int word = first_word + e;
        if (value[e] != T(0))
          add_to_nodes(nodes.pointer + (row + word / K) * nodes.stride + word % K, value[e], in_order);
      }
    }
  }
}

template <class T, int D>
__device__ int colour_of(const Topology<T, D>& t, int home) {
  int block[D], colour = 0;
  block_coordinates(t.geometry, home, block);
#pragma unroll
  for (int i = 0; i < D; i++) colour = colour * 2 + (block[i] & 1);
  return colour;
}

// colour < 0: every item, with atomics. Otherwise the homes of that colour, whole, without atomics.
template <class Source>
__global__ void __launch_bounds__(Source::Shape::threads) scatter_kernel(const Source source, int colour) {
  using S = typename Source::Shape;
  using T = typename S::T;
  constexpr int D = S::D;
  extern __shared__ __align__(16) char memory[];
  __shared__ int slots[1 << D], cell_start[kBlockNodes<D> + 1];
  const SharedParticles<S> shared(memory);
  T* const sums = reinterpret_cast<T*>(memory);
  const Topology<T, D>& t = source.topology;
  const Schedule<const int> schedule = schedule_of(t);
  const bool in_order = colour >= 0;
  const Walker<S> walker(shared);
  const int items = *schedule.item_count;
  for (int i = blockIdx.x; i < items; i += gridDim.x) {
    const int4 entries = reinterpret_cast<const int4*>(schedule.items)[i];
    Item item{entries.x, entries.y, entries.z, entries.w};
    if (in_order) {
      if (colour_of(t, item.block) != colour || item.begin != t.offsets[item.slot]) continue;
      item.end = t.offsets[item.slot + 1];
    }
    __syncthreads();  // the tile before is done
    if (threadIdx.x < 1 << D) slots[threadIdx.x] = schedule.neighbours[(item.slot << D) + threadIdx.x];
    T sum[S::width][S::channels] = {};
    for (int begin = item.begin; begin < item.end; begin += S::batch) {
      __syncthreads();
      load_sorted<S>(source, t, item.block, shared, cell_start, begin, min(S::batch, item.end - begin), in_order);
      if (walker.active) walk_column<S, 0>(shared, walker, cell_start + walker.column * kBlockWidth, sum);
    }
    __syncthreads();
    if (walker.active) {
#pragma unroll
      for (int c = 0; c < S::channels; c++)
#pragma unroll
        for (int z = 0; z < S::width; z++) sums[c * S::sums + threadIdx.x * S::column_stride + z] = sum[z][c];
    }
    __syncthreads();
    flush_tile<S, T, D>(source.nodes, slots, sums, in_order);
  }
}

template <class Source>
void launch_scatter(const Source& source, bool deterministic, Stream stream) {
  using S = typename Source::Shape;
  const int64_t items = most_items(source.topology.capacity, source.topology.particles);
  if (items == 0) return;
  for (int colour = deterministic ? 0 : -1; colour < (deterministic ? 1 << S::D : 0); colour++)
    launch(scatter_kernel<Source>, grid_size(items), S::threads, S::shared_bytes, stream, source, colour);
}

template <int Order, class T, int D, bool Gradient>
struct MomentumSource {
  using Shape = ScatterShape<Order, T, D, 1, D, Gradient>;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position;
  MomentumFields<Order, T, D> fields;

  explicit MomentumSource(const P2GArguments<T, D>& a)
      : topology(a.topology), nodes(a.nodes), position(a.x), fields(a) {}

  __device__ ParticleMomentum<T, D> load(int p, int scene) const { return fields.read(p, scene); }
  __device__ Contribution<T, D, 1, D> contribution(const ParticleMomentum<T, D>& particle) const {
    const NodeMomentum<T, D> m = fields.to_nodes(particle);
    Contribution<T, D, 1, D> c;
    c.plain[0] = m.mass;
#pragma unroll
    for (int i = 0; i < D; i++) {
      c.value[i] = m.momentum[i];
#pragma unroll
      for (int j = 0; j < D; j++) {
        c.moment[i][j] = m.moment[i][j];
        c.gradient[i][j] = m.gradient[i][j];
      }
    }
    return c;
  }
};

// Channels [first, first + K).
template <int Order, class T, int D, int K, bool Gradient>
struct FieldSource {
  using Shape = ScatterShape<Order, T, D, 0, K, Gradient>;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position;
  Columns<const T, K> value;
  Columns<const T, K * D> moment, gradient;
  T moment_scale, gradient_scale;  // to cells

  FieldSource(const ScatterArguments<T, D>& a, int first)
      : topology(a.topology),
        nodes(a.nodes),
        position(a.x),
        value(channels_from(a.value, first)),
        moment(channels_from(a.moment, first), D),
        gradient(channels_from(a.gradient, first), D),
        moment_scale(T(a.moment_scale * double(a.topology.geometry.dx))),
        gradient_scale(a.topology.geometry.inverse_dx) {
    nodes.pointer += first;
  }

  __device__ Contribution<T, D, 0, K> load(int p, int) const {
    Contribution<T, D, 0, K> c;
#pragma unroll
    for (int k = 0; k < K; k++) {
      c.value[k] = value.at(p, k);
#pragma unroll
      for (int i = 0; i < D; i++) {
        c.moment[k][i] = moment.present() ? moment_scale * moment.at(p, k * D + i) : T(0);
        c.gradient[k][i] = Gradient ? gradient_scale * gradient.at(p, k * D + i) : T(0);
      }
    }
    return c;
  }
  __device__ const Contribution<T, D, 0, K>& contribution(const Contribution<T, D, 0, K>& loaded) const {
    return loaded;
  }
};

template <int Order, class T, int D>
void p2g(const P2GArguments<T, D>& a, Stream stream) {
  if (has_gradient(a))
    launch_scatter(MomentumSource<Order, T, D, true>(a), a.deterministic, stream);
  else
    launch_scatter(MomentumSource<Order, T, D, false>(a), a.deterministic, stream);
}

template <int Order, int K, class T, int D>
void scatter_channels(const ScatterArguments<T, D>& a, int first, Stream stream) {
  if (a.gradient.pointer)
    launch_scatter(FieldSource<Order, T, D, K, true>(a, first), a.deterministic, stream);
  else
    launch_scatter(FieldSource<Order, T, D, K, false>(a, first), a.deterministic, stream);
}

template <int Order, class T, int D>
void scatter(const ScatterArguments<T, D>& a, Stream stream) {
  int first = 0;
  for (; first + D <= a.nodes.channels; first += D) scatter_channels<Order, D>(a, first, stream);
  for (; first < a.nodes.channels; first++) scatter_channels<Order, 1>(a, first, stream);
}

#define INSTANTIATE_SCATTER(Order, T, D)                             \
  template void p2g<Order, T, D>(const P2GArguments<T, D>&, Stream); \
  template void scatter<Order, T, D>(const ScatterArguments<T, D>&, Stream);

}  // namespace mpm::cuda
