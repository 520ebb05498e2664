#pragma once

#include <climits>

#include "cuda/base_block.cuh"
#include "cuda/columns.cuh"
#include "cuda/programmatic_launch.cuh"
#include "heat/cell.h"
#include "heat/solve.h"
#include "heat/sums.cuh"

// Heat solve of small scenes, one thread block each: every scene has its own number of iterations, and no barrier is
// wider than a block. The nodes of the box around a scene are renumbered; p and H p lie in shared memory, vectors that
// only the thread of a node reads in global memory. Larger scenes are left to the kernel of csrc/heat/heat.cu.
//
// H is applied by lanes, one occupied cell each. The block adds the contributions of the cells one node of every cell
// at a time: the nodes of different cells differ, so that every sum has a fixed order.
namespace mpm::cuda {

struct SceneCell {
  int corner, begin;  // base node in the box; its particles are packed[begin, begin of the next)
};

// Work space in global memory, beside that of csrc/heat/heat.cu.
struct SceneWorkspace {
  int* order;        // [P] particles by cell
  SceneCell* cells;  // [P + scenes]
  bool* left;        // [scenes] too large
};

// Threads whose registers fill a multiprocessor.
template <int Order, class T>
constexpr int kSceneThreads = Order == 2 && sizeof(T) == 4 ? 640 : 256;

template <int D>
struct NodeBox {
  int low[D], extent[D];

  __device__ int64_t size() const {
    int64_t n = 1;
#pragma unroll
    for (int i = 0; i < D; i++) n *= extent[i];
    return n;
  }
  __device__ bool contains(const int* node) const {
    bool inside = true;
#pragma unroll
    for (int i = 0; i < D; i++) inside = inside && unsigned(node[i] - low[i]) < unsigned(extent[i]);
    return inside;
  }
  __device__ int index(const int* node) const {
    int r = 0;
#pragma unroll
    for (int i = 0; i < D; i++) r = r * extent[i] + node[i] - low[i];
    return r;
  }
  __device__ void node_at(int index, int* node) const {
#pragma unroll
    for (int i = D - 1; i >= 0; i--) {
      node[i] = low[i] + index % extent[i];
      index /= extent[i];
    }
  }
  // f(k, i): node k of a support is node i of the box.
  template <int Order, class F>
  __device__ void for_support(int corner, const F& f) const {
    constexpr int support = Order + 1;
    const int y = extent[D - 1], x = D == 3 ? extent[D - 2] * y : 0;
#pragma unroll
    for (int i = 0; i < (D == 3 ? support : 1); i++)
#pragma unroll
      for (int j = 0; j < support; j++)
#pragma unroll
        for (int k = 0; k < support; k++) f((i * support + j) * support + k, corner + i * x + j * y + k);
  }
};

// First of `count` entries that is not below, found by a warp; entries below come first.
template <class Below>
__device__ int first_not_below(int count, const Below& below) {
  int low = 0, end = count;
  while (low < end) {
    const int step = (end - low + 31) / 32, i = low + lane_index() * step;
    const int n = __popc(__ballot_sync(~0u, i < end && below(i)));
    if (n == 0) break;
    end = min(end, low + n * step);
    low += (n - 1) * step + 1;
  }
  return low;
}

// Calls each(particle) for `count` particles of every lane; load(at, rank) returns the particle at `at` in the packed
// order, in which those of rank 0 of all lanes come first.
template <class Load, class Each>
__device__ void walk_lanes(int count, int at, const Load& load, const Each& each) {
  const unsigned before = (1u << lane_index()) - 1;
  bool has = count > 0;
  unsigned lanes = __ballot_sync(~0u, has);
  decltype(load(0, 0)) next;
  if (has) next = load(at + __popc(lanes & before), 0);
#pragma unroll 1
  for (int rank = 1; lanes; rank++) {
    const auto now = next;
    const bool had = has;
    at += __popc(lanes);
    has = count > rank;
    lanes = __ballot_sync(~0u, has);
    if (has) next = load(at + __popc(lanes & before), rank);
    if (had) each(now);
  }
}

template <int Order, class T, int D>
struct SceneKernel {
  HeatArguments<T, D> a;
  PackedParticle<T, D>* packed;
  HeatVectors<T> v;
  SceneWorkspace w;
  Columns<const T, D> x;
  Columns<const T, 1> conductance;
  int most_nodes, most_particles;  // of a small scene
};

// Shared values of the threads of a block.
template <int D>
struct SceneState {
  int slot, slot_end, used;  // slots of the scene, and of all scenes
  int low[D], high[D];       // of the box
  int cells;
  HeatScene scene;
};

// One scene by one thread block; a node belongs to thread index % threads.
template <int Order, class T, int D>
struct SceneSolver {
  const SceneKernel<Order, T, D>& k;
  const Topology<T, D>& t;
  SceneState<D>& s;
  const int scene;
  T *const p, *const product;  // in shared memory
  int begin, end;              // particles, in the order of the index tensor
  NodeBox<D> box;
  int nodes;
  HeatVectors<T> v;
  T* d;
  SceneCell* cells;

  __device__ SceneSolver(const SceneKernel<Order, T, D>& k, SceneState<D>& s, int scene, T* shared)
      : k(k), t(k.a.topology), s(s), scene(scene), p(shared), product(shared + k.most_nodes) {}

  __device__ static int warps() { return blockDim.x / 32; }
  __device__ static int warp_index() { return threadIdx.x / 32; }

  __device__ void find_range() {
    for (int number = warp_index(); number < 3; number += warps()) {
      const int wanted = number < 2 ? scene + number : t.scenes;
      const int slot = first_not_below(near_blocks(k.a), [&](int i) {
        return t.block[i] >= 0 && t.block[i] / t.geometry.blocks_per_scene < wanted;
      });
      if (lane_index() == 0) (number == 0 ? s.slot : number == 1 ? s.slot_end : s.used) = slot;
    }
    if (threadIdx.x < D) {
      s.low[threadIdx.x] = INT_MAX;
      s.high[threadIdx.x] = INT_MIN;
    }
    __syncthreads();
    begin = t.offsets[s.slot];
    end = t.offsets[s.slot_end];
    cells = k.w.cells + begin + scene;
    const int64_t first = int64_t(s.slot) * kBlockNodes<D>;
    v = {k.v.mass + first, k.v.weight + first, k.v.inverse + first, k.v.r + first, p, product};
    d = k.v.p + first;
  }

  // Unused rows, shared among the scenes.
  __device__ void clear_unused() const {
    const int64_t last = int64_t(t.max_blocks) * kBlockNodes<D>, stride = int64_t(gridDim.x) * blockDim.x;
    int64_t row = int64_t(s.used) * kBlockNodes<D> + int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
    for (; row < last; row += stride) k.a.increment[row] = T(0);
  }

  template <class F>
  __device__ void for_nodes(const F& f) const {
    for (int i = threadIdx.x; i < nodes; i += blockDim.x) f(i);
  }
  template <class F>
  __device__ void for_rows(const F& f) const {
    for (int row = s.slot * kBlockNodes<D> + int(threadIdx.x); row < s.slot_end * kBlockNodes<D>; row += blockDim.x)
      f(row);
  }
  __device__ void node_of_row(int row, int* node) const {
    block_coordinates(t.geometry, t.block[row / kBlockNodes<D>], node);
#pragma unroll
    for (int i = D - 1, rest = row % kBlockNodes<D>; i >= 0; i--, rest /= kBlockWidth)
      node[i] = node[i] * kBlockWidth + rest % kBlockWidth;
  }
  // -1 where no block is active.
  __device__ int row_of(int i) const {
    int node[D], block[D];
    box.node_at(i, node);
#pragma unroll
    for (int axis = 0; axis < D; axis++) block[axis] = node[axis] / kBlockWidth;
    const int slot = t.table[block_index(t.geometry, scene, block)];
    return slot < 0 ? -1 : slot * kBlockNodes<D> + node_in_block<D>(node);
  }

  // Base node of particle p and distances from it. False for a particle outside its base block: its position is not
  // that of the activation.
  __device__ bool locate_particle(const Vector<T, D>& position, int base_block, int* base, T* f) const {
    const bool inside = locate<Order>(t.geometry, position.e, base, f);
    int block[D];
#pragma unroll
    for (int i = 0; i < D; i++) block[i] = base[i] / kBlockWidth;
    return inside && block_index(t.geometry, scene, block) == base_block;
  }
  __device__ int base_block_of(int particle) const { return t.block[schedule_of(t).base_slot[particle]]; }
  // f(particle, base node) for the particles in their base block, by any thread.
  template <class F>
  __device__ void for_particles(const F& f) const {
    constexpr int batch = 4;  // loads in flight
    for (int first = begin + int(threadIdx.x); first < end; first += batch * blockDim.x) {
      int particle[batch], base_block[batch];
      Vector<T, D> position[batch];
#pragma unroll
      for (int n = 0; n < batch; n++) particle[n] = t.index[min(first + n * int(blockDim.x), end - 1)];
#pragma unroll
      for (int n = 0; n < batch; n++) {
        position[n] = read_vector(k.x, particle[n]);
        base_block[n] = base_block_of(particle[n]);
      }
#pragma unroll
      for (int n = 0; n < batch; n++) {
        int base[D];
        T distance[D];
        if (first + n * int(blockDim.x) < end && locate_particle(position[n], base_block[n], base, distance))
          f(particle[n], base);
      }
    }
  }

  // The box around the supports of the particles and the nodes with heat capacity. False if the scene is too large.
  __device__ bool set_box() {
    if (end - begin > k.most_particles) return false;
    int low[D], high[D];
#pragma unroll
    for (int i = 0; i < D; i++) {
      low[i] = INT_MAX;
      high[i] = INT_MIN;
    }
    const auto include = [&](const int* node, int width) {
#pragma unroll
      for (int i = 0; i < D; i++) {
        low[i] = min(low[i], node[i]);
        high[i] = ::max(high[i], node[i] + width);
      }
    };
    for_particles([&](int, const int* base) { include(base, Order + 1); });
    for_rows([&](int row) {
      if (capacity_at(k.a, row) <= T(0)) return;
      int node[D];
      node_of_row(row, node);
      include(node, 1);
    });
#pragma unroll
    for (int i = 0; i < D; i++) {
      const int least = __reduce_min_sync(~0u, low[i]), most = __reduce_max_sync(~0u, high[i]);
      if (lane_index() == 0) {
        atomicMin(&s.low[i], least);
        atomicMax(&s.high[i], most);
      }
    }
    __syncthreads();
#pragma unroll
    for (int i = 0; i < D; i++) {
      box.low[i] = s.low[i];
      box.extent[i] = s.high[i] < s.low[i] ? 0 : s.high[i] - s.low[i];
    }
    const int64_t size = box.size(), room = int64_t(s.slot_end - s.slot) * kBlockNodes<D>;
    nodes = int(size);
    return size <= min(int64_t(k.most_nodes), room);
  }

  // Lists the occupied cells; `count` of a cell becomes the index of its first particle.
  __device__ void list_cells(int* count) {
    const int share = (nodes + int(blockDim.x) - 1) / int(blockDim.x);
    const int first = min(nodes, int(threadIdx.x) * share), last = min(nodes, first + share);
    int64_t sums = 0;  // of particles, and of cells in the upper half
    for (int i = first; i < last; i++) sums += count[i] + (int64_t(count[i] > 0) << 32);
    sums = sum_before(sums);
    int at = begin + int(sums), number = int(sums >> 32);
    for (int i = first; i < last; i++) {
      const int here = count[i];
      if (here == 0) continue;
      cells[number++] = {i, at};
      count[i] = at;
      at += here;
    }
    if (threadIdx.x == blockDim.x - 1) {
      cells[number] = {0, at};
      s.cells = number;
    }
    __syncthreads();
  }

  // Writes the particles of every cell to `order` one after another, in the order of the index tensor, by the warps in
  // turn.
  __device__ void order_in_turn(int* next) const {
    for (int first = begin; first < end; first += blockDim.x) {
      const int at = first + int(threadIdx.x), particle = at < end ? t.index[at] : -1;
      int base[D], corner = -1;
      T f[D];
      if (particle >= 0 && locate_particle(read_vector(k.x, particle), base_block_of(particle), base, f))
        corner = box.index(base);
      for (int turn = 0; turn < warps(); turn++) {
        if (warp_index() == turn) {
          const unsigned group = __match_any_sync(~0u, corner);
          const int before = __popc(group & ((1u << lane_index()) - 1)), place = corner < 0 ? 0 : next[corner];
          __syncwarp();
          if (corner >= 0) {
            k.w.order[place + before] = particle;
            if (before == 0) next[corner] = place + __popc(group);
          }
        }
        __syncthreads();
      }
    }
  }

  // f(number of the lane's cell, its first particle and their number, start of the particles of the lanes) for all
  // cells, 32 neighbours by a warp; `done` is called after every round by all threads.
  template <class F, class Done>
  __device__ void for_cells(const F& f, const Done& done) const {
    for (int first = 0; first < s.cells; first += blockDim.x) {
      const int number = first + int(threadIdx.x);
      SceneCell cell{-1, 0};
      if (number - lane_index() < s.cells) {
        int count = 0;
        if (number < s.cells) {
          cell = cells[number];
          count = cells[number + 1].begin - cell.begin;
        }
        f(cell, count, __shfl_sync(~0u, cell.begin, 0));
      }
      done(cell);
    }
  }

  __device__ void pack() {
    int* const count = reinterpret_cast<int*>(p);
    for_nodes([&](int i) { count[i] = 0; });
    __syncthreads();
    for_particles([&](int, const int* base) { atomicAdd(count + box.index(base), 1); });
    __syncthreads();
    list_cells(count);
    if (k.a.deterministic)
      order_in_turn(count);
    else
      for_particles(
          [&](int particle, const int* base) { k.w.order[atomicAdd(count + box.index(base), 1)] = particle; });
    __syncthreads();
    struct Place {
      int at, particle;
    };
    for_cells(
        [&](const SceneCell& cell, int count, int first) {
          walk_lanes(
              count, first, [&](int at, int rank) { return Place{at, k.w.order[cell.begin + rank]}; },
              [&](const Place& place) {
                int base[D];
                PackedParticle<T, D> q;
                locate<Order>(t.geometry, read_vector(k.x, place.particle).e, base, q.f);
                q.conductance = scaled_conductance<Order>(k.conductance.at(place.particle), t.geometry.inverse_dx);
                k.packed[place.at] = q;
              });
        },
        [](const SceneCell&) {});
    __syncthreads();
  }

  // Adds a sum over the particles to the nodes; returns this thread's part of Σ κ V |∇u|².
  template <HeatSum Sum>
  __device__ T sum_cells(const T* u, T* out) const {
    T from[kSupportNodes<Order, D>], to[kSupportNodes<Order, D>], power = T(0);
    for_cells(
        [&](const SceneCell& cell, int count, int first) {
          box.template for_support<Order>(cell.corner, [&](int n, int i) {
            if (Sum == HeatSum::product) from[n] = count > 0 ? u[i] : T(0);
            to[n] = T(0);
          });
          if (Sum == HeatSum::product) to_differences<Order, D>(from);
          walk_lanes(
              count, first, [&](int at, int) { return k.packed[at]; },
              [&](const PackedParticle<T, D>& q) {
                power += add_particle<Sum, Order, T, D>(q.f, q.conductance, from, to);
              });
        },
        [&](const SceneCell& cell) {
          if (Sum == HeatSum::product) to_nodes<Order, D>(to);
          box.template for_support<Order>(cell.corner, [&](int n, int i) {
            if (cell.corner >= 0) out[i] += to[n];
            __syncthreads();
          });
        });
    return power;
  }

  __device__ void start() {
    const HeatArguments<T, D>& a = k.a;
    for_nodes([&](int i) {
      const int row = has_theta(a) ? row_of(i) : -1;
      p[i] = row < 0 ? T(0) : theta_at(a, row);
      product[i] = T(0);
    });
    __syncthreads();
    if (has_theta(a)) sum_cells<HeatSum::product>(p, product);
    for_nodes([&](int i) { p[i] = T(0); });
    __syncthreads();
    const bool chebyshev = a.method == HeatMethod::chebyshev;
    if (chebyshev)
      sum_cells<HeatSum::bound>(nullptr, p);
    else if (simple_steps(a, scene) == 0)
      sum_cells<HeatSum::diagonal>(nullptr, p);
    const double dt = step_of_scene(a, scene);
    auto sums = StartSums<double>::zero();
    for_nodes([&](int i) {
      const int row = row_of(i);
      v.weight[i] = chebyshev ? p[i] : T(0);
      v.inverse[i] = chebyshev ? T(0) : p[i];
      sums.add(start_node(a, v, row, i, dt, row >= 0));
      d[i] = T(0);
    });
    sums = sum_of_block(sums);
    if (threadIdx.x == 0) s.scene = start_scene(a, scene, sums);
    __syncthreads();
  }

  // The last of a few steps without scalar products.
  __device__ void take_last_step() const {
    const T omega = T(s.scene.alpha);
    for_nodes([&](int i) { d[i] += omega * (v.inverse[i] * v.r[i]); });
    __syncthreads();  // all have read the scene
    if (threadIdx.x == 0) finish_simple_steps(k.a, scene, s.scene);
    __syncthreads();
  }

  __device__ void iterate() const {
    if (is_last_simple_step(s.scene)) return take_last_step();
    const HeatMethod method = k.a.method;
    const T beta = T(s.scene.beta), gamma = T(s.scene.gamma);
    Curvature curvature{0};
    for_nodes([&](int i) { curvature.value += direct_node(v, i, beta, gamma); });
    __syncthreads();
    curvature.value += sum_cells<HeatSum::product>(p, product);
    if (method == HeatMethod::conjugate_gradients && s.scene.simple == 0) {
      curvature = sum_of_block(curvature);
      if (threadIdx.x == 0) set_step(s.scene, curvature.value);
      __syncthreads();
      if (!s.scene.running) return;
    }
    const T alpha = T(s.scene.alpha);
    auto sums = StepSums<double>::zero();
    for_nodes([&](int i) { sums.add(update_node(v, d, i, alpha)); });
    if (wants_sums(s.scene, method)) sums = sum_of_block(sums);
    __syncthreads();  // all have read the scene
    if (threadIdx.x == 0) finish_iteration(k.a, scene, s.scene, sums);
    __syncthreads();
  }

  __device__ void finish() const {
    const T shift = T(energy_shift(s.scene));
    for_rows([&](int row) {
      int node[D];
      node_of_row(row, node);
      const int i = box.contains(node) ? box.index(node) : -1;
      k.a.increment[row] = i < 0 || v.mass[i] == T(0) ? T(0) : d[i] + shift;
    });
    if (threadIdx.x == 0) report_scene(k.a, scene, s.scene);
  }
};

template <int Order, class T, int D>
__global__ void __launch_bounds__(kSceneThreads<Order, T>)
    scene_kernel(const __grid_constant__ SceneKernel<Order, T, D> kernel) {
  grid_dependency_sync();
  extern __shared__ __align__(16) unsigned char shared[];
  __shared__ SceneState<D> state;
  const int scene = int(blockIdx.x);
  SceneSolver<Order, T, D> solver(kernel, state, scene, reinterpret_cast<T*>(shared));
  solver.find_range();
  solver.clear_unused();
  if (kernel.a.leaves_simple && simple_steps(kernel.a, scene) > 0) {
    if (threadIdx.x == 0) kernel.w.left[scene] = false;
    return;
  }
  const bool small = solver.set_box();
  if (threadIdx.x == 0) kernel.w.left[scene] = !small;
  if (!small) return;
  solver.pack();
  solver.start();
  while (state.scene.running) solver.iterate();
  solver.finish();
}

constexpr int kFewNodes = 3072, kFewParticles = 8192;  // a scene of at most this size is small in any batch

// Whether scenes are small on average. Few scenes keep the device busy by the grid kernel; many scenes may be larger.
template <class T, int D>
bool small_scenes(const Topology<T, D>& t) {
  const bool many = 4 * int64_t(t.scenes) >= device_attribute(cudaDevAttrMultiProcessorCount);
  return t.scenes > 0 && t.particles <= int64_t(t.scenes) * (many ? 32768 : 4096);
}

// With more scenes than multiprocessors, two share one at once. The requested shared memory is that of scenes of equal
// size with more than a fourth of their rows outside their boxes: the less it is, the larger the cache.
template <int Order, class T, int D>
void solve_scenes(SceneKernel<Order, T, D> kernel, Stream stream) {
  const Topology<T, D>& t = kernel.a.topology;
  const int together = t.scenes > device_attribute(cudaDevAttrMultiProcessorCount) ? 2 : 1;
  const int reserved = 5 * 1024;  // for the system, and for static memory
  const int room = device_attribute(cudaDevAttrMaxSharedMemoryPerMultiprocessor) / together - reserved;
  const int64_t nodes = int64_t(t.max_blocks) * kBlockNodes<D> / t.scenes * 3 / 4;
  kernel.most_nodes = int(std::min<int64_t>(room / (2 * sizeof(T)), std::max<int64_t>(nodes, kFewNodes)));
  kernel.most_particles = int(std::max<int64_t>(kFewParticles, 2 * t.particles / t.scenes));
  kernel.x = Columns<const T, D>(kernel.a.x);
  kernel.conductance = Columns<const T, 1>(kernel.a.conductance);
  launch_in_chain(scene_kernel<Order, T, D>, unsigned(t.scenes), kSceneThreads<Order, T> / together / 32 * 32,
                  kernel.most_nodes * 2 * sizeof(T), stream, kernel);
}

}  // namespace mpm::cuda
