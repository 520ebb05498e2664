#include "cuda/launch.cuh"
#include "cuda/programmatic_launch.cuh"
#include "heat/begin_node.cuh"
#include "heat/kernels.h"
#include "heat/operator.cuh"
#include "transfer/tiles.cuh"

// The simple steps of heat (csrc/heat/solve.h): a thread block packs the particles of an item, unless G2P has done
// that, and then a warp sums the products H u of an item, or of few items a thread block. Unlike csrc/heat/heat.cu this
// needs no barriers of the whole grid, and particles may have left their base block since the activation. Those are at
// the end of the packed particles of their item; of few items, further thread blocks add the first of these.
//
// Where sums have an order, a warp packs the particles of an item in that of the index, and stores the sums of a base
// block in a tile (transfer/tiles.h). All particles are in their base blocks there. The order does not depend on the
// other scenes or the pool: an item has one warp.
namespace mpm::cuda {
namespace {

constexpr int kPackThreads = 192, kEachPacked = kItemParticles / kPackThreads;
constexpr int kProductThreads = 128, kProductWarps = kProductThreads / 32;
static_assert(kEachPacked * kPackThreads == kItemParticles);

template <int Order, class T, int D>
struct SimpleKernel {
  using S = HeatShape<Order, T, D>;
  HeatSimpleArguments<T, D> a;
  PackedItems<T, D> packed;
  Columns<const T, D> x;
  Columns<const T, 1> conductance;

  explicit SimpleKernel(const HeatSimpleArguments<T, D>& a)
      : a(a),
        packed(packed_in(a.workspace ? a.workspace : a.solve.workspace, a.solve.topology, a.solve.deterministic)),
        x(a.solve.x),
        conductance(a.solve.conductance) {}

  __device__ const Topology<T, D>& topology() const { return a.solve.topology; }
  __device__ Item item(int i) const { return reinterpret_cast<const Item*>(schedule_of(topology()).items)[i]; }
  __device__ int items() const { return *schedule_of(topology()).item_count; }
  __device__ int steps_of(const Item& item) const { return simple_steps(a.solve, scene_of(topology(), item.block)); }
  __device__ bool packs(const Item& item) const { return a.workspace || steps_of(item) > 0; }
  __device__ T* product() const { return a.product[a.step]; }
};

// The items of the thread block, of `blocks`.
template <int Order, class T, int D>
__device__ void pack_items(const SimpleKernel<Order, T, D>& k, unsigned blocks) {
  using S = typename SimpleKernel<Order, T, D>::S;
  __shared__ PackedOrder<S> m;
  __shared__ BaseBlock<T, D> home;
  const Topology<T, D>& t = k.topology();
  const int count = k.items();
  for (int i = blockIdx.x; i < count; i += blocks) {
    const Item item = k.item(i);
    if (!k.packs(item)) continue;
    int particle[kEachPacked], cell[kEachPacked], rank[kEachPacked];
    PackedParticle<T, D> q[kEachPacked];
    Vector<T, D> x[kEachPacked];
    const auto exists = [&](int n) { return item.begin + n * kPackThreads + int(threadIdx.x) < item.end; };
#pragma unroll
    for (int n = 0; n < kEachPacked; n++)
      particle[n] = t.index[exists(n) ? item.begin + n * kPackThreads + int(threadIdx.x) : item.begin];
#pragma unroll
    for (int n = 0; n < kEachPacked; n++) {
      x[n] = read_vector(k.x, particle[n]);
      q[n].conductance = scaled_conductance<Order>(k.conductance.at(particle[n]), t.geometry.inverse_dx);
    }
    if (threadIdx.x == 0) home.template set<Order>(t, item.block);
    for (int c = threadIdx.x; c <= S::cells; c += kPackThreads) m.count[c] = 0;
    __syncthreads();
#pragma unroll
    for (int n = 0; n < kEachPacked; n++) {
      home.template locate<Order>(t.geometry, x[n], cell[n], q[n].f);
      if (exists(n)) rank[n] = atomicAdd(&m.count[cell[n]], 1);
    }
    __syncthreads();
    if (threadIdx.x < 32) set_rows(m);
    for (int c = threadIdx.x; c < S::cells; c += kPackThreads)
      k.packed.counts[int64_t(i) * S::cells + c] = uint16_t(m.count[c]);
    __syncthreads();
#pragma unroll
    for (int n = 0; n < kEachPacked; n++)
      if (exists(n))
        store_packed(k.packed, m, item.begin, item.end, cell[n], rank[n], q[n], [&] { return particle[n]; });
    __syncthreads();
  }
}

// The first `blocks` thread blocks pack the particles. Those after them compute the nodes before the solve, if any.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kPackThreads)
    pack_kernel(const __grid_constant__ SimpleKernel<Order, T, D> k,
                const __grid_constant__ HeatNodesArguments<T, D> nodes, unsigned blocks) {
  grid_dependency_sync();
  if (blockIdx.x < blocks) return pack_items(k, blocks);
  const int64_t i = int64_t(blockIdx.x - blocks) * kPackThreads + threadIdx.x;
  if (i < nodes.means.nodes) begin_node(nodes, i);
}

// Packs the particles of a cell in the order of the index.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kProductThreads)
    pack_in_order_kernel(const __grid_constant__ SimpleKernel<Order, T, D> k) {
  using S = typename SimpleKernel<Order, T, D>::S;
  grid_dependency_sync();
  __shared__ WarpMemory<S> memory[kProductWarps];
  const int count = k.items(), warp = int(threadIdx.x) / 32;
  for (int i = int(blockIdx.x) * kProductWarps + warp; i < count; i += int(gridDim.x) * kProductWarps)
    if (k.packs(k.item(i))) pack_item<S>(k.topology(), k.x, k.conductance, k.item(i), i, k.packed, memory[warp]);
}

// Directions of a step of a scene.
template <class T, int D>
struct Directions {
  const HeatSimpleArguments<T, D>& a;
  int steps;
  double c, dt;

  __device__ Directions(const HeatSimpleArguments<T, D>& a, int scene, int steps)
      : a(a), steps(steps), c(bound_of_scene(a.solve, scene)), dt(step_of_scene(a.solve, scene)) {}
  __device__ T of(int64_t node) const { return simple_direction(a, node, steps, c, dt); }
  // Those of four nodes of a row, whose inputs are loaded together.
  __device__ Vec4<T> at(int node) const {
    static_assert(kMostSimpleSteps == 3);  // the last product is not read
    Vec4<T> product[kMostSimpleSteps - 1]{}, u;
    NodeInputs<T> in[kBlockWidth];
#pragma unroll
    for (int j = 0; j < kMostSimpleSteps - 1; j++)
      if (j < a.step) product[j] = load_vec4(a.product[j] + node);
#pragma unroll
    for (int k = 0; k < kBlockWidth; k++) in[k] = node_inputs(a.solve, node + k);
#pragma unroll
    for (int k = 0; k < kBlockWidth; k++) {
      const T at_start = product[0].e[k], after_first = product[1].e[k];
      u.e[k] = simple_direction(
          simple_node(in[k], steps, a.step - 1, c, dt, [=](int j) { return j == 0 ? at_start : after_first; }));
    }
    return u;
  }
};

// A lane's nodes of the support of a particle that the lanes of a warp add together: the distance from the particle
// times the weight, and the node, -1 where its block is not active.
template <int Order, class T, int D>
struct LaneNodes {
  static constexpr int count = kSupportNodes<Order, D>, each = (count + 31) / 32;
  T moment[each][D];
  int64_t row[each];

  LaneNodes() = default;
  __device__ LaneNodes(const Topology<T, D>& t, int slot, const int* base, const T* f) {
    const int* const neighbours = schedule_of(t).neighbours + (int64_t(slot) << D);
#pragma unroll
    for (int e = 0; e < each; e++) {
      int node[D], neighbour = 0;
      T distance[D], weight = T(1);
      const int n = lane_index() + 32 * e;
#pragma unroll
      for (int i = D - 1, rest = n; i >= 0; i--, rest /= Order + 1) {
        const int k = rest % (Order + 1);
        node[i] = base[i] + k;
        neighbour |= int(node[i] >= kBlockWidth) << (D - 1 - i);
        distance[i] = T(k) - f[i];
        weight *= NodeWeight<Order, T>(k).at(f[i]);
      }
      const int there = n < count ? neighbours[neighbour] : -1;
      row[e] = there < 0 ? -1 : int64_t(there) * kBlockNodes<D> + node_in_block<D>(node);
#pragma unroll
      for (int i = 0; i < D; i++) moment[e][i] = weight * distance[i];
    }
  }
};

// Adds particles, whose base nodes are in the lanes of a set, with all lanes of a warp. A constant u has no gradient:
// the value of a node is subtracted from all, since Σ N (x_i − x_p) = 0.
template <int Order, class T, int D>
struct WarpAddition {
  using Nodes = LaneNodes<Order, T, D>;
  static constexpr int together = Nodes::each == 1 ? 4 : 1;  // whose loads do not wait for each other
  const SimpleKernel<Order, T, D>& k;
  const Directions<T, D>& directions;
  // Of the particle of this lane.
  int slot = -1, base[D] = {};
  T f[D] = {}, conductance = T(0);

  __device__ Nodes nodes_of(int lane) const {
    int b[D];
    T distance[D];
#pragma unroll
    for (int i = 0; i < D; i++) {
      b[i] = __shfl_sync(~0u, base[i], lane);
      distance[i] = __shfl_sync(~0u, f[i], lane);
    }
    return Nodes(k.topology(), __shfl_sync(~0u, slot, lane), b, distance);
  }

  // The next ones of a set, which are removed from it.
  __device__ void add_some(unsigned& lanes) const {
    Nodes nodes[together];
    T u[together][Nodes::each], of[together];
    int lane = 0;
#pragma unroll
    for (int n = 0; n < together; n++) {
      if (lanes) lane = __ffs(lanes) - 1;  // else the last one once more, without a contribution
      of[n] = __shfl_sync(~0u, conductance, lane);
      if (!lanes) of[n] = T(0);
      nodes[n] = nodes_of(lane);
      lanes &= lanes - 1;
#pragma unroll
      for (int e = 0; e < Nodes::each; e++) u[n][e] = nodes[n].row[e] < 0 ? T(0) : directions.of(nodes[n].row[e]);
    }
#pragma unroll
    for (int n = 0; n < together; n++) add(nodes[n], u[n], of[n]);
  }

  __device__ void add(const Nodes& nodes, const T (&u)[Nodes::each], const T& scaled) const {
    const T one = __shfl_sync(~0u, u[0], 0);
    T flux[D] = {};
#pragma unroll
    for (int i = 0; i < D; i++) {
#pragma unroll
      for (int e = 0; e < Nodes::each; e++)
        if (nodes.row[e] >= 0) flux[i] += nodes.moment[e][i] * (u[e] - one);
#pragma unroll
      for (int o = 16; o > 0; o /= 2) flux[i] += __shfl_xor_sync(~0u, flux[i], o);
      flux[i] *= scaled;
    }
#pragma unroll
    for (int e = 0; e < Nodes::each; e++) {
      T sum = T(0);
#pragma unroll
      for (int i = 0; i < D; i++) sum += nodes.moment[e][i] * flux[i];
      if (nodes.row[e] >= 0 && scaled != T(0)) atomicAdd(k.product() + nodes.row[e], sum);
    }
  }
};

// Adds every `stride`-th of the packed particles [first, end), which have left their base block. Each lane finds one,
// so that its loads do not wait for those of others.
template <int Order, class T, int D>
__device__ void add_out_of_block(const SimpleKernel<Order, T, D>& k, int first, int end, int stride, int scene,
                                 const Directions<T, D>& directions) {
  for (int start = first; start < end; start += 32 * stride) {
    WarpAddition<Order, T, D> warp{k, directions};
    const int i = start + lane_index() * stride;
    if (i < end) {
      const PackedParticle<T, D> q = k.packed.particles[i];
      const Vector<T, D> x = read_vector(k.x, reinterpret_cast<const int&>(q.f[0]));
      warp.slot = locate_slot<Order>(k.topology(), scene, x, warp.base, warp.f);
      warp.conductance = q.conductance;
    }
    for (unsigned lanes = __ballot_sync(~0u, warp.slot >= 0); lanes;) warp.add_some(lanes);
  }
}

// The values u of a product.
template <class T, int D, class F>
__device__ void with_values(const HeatSimpleArguments<T, D>& a, const Directions<T, D>& directions, const F& f) {
  if (a.step == 0)
    f(StartValues<T, D>{a.solve});
  else
    f(directions);
}

// Particles of an item that are in their base block, by all lanes of a warp.
template <class S, class T, int D>
__device__ int count_in_block(const PackedItems<T, D>& packed, int number) {
  int count = 0;
  for (int c = lane_index(); c < S::cells; c += 32) count += packed.counts[int64_t(number) * S::cells + c];
  return __reduce_add_sync(~0u, count);
}

// Calls f(number, item, scene, directions) for each item of a scene that takes this step, from number `first` on.
template <int Order, class T, int D, class F>
__device__ void for_items_of_step(const SimpleKernel<Order, T, D>& k, int first, int stride, const F& f) {
  const Topology<T, D>& t = k.topology();
  if (t.scenes == 1 && simple_steps(k.a.solve, 0) <= k.a.step) return;
  const int count = k.items();
  for (int i = first; i < count; i += stride) {
    const Item item = k.item(i);
    const int steps = k.steps_of(item);
    if (steps <= k.a.step) continue;
    const int scene = scene_of(t, item.block);
    f(i, item, scene, Directions<T, D>(k.a, scene, steps));
  }
}

// The sums of several warps for a quad of the tile.
template <int Warps, class T, int N>
__device__ Vec4<T> sum_of_warps(const T (*sums)[N], int at) {
  Vec4<T> sum = load_vec4(sums[0] + at);
#pragma unroll
  for (int warp = 1; warp < Warps; warp++) sum += load_vec4(sums[warp] + at);
  return sum;
}

// Number of particles out of the base block of an item that another thread block adds, where several warps share an
// item: a chain of loads leads to the nodes of each, which takes as long as the product of the others.
template <int Warps>
constexpr int kApart = Warps > 1 ? 8 : 0;

// Least number of thread blocks of a multiprocessor; of many items as many threads as in csrc/heat/heat.cu.
template <int Warps, int Order, class T>
constexpr int kProductBlocks = Order != 2 || sizeof(T) != 4 ? 2
                               : Warps == 1                 ? 5
                                                            : 4;

// Barrier of the warps that share an item.
template <int Warps>
__device__ void wait_for_warps() {
  Warps == 1 ? __syncwarp() : __syncthreads();
}

// Loads the values u of the nodes of a tile.
template <class Quads, class T, int D>
__device__ void load_values(const HeatSimpleArguments<T, D>& a, const Directions<T, D>& directions, const Quads& quads,
                            T* values) {
  with_values(a, directions, [&](const auto& u) {
    Vec4<T> loaded[Quads::rounds];
#pragma unroll
    for (int r = 0; r < quads.rounds; r++) loaded[r] = quads.node[r] < 0 ? Vec4<T>{} : u.at(quads.node[r]);
#pragma unroll
    for (int r = 0; r < quads.rounds; r++)
      if (quads.in_tile(r)) store_vec4(values + quads.at[r], loaded[r]);
  });
}

// Product of the particles of item i that are in their base block, by `Warps` warps.
template <bool InOrder, int Warps, int Order, class T, int D>
__device__ void multiply_in_block(const SimpleKernel<Order, T, D>& k, int i, const Item& item, int warp,
                                  const Directions<T, D>& directions, T* values,
                                  T (*sums)[HeatShape<Order, T, D>::tile]) {
  using S = HeatShape<Order, T, D>;
  const auto walk_of = [&](int number, int begin) {
    const LaneCounts<S> counts(k.packed.counts + int64_t(number) * S::cells);
    return CellWalk<S, Warps, T, D>(counts, k.packed.particles + begin, warp);
  };
  const TileQuads<S, 32 * Warps> quads(k.topology(), item.slot);
  const auto load = [&] {
    load_values(k.a, directions, quads, values);
    for (int n = lane_index(); n < S::tile / 4; n += 32) store_vec4(sums[warp] + 4 * n, Vec4<T>{});
    wait_for_warps<Warps>();
  };
  // Of few items, whose warps do not hide the loads of each other, the first particles are loaded beside the nodes.
  if constexpr (Warps > 1) {
    const CellWalk<S, Warps, T, D> walk = walk_of(i, item.begin);
    load();
    sum_cells<HeatSum::product>(walk, values, sums[warp]);
  } else {
    load();
    const int end = InOrder ? k.topology().offsets[item.slot + 1] : item.end;
    for (int number = i, begin = item.begin; begin < end; begin = k.item(number++).end)
      sum_cells<HeatSum::product>(walk_of(number, begin), values, sums[warp]);
  }
  wait_for_warps<Warps>();
#pragma unroll
  for (int r = 0; r < quads.rounds; r++) {
    if (!quads.in_tile(r) || (!InOrder && quads.node[r] < 0)) continue;
    const Vec4<T> sum = sum_of_warps<Warps>(sums, quads.at[r]);
    if (InOrder)
      store_vec4(k.packed.tiles + int64_t(item.slot) * k.packed.kTile + quads.at[r], sum);
    else if (!is_zero(sum))
      add_quad(k.product() + quads.node[r], sum);
  }
  wait_for_warps<Warps>();
}

// One or several warps for each item share the nodes, and the particles of each cell. `InOrder`: for each base block,
// with all of its items. The first `blocks` thread blocks process the items; those after them, a warp for each item,
// the particles that are apart.
template <bool InOrder, int Warps, int Order, class T, int D>
__global__ void __launch_bounds__(kProductThreads, kProductBlocks<Warps, Order, T>)
    product_kernel(const __grid_constant__ SimpleKernel<Order, T, D> k, int blocks) {
  using S = typename SimpleKernel<Order, T, D>::S;
  static_assert(!InOrder || Warps == 1);
  constexpr int together = kProductWarps / Warps;  // items of a thread block
  constexpr int apart = kApart<Warps>;
  grid_dependency_sync();
  __shared__ alignas(16) T values_of_items[together][S::tile];
  __shared__ alignas(16) T sums_of_warps[kProductWarps][S::tile];
  const int number = int(threadIdx.x) / 32, warp = number % Warps, own = number / Warps;
  const bool is_apart = apart > 0 && int(blockIdx.x) >= blocks;
  const int first = is_apart ? (int(blockIdx.x) - blocks) * kProductWarps + number : int(blockIdx.x) * together + own,
            stride = is_apart ? (int(gridDim.x) - blocks) * kProductWarps : blocks * together;
  for_items_of_step(k, first, stride, [&](int i, const Item& item, int scene, const Directions<T, D>& directions) {
    if (InOrder && item.begin != k.topology().offsets[item.slot]) return;
    if (!is_apart)
      multiply_in_block<InOrder, Warps>(k, i, item, warp, directions, values_of_items[own],
                                        sums_of_warps + own * Warps);
    if (InOrder) return;
    const int out = item.begin + count_in_block<S>(k.packed, i), rest = out + apart;
    add_out_of_block(k, is_apart ? out : rest + warp, is_apart ? ::min(rest, item.end) : item.end, is_apart ? 1 : Warps,
                     scene, directions);
  });
}

// The product at four nodes of a row of a block from the tiles that have them.
template <int Order, class T, int D>
__device__ Vec4<T> sum_of_tiles(const SimpleKernel<Order, T, D>& k, int scene, const int (&block)[D],
                                const int (&node)[D]) {
  using S = typename SimpleKernel<Order, T, D>::S;
  Vec4<T> sum{};
  for_base_blocks(k.topology(), scene, block, [&](int slot, int before) {
    const int row = row_of_tile<S::width>(node, before);
    if (row < 0) return;
    const int first = D == 2 ? row * S::row : row / S::width * S::plane + row % S::width * S::row;
    const int at = first + (before & 1) * kBlockWidth;
    sum += load_vec4(k.packed.tiles + int64_t(slot) * k.packed.kTile + at);
  });
  return sum;
}

// Stores the products of the tiles at the nodes, a thread for each row of four.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kTileThreads) add_tiles_kernel(const __grid_constant__ SimpleKernel<Order, T, D> k) {
  grid_dependency_sync();
  at_row_of_nodes(k.topology(), int(blockIdx.x) * kTileThreads + int(threadIdx.x),
                  [&](int scene, const int (&block)[D], const int (&node)[D], int64_t first) {
                    if (simple_steps(k.a.solve, scene) > k.a.step)
                      store_vec4(k.product() + first, sum_of_tiles(k, scene, block, node));
                  });
}

template <bool InOrder, int Warps, int Order, class T, int D>
void multiply(const SimpleKernel<Order, T, D>& kernel, int64_t items, Stream stream) {
  constexpr int together = kProductWarps / Warps;
  // Most scenes need no third step, and then each thread block costs time.
  const int64_t few = int64_t(device_attribute(cudaDevAttrMultiProcessorCount)) * 8,
                all = (items + together - 1) / together;
  const unsigned blocks = grid_size(kernel.a.step < 2 ? all : std::min(all, few)),
                 apart = kApart<Warps> > 0 ? (blocks + kProductWarps - 1) / kProductWarps : 0;
  launch_in_chain(product_kernel<InOrder, Warps, Order, T, D>, blocks + apart, kProductThreads, 0, stream, kernel,
                  int(blocks));
}

template <int Order, class T, int D>
void pack(const SimpleKernel<Order, T, D>& kernel, int64_t items, const HeatNodesArguments<T, D>& nodes,
          Stream stream) {
  const unsigned blocks = grid_size(items), of_nodes = unsigned((nodes.means.nodes + kPackThreads - 1) / kPackThreads);
  launch_in_chain(pack_kernel<Order, T, D>, blocks + of_nodes, kPackThreads, 0, stream, kernel, nodes, blocks);
}

}  // namespace

template <int Order, class T, int D>
void heat_pack(const HeatPackArguments<T, D>& a, Stream stream) {
  const Topology<T, D>& t = a.simple.solve.topology;
  pack(SimpleKernel<Order, T, D>(a.simple), most_items(t.max_blocks, t.particles), a.nodes, stream);
}

template <int Order, class T, int D>
void heat_simple_step(const HeatSimpleArguments<T, D>& a, Stream stream) {
  const SimpleKernel<Order, T, D> kernel(a);
  const Topology<T, D>& t = a.solve.topology;
  const int64_t items = most_items(t.max_blocks, t.particles);
  if (items == 0) return;
  if (a.solve.deterministic) {
    const unsigned of_warps = grid_size(items / kProductWarps + 1);
    if (!a.packed) launch_in_chain(pack_in_order_kernel<Order, T, D>, of_warps, kProductThreads, 0, stream, kernel);
    multiply<true, 1>(kernel, items, stream);
    return launch_in_chain(add_tiles_kernel<Order, T, D>, blocks_for_rows(t, 1), kTileThreads, 0, stream, kernel);
  }
  if (!a.packed) pack(kernel, items, {}, stream);
  // Of few items, which leave most of a device idle, several warps process one.
  const bool few = items <= int64_t(device_attribute(cudaDevAttrMultiProcessorCount)) * 16;
  few ? multiply<false, kProductWarps>(kernel, items, stream) : multiply<false, 1>(kernel, items, stream);
}

MPM_INSTANTIATE_ORDERS(heat_simple_step, HeatSimpleArguments)
MPM_INSTANTIATE_ORDERS(heat_pack, HeatPackArguments)

}  // namespace mpm::cuda
