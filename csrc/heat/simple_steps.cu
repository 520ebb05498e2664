#include "cuda/launch.cuh"
#include "cuda/programmatic_launch.cuh"
#include "heat/kernels.h"
#include "heat/operator.cuh"

// The simple steps of heat (csrc/heat/solve.h): a thread block packs the particles of an item, unless G2P has done
// that, and then a warp sums the products H u of an item. Unlike csrc/heat/heat.cu this needs no barriers of the whole
// grid, and particles may have left their base block since the activation. Those are at the end of the packed particles
// of their item.
namespace mpm::cuda {
namespace {

constexpr int kPackThreads = 192, kEachPacked = kItemParticles / kPackThreads;
constexpr int kProductThreads = 128;
static_assert(kEachPacked * kPackThreads == kItemParticles);

template <int Order, class T, int D>
struct SimpleKernel {
  using S = HeatShape<Order, T, D>;
  HeatSimpleArguments<T, D> a;
  PackedItems<T, D> packed;
  Columns<const T, D> x;
  Columns<const T, 1> conductance;
  int warps_of_item;  // in a product: one, or one for each part of a block

  explicit SimpleKernel(const HeatSimpleArguments<T, D>& a)
      : a(a), packed(packed_in(a.solve.workspace, a.solve.topology)), x(a.solve.x), conductance(a.solve.conductance) {}

  __device__ const Topology<T, D>& topology() const { return a.solve.topology; }
  __device__ Item item(int i) const { return reinterpret_cast<const Item*>(schedule_of(topology()).items)[i]; }
  __device__ int items() const { return *schedule_of(topology()).item_count; }
  __device__ int steps_of(const Item& item) const { return simple_steps(a.solve, scene_of(topology(), item.block)); }
  __device__ T* product() const { return a.product[a.step]; }
};

template <int Order, class T, int D>
__global__ void __launch_bounds__(kPackThreads) pack_kernel(const __grid_constant__ SimpleKernel<Order, T, D> k) {
  using S = typename SimpleKernel<Order, T, D>::S;
  grid_dependency_sync();
  __shared__ PackedOrder<S> m;
  __shared__ BaseBlock<T, D> home;
  const Topology<T, D>& t = k.topology();
  const int count = k.items();
  for (int i = blockIdx.x; i < count; i += gridDim.x) {
    const Item item = k.item(i);
    if (k.steps_of(item) == 0) continue;
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

// Directions of a step of a scene.
template <class T, int D>
struct Directions {
  const HeatSimpleArguments<T, D>& a;
  int steps;
  double c, dt;

  __device__ Directions(const HeatSimpleArguments<T, D>& a, int scene, int steps)
      : a(a), steps(steps), c(bound_of_scene(a.solve, scene)), dt(step_of_scene(a.solve, scene)) {}
  __device__ T of(int64_t node) const { return simple_direction(a, node, steps, c, dt); }
  __device__ Vec4<T> at(int node) const {
    Vec4<T> u;
#pragma unroll
    for (int k = 0; k < kBlockWidth; k++) u.e[k] = of(node + k);
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

// As many threads as in csrc/heat/heat.cu.
template <int Order, class T>
constexpr int kProductBlocks = Order == 2 && sizeof(T) == 4 ? 5 : 2;

template <int Order, class T, int D>
__global__ void __launch_bounds__(kProductThreads, kProductBlocks<Order, T>)
    product_kernel(const __grid_constant__ SimpleKernel<Order, T, D> k) {
  using S = typename SimpleKernel<Order, T, D>::S;
  grid_dependency_sync();
  __shared__ WarpMemory<S> memory[kProductThreads / 32];
  WarpMemory<S>& own = memory[threadIdx.x / 32];
  const Topology<T, D>& t = k.topology();
  constexpr int warps = kProductThreads / 32;
  if (t.scenes == 1 && simple_steps(k.a.solve, 0) <= k.a.step) return;
  const int each = k.warps_of_item, count = k.items() * each;
  for (int n = int(blockIdx.x) * warps + int(threadIdx.x) / 32; n < count; n += gridDim.x * warps) {
    const int i = n / each, part = n % each;
    const Item item = k.item(i);
    const int steps = k.steps_of(item);
    if (steps <= k.a.step) continue;
    const int scene = scene_of(t, item.block), only = each > 1 ? part : -1;
    const Directions<T, D> directions(k.a, scene, steps);
    if (k.a.step == 0)
      sum_items<HeatSum::product, S>(t, k.packed, i, i + 1, StartValues<T, D>{k.a.solve}, k.product(), false, own,
                                     only);
    else
      sum_items<HeatSum::product, S>(t, k.packed, i, i + 1, directions, k.product(), false, own, only);
    int in_block = 0;
    for (int c = lane_index(); c < S::cells; c += 32) in_block += k.packed.counts[int64_t(i) * S::cells + c];
    in_block = __reduce_add_sync(~0u, in_block);
    add_out_of_block(k, item.begin + in_block + part, item.end, each, scene, directions);
    __syncwarp();
  }
}

}  // namespace

template <int Order, class T, int D>
void heat_simple_step(const HeatSimpleArguments<T, D>& a, Stream stream) {
  constexpr int64_t few = 1 << 18;  // particles whose items are fewer than the warps of a device
  SimpleKernel<Order, T, D> kernel(a);
  kernel.warps_of_item = a.solve.topology.particles < few ? HeatShape<Order, T, D>::parts : 1;
  const int64_t items = most_items(a.solve.topology.max_blocks, a.solve.topology.particles);
  if (items == 0) return;
  if (!a.packed) launch_in_chain(pack_kernel<Order, T, D>, grid_size(items), kPackThreads, 0, stream, kernel);
  launch_in_chain(product_kernel<Order, T, D>, grid_size(items * kernel.warps_of_item / (kProductThreads / 32) + 1),
                  kProductThreads, 0, stream, kernel);
}

MPM_INSTANTIATE_ORDERS(heat_simple_step, HeatSimpleArguments)

}  // namespace mpm::cuda
