#pragma once

#include "cuda/fixed_point.cuh"
#include "cuda/programmatic_launch.cuh"
#include "cuda/vec4.cuh"
#include "transfer/momentum.cuh"
#include "transfer/tiles.cuh"

// The kernel of P2G and scatter. One thread block processes the particles of one item, links them by cell in shared
// memory, and sums nodes in registers: each cell has one thread per leading node of the support, Order + 1 of them,
// which walks the particles of the cell and adds to the slab of nodes behind that leading node. Each node of the tile
// around the block then sums the slabs that reach it, and adds the result to the grid: one vector reduction per node,
// for any number of particles.
//
// The contribution of a particle to a node is N_i (a + B · i) + G · ∇N_i, i being the distance from the base node in
// cells: `Linear` channels of this kind after `Plain` ones with B = G = 0. In deterministic mode particles are linked
// in the order of the index tensor, and the result of an item is added in fixed point, or block by block: blocks of one
// colour at a time, which share no node, or by tiles (transfer/tiles.h).
namespace mpm::cuda {

template <class T>
struct alignas(2 * sizeof(T)) Pair {
  T e[2];
};

template <class T, int D, int Plain, int Linear>
struct Contribution {
  T plain[Plain > 0 ? Plain : 1];
  T value[Linear];
  T moment[Linear][D];    // per cell
  T gradient[Linear][D];  // of the gradient per cell
};

// Slices: threads that share the particles of one cell and leading node. Most: particles of a batch at most.
template <int Order_, class T_, int D_, int Plain_, int Linear_, bool Gradient_, int Slices = D_ == 2 ? 4 : 1,
          int Most = kItemParticles>
struct ScatterShape {
  using T = T_;
  static constexpr int Order = Order_, D = D_, Plain = Plain_, Linear = Linear_;
  static constexpr bool Gradient = Gradient_;
  static constexpr int channels = Plain + Linear, support = Order + 1;
  static constexpr int width =
      kBlockWidth + Order;  // nodes of the tile along an axis, from the first of the base block

  // Threads.
  static constexpr int cells = kBlockNodes<D>, slab = D == 2 ? support : support * support;
  static constexpr int slices = Slices;
  static constexpr int lists = cells * slices, threads = lists * support;

  // Particle in shared memory: its distance from the base node along the first axis, the weights along the others
  // except one, since they add up to one, and its contribution. In quads, and a pair where one or two words remain.
  static constexpr int derivatives = Gradient ? 2 : 1, stored = support - 1;
  static constexpr int weights = 1, plain = weights + (D - 1) * derivatives * stored, linear = plain + Plain;
  static constexpr int linear_words = 1 + D * derivatives, words = linear + Linear * linear_words;
  static constexpr int pairs = words % 4 == 1 || words % 4 == 2, quads = (words + 3) / 4 - pairs;
  using Link = uint16_t;  // number of a row
  static constexpr int row_bytes = (quads * 4 + pairs * 2) * int(sizeof(T)) + int(sizeof(Link));
  static constexpr int fitting = 90 * 1024 / row_bytes / 32 * 32;
  static constexpr int batch = fitting < Most ? fitting : Most;

  // Sums, in the same memory: the slab of each thread. The four nodes of a block along the last axis are contiguous in
  // the grid, so rows of the tile are too, and are processed four words at a time.
  static constexpr int near_quads = channels, far_quads = (Order * channels + 3) / 4;
  static constexpr int row_quads = near_quads + far_quads;

  static constexpr size_t particle_bytes = size_t(batch) * row_bytes;
  // In two rounds, each of a half of every slab, where they would exceed the memory of most devices.
  static constexpr int rounds = size_t(threads) * slab * channels * sizeof(T) > 90 * 1024 ? 2 : 1, part = slab / rounds;
  static_assert(slab % rounds == 0);
  static constexpr size_t sum_bytes = size_t(threads) * part * channels * sizeof(T);
  static constexpr size_t shared_bytes = particle_bytes > sum_bytes ? particle_bytes : sum_bytes;
};

// The shape of small thread blocks, in 2-D.
template <int Order, class T, int D, int Plain, int Linear, bool Gradient>
using SmallScatterShape = ScatterShape<Order, T, D, Plain, Linear, Gradient, D == 2 ? 2 : 1, kSmallItemParticles<D>>;

// Particles of a batch in shared memory, in linked lists of rows: one for each cell, or for each slice of it, and one
// of particles outside their base block.
template <class S>
struct SharedParticles {
  using T = typename S::T;
  using Link = typename S::Link;
  static constexpr Link end = Link(-1);
  Vec4<T>* quads;  // [quads, batch]
  Pair<T>* pairs;  // [pairs, batch]
  Link* next;      // [batch]
  int* head;       // [lists + 1]
  int room;        // where S::batch is 0, instead of it

  __device__ SharedParticles(char* memory, int* head, int room = S::batch) : head(head), room(room) {
    quads = reinterpret_cast<Vec4<T>*>(memory);
    pairs = reinterpret_cast<Pair<T>*>(quads + S::quads * batch());
    next = reinterpret_cast<Link*>(pairs + S::pairs * batch());
  }
  __device__ int batch() const { return S::batch > 0 ? S::batch : room; }
  // Row of particle k. Neighbouring cells use different banks when each holds eight particles in order.
  __device__ static int row(int k) { return k ^ (k / 8 & 7); }
};

// Weights of an axis without those of node 1, which follow from the others.
template <class S, class T>
__device__ void pack_weights(const T& f, T* packed) {
  T w[S::support];
  BSpline<S::Order>::weights(f, w);
#pragma unroll
  for (int k = 0; k < S::stored; k++) packed[k] = w[k > 0 ? k + 1 : 0];
  if constexpr (S::Gradient) {
    BSpline<S::Order>::first_derivatives(f, w);
#pragma unroll
    for (int k = 0; k < S::stored; k++) packed[S::stored + k] = w[k > 0 ? k + 1 : 0];
  }
}

template <class S, class T>
__device__ void unpack_weights(const T* packed, const T& sum, T* w) {
  w[0] = packed[0];
  w[1] = sum - packed[0];
#pragma unroll
  for (int k = 1; k < S::stored; k++) {
    w[k + 1] = packed[k];
    w[1] -= packed[k];
  }
}

// Words of a row, including excess words of quads and a pair.
template <class S>
constexpr int kWords = S::quads * 4 + 2;

template <class S, class T>
__device__ void load_words(const SharedParticles<S>& shared, int row, T (&word)[kWords<S>]) {
#pragma unroll
  for (int q = 0; q < S::quads; q++) {
    const Vec4<T> v = shared.quads[q * shared.batch() + row];
#pragma unroll
    for (int e = 0; e < 4; e++) word[4 * q + e] = v.e[e];
  }
  if (S::pairs > 0) {
    const Pair<T> v = shared.pairs[row];
    word[4 * S::quads] = v.e[0];
    word[4 * S::quads + 1] = v.e[1];
  }
}

template <class S, class T, int D>
__device__ void store_particle(const SharedParticles<S>& shared, int row, const T f[D],
                               const Contribution<T, D, S::Plain, S::Linear>& c) {
  T word[kWords<S>] = {};
  word[0] = f[0];
#pragma unroll
  for (int i = 1; i < D; i++) pack_weights<S>(f[i], word + S::weights + (i - 1) * S::derivatives * S::stored);
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
    shared.quads[q * shared.batch() + row] = {word[4 * q], word[4 * q + 1], word[4 * q + 2], word[4 * q + 3]};
  if (S::pairs > 0) shared.pairs[row] = {word[4 * S::quads], word[4 * S::quads + 1]};
}

// One thread of a cell: the list that it walks, and the leading node that it adds to.
template <class S>
struct Walker {
  using T = typename S::T;
  int list, lane;
  NodeWeight<S::Order, T> leading;

  __device__ Walker() : Walker(threadIdx.x) {}
  __device__ explicit Walker(int number) : list(number / S::support), lane(number % S::support), leading(lane) {}
};

// A row of nodes along the last axis receives w_k (at + k step) + w'_k along.
template <class S, class T>
__device__ void add_row(const T (*w)[S::support], T at, const T& step, const T& along, int channel,
                        T (*sum)[S::channels]) {
#pragma unroll
  for (int k = 0; k < S::support; k++) {
    sum[k][channel] += w[0][k] * at;
    if (S::Gradient) sum[k][channel] += w[1][k] * along;
    at += step;
  }
}

// Contribution of one particle to the slab of a thread; rows of nodes along the last axis are Pitch nodes apart.
template <class S, int Pitch = S::support, class T>
__device__ void add_particle(const SharedParticles<S>& shared, const Walker<S>& walker, int row,
                             T (*sum)[S::channels]) {
  constexpr int D = S::D, rows = S::slab / S::support;
  T word[kWords<S>], weights[D - 1][S::derivatives][S::support];
  load_words(shared, row, word);
#pragma unroll
  for (int i = 0; i < D - 1; i++)
#pragma unroll
    for (int d = 0; d < S::derivatives; d++)
      unpack_weights<S>(word + S::weights + (i * S::derivatives + d) * S::stored, d == 0 ? T(1) : T(0), weights[i][d]);
  const T w = walker.leading.at(word[0]), slope = S::Gradient ? walker.leading.slope(word[0]) : T(0);
  const auto& middle = weights[0];  // in 3-D
  const auto& last = weights[D - 2];
#pragma unroll
  for (int c = 0; c < S::Plain; c++) {
    const T v = w * word[S::plain + c];
#pragma unroll
    for (int j = 0; j < rows; j++) {
      const T at = D == 2 ? v : middle[0][j] * v;
#pragma unroll
      for (int k = 0; k < S::support; k++) sum[j * Pitch + k][c] += last[0][k] * at;
    }
  }
#pragma unroll
  for (int c = 0; c < S::Linear; c++) {
    const T* const v = word + S::linear + c * S::linear_words;
    const T* const g = v + 1 + D;
    T at = w * (v[0] + v[1] * T(walker.lane));
    if (S::Gradient) at += slope * g[0];
    const T step = w * v[D], along = S::Gradient ? w * g[D - 1] : T(0);
    if constexpr (D == 2) {
      add_row<S>(last, at, step, along, S::Plain + c, sum);
    } else {
      const T across = w * v[2], tilt = S::Gradient ? w * g[1] : T(0);
#pragma unroll
      for (int j = 0; j < rows; j++) {
        T start = middle[0][j] * at;
        if (S::Gradient) start += middle[1][j] * tilt;
        add_row<S>(last, start, middle[0][j] * step, middle[0][j] * along, S::Plain + c, sum + j * Pitch);
        at += across;
      }
    }
  }
}

// Links the lists in the order of the index tensor, from the last particle to the first; by one warp. `next` holds the
// list of each particle before, and its successor after.
template <class S>
__device__ void link_in_order(const SharedParticles<S>& shared, int n) {
  const int lane = threadIdx.x;
  for (int first = (n - 1) / 32 * 32; first >= 0; first -= 32) {
    const int row = SharedParticles<S>::row(first + lane), list = first + lane < n ? shared.next[row] : -1;
    const unsigned group = __match_any_sync(~0u, list), after = group & ~((2u << lane) - 1);
    const int head = list >= 0 ? shared.head[list] : 0;
    __syncwarp();
    if (list >= 0) {
      shared.next[row] = uint16_t(after ? SharedParticles<S>::row(first + __ffs(after) - 1) : head);
      if (__ffs(group) - 1 == lane) shared.head[list] = row;
    }
    __syncwarp();
  }
}

template <class S>
__device__ void empty_lists(int* head) {
  for (int c = threadIdx.x; c <= S::lists; c += S::threads) head[c] = SharedParticles<S>::end;
}

// For particle k of a batch.
template <class S>
__device__ int list_of(int k, bool in_block, int cell) {
  return in_block ? k % S::slices * S::cells + cell : S::lists;
}

struct NoCells {
  static constexpr int cells = 0;
};

// Particles in the order of their cells: first index of each cell.
template <class S>
struct CellOrder {
  int start[S::cells + 1];
};

// Numbers the particles of each cell in the order of the index tensor; by one warp. `next` holds the cell of each
// particle before, and its number after.
template <class S>
__device__ void number_in_order(const SharedParticles<S>& shared, CellOrder<S>& order, int n) {
  const int lane = threadIdx.x;
  for (int first = 0; first < n; first += 32) {
    const int row = SharedParticles<S>::row(first + lane), cell = first + lane < n ? shared.next[row] : -1;
    const unsigned group = __match_any_sync(~0u, cell), before = group & ((1u << lane) - 1);
    const int count = cell >= 0 ? order.start[cell] : 0;
    __syncwarp();
    if (cell >= 0) {
      shared.next[row] = uint16_t(count + __popc(before));
      if (before == 0) order.start[cell] = count + __popc(group);
    }
    __syncwarp();
  }
}

// Finds the places of the particles index[begin, begin + n) in the order of their cells. Each thread stores for its own
// particle the number in `next`, counted in its cell, and the index in `pairs`, since places overwrite the index.
template <class S, class Source, class T, int D>
__device__ void order_by_cell(const Source& source, const Topology<T, D>& t, const BaseBlock<T, D>& base_block,
                              const SharedParticles<S>& shared, CellOrder<S>& order, int begin, int n, bool in_order) {
  static_assert(S::pairs > 0 && sizeof(Pair<T>) >= sizeof(int));
  for (int c = threadIdx.x; c <= S::cells; c += S::threads) order.start[c] = 0;
  __syncthreads();
  for (int k = threadIdx.x; k < n; k += S::threads) {
    const int p = t.index[begin + k], row = SharedParticles<S>::row(k);
    int cell;
    T f[D];
    base_block.template locate<S::Order>(t.geometry, read_vector(source.position, p), cell, f);
    shared.next[row] = uint16_t(in_order ? cell : atomicAdd(&order.start[cell], 1));
    *reinterpret_cast<int*>(shared.pairs + row) = p;
  }
  __syncthreads();
  if (in_order) {
    if (threadIdx.x < 32) number_in_order(shared, order, n);
    __syncthreads();
  }
  if (threadIdx.x < 32) {
    constexpr int each = (S::cells + 1 + 31) / 32;
    int count[each], sum = 0;
#pragma unroll
    for (int c = 0; c < each; c++) {
      const int cell = int(threadIdx.x) * each + c;
      count[c] = cell <= S::cells ? order.start[cell] : 0;
      sum += count[c];
    }
    int before = sum;
#pragma unroll
    for (int o = 1; o < 32; o *= 2) {
      const int v = __shfl_up_sync(~0u, before, o);
      if (int(threadIdx.x) >= o) before += v;
    }
    before -= sum;
#pragma unroll
    for (int c = 0; c < each; c++) {
      const int cell = int(threadIdx.x) * each + c;
      if (cell <= S::cells) order.start[cell] = before;
      before += count[c];
    }
  }
  __syncthreads();
}

// Loads the particles index[begin, begin + n) of a block into shared memory and links them by cell.
template <class S, class Source, int Most, class T, int D>
__device__ void load_particles(const Source& source, const Topology<T, D>& t, int block, BaseBlock<T, D>& base_block,
                               const SharedParticles<S>& shared, OutOfBlockList<Most>& out_of_block, int begin, int n,
                               bool in_order) {
  constexpr bool may_reorder = requires { source.reorders(); };
  __shared__ CellOrder<std::conditional_t<may_reorder, S, NoCells>> order;
  bool reorders = false;
  if constexpr (may_reorder) reorders = source.reorders();
  int following = int(threadIdx.x) < n && !reorders ? t.index[begin + threadIdx.x] : 0;
  if (threadIdx.x == 32) base_block.template set<S::Order>(t, block);
  if (threadIdx.x == 0) out_of_block.count = 0;
  empty_lists<S>(shared.head);
  __syncthreads();
  if constexpr (may_reorder)
    if (reorders) order_by_cell<S>(source, t, base_block, shared, order, begin, n, in_order);
#pragma unroll 1
  for (int k = threadIdx.x; k < n; k += S::threads) {
    const int row = SharedParticles<S>::row(k);
    int p = following;
    if (reorders)
      p = *reinterpret_cast<const int*>(shared.pairs + row);
    else if (k + S::threads < n)
      following = t.index[begin + k + S::threads];
    int cell;
    T f[D];
    // Loaded and stored for any place of the particle, so that no load waits for another.
    const Vector<T, D> x = read_vector(source.position, p);
    const bool in_block = base_block.template locate<S::Order>(t.geometry, x, cell, f);
    const auto loaded = [&] {
      if constexpr (may_reorder)
        return source.load(p, base_block.scene, begin + (reorders ? order.start[cell] + shared.next[row] : k));
      else
        return source.load(p, base_block.scene);
    }();
    const int list = list_of<S>(k, in_block, cell);
    store_particle<S, T, D>(shared, row, f, source.contribution(loaded));
    if (Source::displaced && !in_block) out_of_block.particle[atomicAdd(&out_of_block.count, 1)] = uint16_t(k);
    shared.next[row] = uint16_t(in_order ? list : atomicExch(&shared.head[list], row));
  }
  __syncthreads();
  if (in_order) {
    if (threadIdx.x < 32) link_in_order(shared, n);
    __syncthreads();
  }
}

// Destination nodes of P2G, and whether in fixed point.
template <class T>
struct NodeSums : NodeField<T> {
  FixedPoint fixed;
};

template <class T>
__device__ bool is_fixed(const NodeField<T>&) {
  return false;
}
template <class T>
__device__ bool is_fixed(const NodeSums<T>& nodes) {
  return sizeof(T) == sizeof(float) && nodes.fixed.largest_mass;
}

// Adds to words of rows of nodes in fixed point, from one word of a row on.
template <class S, int N, class T>
__device__ void add_fixed_words(const NodeField<T>&, int64_t, int, const T (&)[N]) {}
template <class S, int N>
__device__ void add_fixed_words(const NodeSums<float>& nodes, int64_t row, int first, const float (&value)[N]) {
  const FixedUnits units(nodes.fixed);
  FixedRow<S::channels - 1>* const rows = reinterpret_cast<FixedRow<S::channels - 1>*>(nodes.pointer) + row;
#pragma unroll
  for (int e = 0; e < N; e++) {
    const int word = first + e;
    if (value[e] != 0) add_fixed(rows[word / S::channels].word, word % S::channels, value[e], units);
  }
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

// Whether rows of nodes without a gap begin at whole vectors.
template <class S, class T>
__device__ bool is_dense(const NodeField<T>& nodes) {
  return nodes.stride == S::channels && reinterpret_cast<uintptr_t>(nodes.pointer) % 16 == 0;
}

template <int N, class T>
__device__ T pick(const T (&of)[N], int k) {
  T r = of[0];
#pragma unroll
  for (int j = 1; j < N; j++) r = k == j ? of[j] : r;
  return r;
}

// Contribution of a particle in shared memory to the node at `offset` from the base node.
template <class S, class T>
__device__ void node_value(const SharedParticles<S>& shared, int row, const int (&offset)[S::D],
                           T (&value)[S::channels]) {
  constexpr int D = S::D;
  T word[kWords<S>], weight[D], derivative[D] = {};
  load_words(shared, row, word);
  const NodeWeight<S::Order, T> leading(offset[0]);
  weight[0] = leading.at(word[0]);
  if (S::Gradient) derivative[0] = leading.slope(word[0]);
#pragma unroll
  for (int i = 1; i < D; i++) {
    const T* const packed = word + S::weights + (i - 1) * S::derivatives * S::stored;
    T all[S::support];
    unpack_weights<S>(packed, T(1), all);
    weight[i] = pick(all, offset[i]);
    if (!S::Gradient) continue;
    unpack_weights<S>(packed + S::stored, T(0), all);
    derivative[i] = pick(all, offset[i]);
  }
  T product = T(1), slope[D];
#pragma unroll
  for (int i = 0; i < D; i++) {
    product *= weight[i];
    slope[i] = derivative[i];
#pragma unroll
    for (int j = 0; j < D; j++)
      if (j != i) slope[i] *= weight[j];
  }
#pragma unroll
  for (int c = 0; c < S::Plain; c++) value[c] = product * word[S::plain + c];
#pragma unroll
  for (int c = 0; c < S::Linear; c++) {
    const T* const v = word + S::linear + c * S::linear_words;
    T at = v[0], along = T(0);
#pragma unroll
    for (int i = 0; i < D; i++) {
      at += v[1 + i] * T(offset[i]);
      if (S::Gradient) along += slope[i] * v[1 + D + i];
    }
    value[S::Plain + c] = product * at + along;
  }
}

// Nodes of the support of one particle, by a warp, one lane per node: node_row(offset) is the row of the node, -1 in an
// inactive block.
template <class S, class Nodes, class NodeRow>
__device__ void add_one_out_of_block(const Nodes& nodes, const SharedParticles<S>& shared, int row,
                                     const NodeRow& node_row) {
  using T = typename S::T;
  constexpr int D = S::D, count = D == 2 ? S::support * S::support : S::support * S::slab;
  for (int n = threadIdx.x % 32; n < count; n += 32) {
    int offset[D];
    split<S::support>(n, offset);
    const int64_t at = node_row(offset);
    if (at < 0) continue;
    T value[S::channels];
    node_value(shared, row, offset, value);
    if (is_fixed(nodes)) {
      add_fixed_words<S>(nodes, at, 0, value);
      continue;
    }
    T* const to = nodes.pointer + at * nodes.stride;
    if constexpr (S::channels == 4) {
      if (is_dense<S>(nodes)) {
        add_to_nodes(to, value, false);
        continue;
      }
    }
#pragma unroll
    for (int c = 0; c < S::channels; c++) add_to_nodes(to + c, value[c], false);
  }
}

// The same for a particle whose base node is in the row `first`.
template <class S, class Nodes>
__device__ void add_one_out_of_block(const Nodes& nodes, const Schedule<const int>& schedule,
                                     const SharedParticles<S>& shared, int row, int first) {
  constexpr int D = S::D;
  const int slot = first / kBlockNodes<D>;
  add_one_out_of_block<S>(nodes, shared, row, [&](const int (&offset)[D]) -> int64_t {
    int node[D], neighbour = 0;
#pragma unroll
    for (int i = D - 1, base = first; i >= 0; i--, base /= kBlockWidth) {
      node[i] = base % kBlockWidth + offset[i];
      neighbour |= int(node[i] >= kBlockWidth) << (D - 1 - i);
    }
    const int node_slot = schedule.neighbours[(slot << D) + neighbour];
    return node_slot < 0 ? -1 : int64_t(node_slot) * kBlockNodes<D> + node_in_block<D>(node);
  });
}

// Strays of a batch index[begin, ...) are added to the nodes without a tile. Each lane finds one, so that its loads do
// not wait for those of others, and then the warp processes them in turn.
template <class S, class Source, class Nodes, int Most, class T, int D>
__device__ void add_out_of_block(const Source& source, const Nodes& nodes, const Topology<T, D>& t,
                                 const Schedule<const int>& schedule, int scene, const SharedParticles<S>& shared,
                                 const OutOfBlockList<Most>& out_of_block, int begin) {
  constexpr int warps = S::threads / 32;
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  for (int start = warp; start < out_of_block.count; start += 32 * warps) {
    const int s = start + warps * lane;
    int first = -1, row = 0;
    if (s < out_of_block.count) {
      const int k = out_of_block.particle[s], p = t.index[begin + k];
      int base[D];
      T f[D];
      const int slot = locate_slot<S::Order>(t, scene, read_vector(source.position, p), base, f);
      row = SharedParticles<S>::row(k);
      if (slot >= 0) first = slot * kBlockNodes<D> + node_in_block<D>(base);
    }
    for (unsigned left = __ballot_sync(~0u, first >= 0); left; left &= left - 1) {
      const int from = __ffs(left) - 1;
      add_one_out_of_block(nodes, schedule, shared, __shfl_sync(~0u, row, from), __shfl_sync(~0u, first, from));
    }
  }
}

// Part of the slab of a thread in this round, at the place of this thread.
template <class S, int Round, class T>
__device__ void put_slab(const T (&sum)[S::slab][S::channels], T* sums) {
  T* const to = sums + threadIdx.x * (S::part * S::channels);
#pragma unroll
  for (int n = 0; n < S::part; n++) {
    const auto& node = sum[Round * S::part + n];
    if constexpr (S::channels == 4) {
      reinterpret_cast<Vec4<T>*>(to)[n] = {node[0], node[1], node[2], node[3]};
    } else {
#pragma unroll
      for (int c = 0; c < S::channels; c++) to[n * S::channels + c] = node[c];
    }
  }
}

// f(place, reaches) for the slabs that may reach a node of the tile: index of the node in them, if it is there.
template <class S, int Round, class F>
__device__ void each_slab(const int (&node)[S::D], const F& f) {
  constexpr int D = S::D, count = D == 2 ? S::support * S::support : S::support * S::slab;
#pragma unroll
  for (int n = 0; n < count; n++) {
    if (n % S::slab / S::part != Round) continue;
    int cell = 0, offset[D];
    bool reaches = true;
#pragma unroll
    for (int i = D - 1, rest = n; i >= 0; i--, rest /= S::support) offset[i] = rest % S::support;
#pragma unroll
    for (int i = 0; i < D; i++) {
      reaches = reaches && unsigned(node[i] - offset[i]) < unsigned(kBlockWidth);
      cell = cell * kBlockWidth + node[i] - offset[i];
    }
#pragma unroll
    for (int slice = 0; slice < S::slices; slice++)
      f(((slice * S::cells + cell) * S::support + n / S::slab) * S::part + n % S::part, reaches);
  }
}

// One word of a row of the tile.
template <class S, int Round, class T>
__device__ T word_sum(const T* sums, int (&node)[S::D], int word) {
  T sum = T(0);
  node[S::D - 1] = word / S::channels;
  each_slab<S, Round>(
      node, [&](int place, bool reaches) { sum += reaches ? sums[place * S::channels + word % S::channels] : T(0); });
  return sum;
}

// Four words of a row of the tile, from one on; where these are not the words of a node, each lane has one of them, and
// the first lane all.
template <class S, int Round, class T>
__device__ Vec4<T> quad_sum(const T* sums, int (&node)[S::D], int first_word, bool exists) {
  Vec4<T> sum{};
  if constexpr (S::channels == 4) {
    if (!exists) return sum;
    node[S::D - 1] = first_word / 4;
    each_slab<S, Round>(node, [&](int place, bool reaches) {
      Vec4<T> v{};
      if (reaches) v = reinterpret_cast<const Vec4<T>*>(sums)[place];
#pragma unroll
      for (int e = 0; e < 4; e++) sum.e[e] += v.e[e];
    });
  } else {
    const T word = exists ? word_sum<S, Round>(sums, node, first_word + int(threadIdx.x) % 4) : T(0);
#pragma unroll
    for (int e = 0; e < 4; e++) sum.e[e] = __shfl_down_sync(~0u, word, e);
  }
  return sum;
}

// Words of a tile of sums with an order: rows of quads, first those of the block and then those of the next one.
template <class S>
constexpr int kTileWords = (S::D == 2 ? S::width : S::width * S::width) * S::row_quads * 4;

// Adds the sums of nodes of a round to the grid, four words at a time; or stores them in a tile, where there is one.
// `adds`: to what it has.
template <class S, int Round, int D, class Nodes, class T>
__device__ void flush_tile(const Nodes& nodes, const int slots[1 << D], const T* sums, bool in_order, T* tile = nullptr,
                           bool adds = false) {
  constexpr int K = S::channels, width = S::width, lanes = K == 4 ? 1 : 4;
  constexpr int count = (D == 2 ? width : width * width) * S::row_quads * lanes;
  const bool dense = is_dense<S>(nodes);
  for (int t = threadIdx.x; t / 32 * 32 < count; t += S::threads) {  // by whole warps
    const int tile_row = t / lanes / S::row_quads, quad = t / lanes % S::row_quads, far = quad >= S::near_quads;
    const int first_word = (far ? quad - S::near_quads : quad) * 4;
    int neighbour = 0, node[D] = {}, in_tile[D];
#pragma unroll
    for (int i = D - 2, rest = tile_row; i >= 0; i--, rest /= width) in_tile[i] = node[i] = rest % width;
#pragma unroll
    for (int i = 0; i < D - 1; i++) neighbour = neighbour * 2 + (node[i] >= kBlockWidth);
    const int slot = t < count ? slots[neighbour * 2 + far] : -1;
    const bool wanted = tile ? t < count : slot >= 0;
    Vec4<T> value = quad_sum<S, Round>(sums, in_tile, first_word + far * kBlockWidth * K, wanted);
    if (!wanted || t % lanes != 0) continue;
    if (tile) {
      T* const stored = tile + (tile_row * S::row_quads + quad) * 4;
      if (adds || Round > 0) value += load_vec4(stored);
      store_vec4(stored, value);
      continue;
    }
    if (is_zero(value)) continue;
    const int64_t row = int64_t(slot) * kBlockNodes<D> + node_in_block<D>(node);
    if (is_fixed(nodes)) {
      add_fixed_words<S>(nodes, row, first_word, value.e);
    } else if (dense) {
      add_to_nodes(nodes.pointer + row * K + first_word, value.e, in_order);
    } else {
#pragma unroll
      for (int e = 0; e < 4; e++) {
        const int word = first_word + e;
        if (value.e[e] != T(0))
          add_to_nodes(nodes.pointer + (row + word / K) * nodes.stride + word % K, value.e[e], in_order);
      }
    }
  }
}

// Adds the particles in shared memory to the nodes, or to a tile as `flush_tile`; `add_out_of_block` adds those in no
// list. `when_added` is called when their memory is no longer needed. All threads have to wait before that memory is
// reused.
template <class S, class Nodes, class AddOutOfBlock, class WhenAdded>
__device__ void add_particles(const Nodes& nodes, const SharedParticles<S>& shared, const int* slots, bool in_order,
                              const AddOutOfBlock& add_out_of_block, const WhenAdded& when_added,
                              typename S::T* tile = nullptr, bool adds = false) {
  using T = typename S::T;
  T* const sums = reinterpret_cast<T*>(shared.quads);
  const Walker<S> walker;
  T sum[S::slab][S::channels] = {};
#pragma unroll 1
  for (int row = shared.head[walker.list]; row != SharedParticles<S>::end;) {
    const int following = shared.next[row];
    add_particle(shared, walker, row, sum);
    row = following;
  }
  add_out_of_block();
  __syncthreads();
  put_slab<S, 0>(sum, sums);
  when_added();
  __syncthreads();
  flush_tile<S, 0, S::D>(nodes, slots, sums, in_order, tile, adds);
  if constexpr (S::rounds == 2) {
    __syncthreads();
    put_slab<S, 1>(sum, sums);
    __syncthreads();
    flush_tile<S, 1, S::D>(nodes, slots, sums, in_order, tile, adds);
  }
}

template <class S, class Nodes, class AddOutOfBlock>
__device__ void add_particles(const Nodes& nodes, const SharedParticles<S>& shared, const int* slots, bool in_order,
                              const AddOutOfBlock& add_out_of_block) {
  add_particles(nodes, shared, slots, in_order, add_out_of_block, [] {});
}

// Shared memory of the thread blocks of P2G beside the particles and the sums, which follow one another there.
template <class S, bool Displaced>
struct ScatterMemory {
  int slots[1 << S::D], head[S::lists + 1];
  BaseBlock<typename S::T, S::D> base_block;
  OutOfBlockList<Displaced ? S::batch : 1> out_of_block;
};

// Adds the particles of an item to the nodes, or stores them in a tile; `memory` is dynamic shared memory of
// S::shared_bytes.
template <class Source>
__device__ void scatter_item(const Source& source, const Topology<typename Source::Shape::T, Source::Shape::D>& t,
                             const Item& item, bool in_order, char* memory,
                             ScatterMemory<typename Source::Shape, Source::displaced>& m,
                             typename Source::Shape::T* tile = nullptr) {
  using S = typename Source::Shape;
  using T = typename S::T;
  constexpr int D = S::D;
  const SharedParticles<S> shared(memory, m.head);
  const int slot = threadIdx.x < 1 << D ? schedule_of(t).neighbours[(item.slot << D) + threadIdx.x] : -1;
  for (int begin = item.begin; begin < item.end; begin += S::batch) {
    load_particles<S>(source, t, item.block, m.base_block, shared, m.out_of_block, begin,
                      ::min(S::batch, item.end - begin), in_order || is_fixed(source.nodes));
    if (threadIdx.x < 1 << D) m.slots[threadIdx.x] = slot;
    add_particles(
        source.nodes, shared, m.slots, in_order,
        [&] {
          if constexpr (Source::displaced)
            add_out_of_block<S>(source, source.nodes, t, schedule_of(t), m.base_block.scene, shared, m.out_of_block,
                                begin);
        },
        [] {}, tile, begin > item.begin);
    __syncthreads();
  }
}

// A pass over the items: sums in no order, of every item, with atomics; or of whole base blocks, those of a colour
// without atomics, or all with tiles.
constexpr int kTiled = -2, kNoOrder = -1;

// The items of thread block `block` of `blocks`, and the particles outside. Source: topology, nodes, position; whether
// particles may be displaced; load(p, scene), or load(p, scene, place) with its place in the index, the inputs of a
// particle; contribution(loaded), its contribution; and optionally is_due(), whether there is work, and skip(p, place)
// for a particle outside.
template <class Source>
__device__ void scatter_items(const Source& source, int pass, unsigned block, unsigned blocks, char* memory,
                              ScatterMemory<typename Source::Shape, Source::displaced>& shared) {
  using S = typename Source::Shape;
  using T = typename S::T;
  constexpr int D = S::D;
  const Topology<T, D>& t = source.topology;
  const Schedule<const int> schedule = schedule_of(t);
  const bool in_order = pass != kNoOrder;
  const int4* const items = reinterpret_cast<const int4*>(schedule.items);
  const int count = *schedule.item_count;
  int4 entries = items[block];  // without waiting for the count: the space suffices
  for (int i = block; i < count;) {
    Item item{entries.x, entries.y, entries.z, entries.w};
    i += blocks;
    if (i < count) entries = items[i];
    if (in_order) {
      if (pass != kTiled && block_colour(t.geometry, item.block) != pass) continue;
      if (item.begin != t.offsets[item.slot]) continue;
      item.end = t.offsets[item.slot + 1];
    }
    T* const tile = pass == kTiled ? source.nodes.tiles + int64_t(item.slot) * kTileWords<S> : nullptr;
    scatter_item(source, t, item, in_order, memory, shared, tile);
  }
  if constexpr (requires { source.skip(0, 0); }) {
    const int64_t stride = int64_t(blocks) * S::threads;
    for (int64_t i = t.offsets[t.max_blocks] + int64_t(block) * S::threads + threadIdx.x; i < t.particles; i += stride)
      source.skip(t.index[i], int(i));
  }
}

template <class Source>
__global__ void __launch_bounds__(Source::Shape::threads, Source::resident)
    scatter_kernel(const Source source, int pass) {
  grid_dependency_sync();
  if constexpr (requires { source.is_due(); })
    if (!source.is_due()) return;
  extern __shared__ __align__(16) char memory[];
  __shared__ ScatterMemory<typename Source::Shape, Source::displaced> shared;
  scatter_items(source, pass, blockIdx.x, gridDim.x, memory, shared);
}

// Stores the sums of the tiles at the nodes: a thread for four words of a row of nodes along the last axis.
template <class S>
__global__ void __launch_bounds__(kTileThreads)
    add_tiles_kernel(const Topology<typename S::T, S::D> t, const NodeField<typename S::T> nodes) {
  using T = typename S::T;
  constexpr int D = S::D, K = S::channels;
  grid_dependency_sync();
  const int i = int(blockIdx.x) * kTileThreads + int(threadIdx.x), quad = i % K;
  at_row_of_nodes(t, i / K, [&](int scene, const int (&block)[D], const int (&node)[D], int64_t first) {
    Vec4<T> sum{};
    for_base_blocks(t, scene, block, [&](int from, int before) {
      const int row = row_of_tile<S::width>(node, before), far = before & 1;
      if (row < 0 || (far && quad >= S::far_quads)) return;
      const int at = row * S::row_quads + (far ? S::near_quads : 0) + quad;
      sum += load_vec4(nodes.tiles + int64_t(from) * kTileWords<S> + 4 * at);
    });
#pragma unroll
    for (int e = 0; e < 4; e++) {
      const int word = 4 * quad + e;
      nodes.pointer[(first + word / K) * nodes.stride + word % K] = sum.e[e];
    }
  });
}

// Sums in no order.
template <class Source>
void launch_scatter(const Source& source, Stream stream) {
  using S = typename Source::Shape;
  const int64_t items = most_items(source.topology.max_blocks, source.topology.particles);
  if (items == 0) return;
  launch_in_chain(scatter_kernel<Source>, grid_size(source, items), S::threads, S::shared_bytes, stream, source,
                  kNoOrder);
}

template <class Source>
void launch_scatter_in_order(const Source& source, Stream stream) {
  using S = typename Source::Shape;
  const Topology<typename S::T, S::D>& t = source.topology;
  const int64_t items = most_items(t.max_blocks, t.particles);
  if (items == 0) return;
  const unsigned blocks = grid_size(source, items);
  const auto launch_pass = [&](int pass, unsigned count) {
    launch_in_chain(scatter_kernel<Source>, count, S::threads, S::shared_bytes, stream, source, pass);
  };
  if constexpr (S::channels <= kTileChannels) {
    static_assert(kTileWords<S> <= tile_words<S::D>(S::Order));
    if (source.nodes.tiles) {
      launch_pass(kTiled, blocks);
      return launch_in_chain(add_tiles_kernel<S>, blocks_for_rows(t, S::channels), kTileThreads, 0, stream, t,
                             NodeField<typename S::T>(source.nodes));
    }
  }
  // Of a colour most items are skipped, and then each thread block costs time.
  const unsigned most = unsigned(device_attribute(cudaDevAttrMultiProcessorCount)) * 8;
  for (int colour = 0; colour < 1 << S::D; colour++) launch_pass(colour, std::min(blocks, most));
}

template <class Source>
void launch_scatter(const Source& source, bool deterministic, Stream stream) {
  deterministic ? launch_scatter_in_order(source, stream) : launch_scatter(source, stream);
}

enum class Stress { none, moment, gradient };

// Displaced: particles may be in active blocks other than those of the activation. Small: thread blocks.
template <int Order, class T, int D, Stress Kind, bool Displaced, bool Small = true>
struct MomentumSource {
  static constexpr bool displaced = Displaced;
  static constexpr bool with_stress = Kind != Stress::none, gradient = Kind == Stress::gradient;
  using Shape = std::conditional_t<Small, SmallScatterShape<Order, T, D, 1, D, gradient>,
                                   ScatterShape<Order, T, D, 1, D, gradient>>;
  // With fewer registers the loads of the stress would wait for each other.
  static constexpr int resident = !with_stress && Order == 2 && D == 3 && sizeof(T) == 4 ? 5 : 0;
  Topology<T, D> topology;
  NodeSums<T> nodes;
  Columns<const T, D> position;
  MomentumFields<Order, T, D> fields;

  explicit MomentumSource(const P2GArguments<T, D>& a)
      : topology(a.topology), nodes{a.nodes, a.fixed}, position(a.x), fields(a) {}

  __device__ ParticleMomentum<T, D> load(int p, int scene) const { return fields.read(p, scene, with_stress); }
  __device__ Contribution<T, D, 1, D> contribution(const ParticleMomentum<T, D>& particle) const {
    const NodeMomentum<T, D> m =
        fields.to_nodes(particle, gradient ? StressForm::gradient : StressForm::mls, with_stress);
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

}  // namespace mpm::cuda
