#include <cooperative_groups.h>

#include "cuda/barrier.cuh"
#include "cuda/launch.cuh"
#include "heat/operator.cuh"
#include "heat/scene.cuh"

// The heat solve. Small scenes are solved separately (csrc/heat/scene.cuh), the others here by one persistent kernel:
// all scenes advance together, phase by phase, with a barrier of the whole grid between phases. A finished scene takes
// no further work, and the kernel ends with the last one. The host is not involved, and the kernel can be captured in a
// graph.
namespace mpm::cuda {

namespace cg = cooperative_groups;

// Threads of a block: for a solve as many as fit in a multiprocessor by their registers, so that few wait at barriers.
template <int Order, class T>
constexpr int kHeatThreads = Order == 2 && sizeof(T) == 4 ? 640 : 256;
constexpr int kItemWork = 192;  // of an item beside its particles, in particles: measured by instructions
template <int D>
constexpr int kSlotQuads = kBlockNodes<D> / kBlockWidth;

// Items, slots and thread blocks of a scene; a block processes a contiguous range of items, and of slots.
struct SceneRange {
  int item, item_end, item_block, item_block_end, slot, slot_end, slot_block, slot_block_end;
};

// Thread blocks of one solve; more would have no work.
template <class T, int D>
int64_t most_thread_blocks(const Topology<T, D>& t) {
  return std::max<int64_t>(most_items(t.max_blocks, t.particles), t.max_blocks) / 4 + 1;
}

// Work space in global memory. A part of a sum is the share of one thread block in one scene. Blocks process their
// items and slots in the order of scenes, so that block + scene numbers the parts.
template <class T, int D>
struct HeatWorkspace {
  PackedItems<T, D> packed;
  HeatVectors<T> v;
  StartSums<double>* start;  // [parts], as those below
  StepSums<double>* step;
  Curvature* item_curvature;  // of p · H p
  Curvature* slot_curvature;  // of the other terms of p · A p
  HeatScene* scene[2];        // [scenes] after an update, and before the next one
  SceneRange* range;          // [scenes]
  int* first_item;            // [blocks + 1] of each block
  int* used;                  // [1] slots
  int* running;               // [1] scenes at work
  unsigned* arrived;          // [1] at barriers, thread blocks
  SceneWorkspace apart;       // of small scenes
  int64_t size;               // in bytes

  explicit HeatWorkspace(const HeatArguments<T, D>& a) : apart{}, size(0) {
    const Topology<T, D>& t = a.topology;
    char* const base = static_cast<char*>(a.workspace);
    const auto take = [&](int64_t bytes) {
      char* p = base + size;
      size += align_workspace(bytes);
      return p;
    };
    const int64_t nodes = t.max_blocks * int64_t(kBlockNodes<D>);
    packed.lay_out(t, a.deterministic, take);
    T** const all[] = {&v.mass, &v.weight, &v.inverse, &v.r, &v.p, &v.product};
    for (T** vector : all) *vector = reinterpret_cast<T*>(take(nodes * sizeof(T)));
    const int64_t parts = most_thread_blocks(t) + t.scenes;
    start = reinterpret_cast<StartSums<double>*>(take(parts * sizeof(StartSums<double>)));
    step = reinterpret_cast<StepSums<double>*>(take(parts * sizeof(StepSums<double>)));
    item_curvature = reinterpret_cast<Curvature*>(take(parts * sizeof(Curvature)));
    slot_curvature = reinterpret_cast<Curvature*>(take(parts * sizeof(Curvature)));
    for (HeatScene*& state : scene) state = reinterpret_cast<HeatScene*>(take(t.scenes * sizeof(HeatScene)));
    range = reinterpret_cast<SceneRange*>(take(t.scenes * sizeof(SceneRange)));
    first_item = reinterpret_cast<int*>(take((most_thread_blocks(t) + 1) * sizeof(int)));
    used = reinterpret_cast<int*>(take(sizeof(int)));
    running = reinterpret_cast<int*>(take(sizeof(int)));
    arrived = reinterpret_cast<unsigned*>(take(sizeof(unsigned)));
    if (!small_scenes(t)) return;
    apart.order = reinterpret_cast<int*>(take(t.particles * sizeof(int)));
    apart.cells = reinterpret_cast<SceneCell*>(take((t.particles + t.scenes) * sizeof(SceneCell)));
    apart.left = reinterpret_cast<bool*>(take(t.scenes));
  }
};

// Number of the `count` entries that are below; they come first.
template <class Below>
__device__ int entries_below(int count, const Below& below) {
  int low = 0;
  while (low < count) {
    const int middle = (low + count) / 2;
    if (below(middle))
      low = middle + 1;
    else
      count = middle;
  }
  return low;
}

// Kernel of three phases per iteration with a barrier of the grid after each: directions, product, update. Every thread
// block evaluates the sums of a phase itself, for the scenes of its slots.
template <int Order, class T, int D>
struct HeatKernel {
  using S = HeatShape<Order, T, D>;
  HeatArguments<T, D> a;
  HeatWorkspace<T, D> w;
  Columns<const T, D> x;
  Columns<const T, 1> conductance;

  explicit HeatKernel(const HeatArguments<T, D>& a) : a(a), w(a), x(a.x), conductance(a.conductance) {}

  // Whether the scene is solved here, and not by a single thread block, nor by other kernels.
  __device__ bool takes(int scene) const {
    if (a.leaves_simple && simple_steps(a, scene) > 0) return false;
    return !w.apart.left || w.apart.left[scene];
  }
  __device__ bool takes_any() const {
    bool any = false;
    for (int scene = threadIdx.x; scene < a.topology.scenes && !any; scene += blockDim.x) any = takes(scene);
    return __syncthreads_or(any);
  }

  __device__ void wait_for_all() const { wait_for_blocks(w.arrived, gridDim.x); }

  __device__ const Item* items() const { return reinterpret_cast<const Item*>(schedule_of(a.topology).items); }
  __device__ int scene_of_item(int item) const { return scene_of(a.topology, items()[item].block); }
  __device__ int scene_of_slot(int slot) const { return scene_of(a.topology, a.topology.block[slot]); }

  // Slots of thread blocks: equal numbers.
  __device__ int first_slot(int block) const { return int(int64_t(*w.used) * block / gridDim.x); }
  __device__ int block_of_slot(int slot) const { return int((int64_t(slot + 1) * gridDim.x - 1) / *w.used); }
  // Items of thread blocks: equal work.
  __device__ void lay_out_items(int block) const {
    const int count = *schedule_of(a.topology).item_count;
    const int64_t work = count > 0 ? items()[count - 1].end + int64_t(count) * kItemWork : 0;
    w.first_item[block] = entries_below(
        count, [&](int i) { return (items()[i].begin + int64_t(i) * kItemWork) * gridDim.x < work * block; });
  }
  __device__ int block_of_item(int item) const {
    return entries_below(gridDim.x, [&](int block) { return w.first_item[block + 1] <= item; });
  }
  // Items and slots are in the order of the block table, and so of scenes. A search is a chain of loads, which takes
  // longer than a product of few particles; the ends of the first and of the last scene need none.
  __device__ void lay_out_scene(int scene) const {
    SceneRange& r = w.range[scene];
    const auto item = [&](int s) {
      const int count = *schedule_of(a.topology).item_count;
      if (s == 0 || s == a.topology.scenes) return s == 0 ? 0 : count;
      return entries_below(count, [&](int i) { return scene_of_item(i) < s; });
    };
    const auto slot = [&](int s) {
      if (s == 0) return 0;
      return entries_below(near_blocks(a), [&](int i) { return a.topology.block[i] >= 0 && scene_of_slot(i) < s; });
    };
    r.item = item(scene);
    r.item_end = item(scene + 1);
    r.slot = slot(scene);
    r.slot_end = slot(scene + 1);
    if (scene == a.topology.scenes - 1) *w.used = r.slot_end;
  }
  // After the above are known. Blocks before the first and after the last scene have sums of zero.
  __device__ void lay_out_parts(int scene) const {
    SceneRange& r = w.range[scene];
    const bool last = scene == a.topology.scenes - 1;
    r.item_block = r.slot_block = 0;
    r.item_block_end = r.slot_block_end = 0;
    if (r.item < r.item_end) {
      if (scene > 0) r.item_block = block_of_item(r.item);
      r.item_block_end = last ? int(gridDim.x) : block_of_item(r.item_end - 1) + 1;
    }
    if (r.slot < r.slot_end) {
      r.slot_block = block_of_slot(r.slot);
      r.slot_block_end = block_of_slot(r.slot_end - 1) + 1;
    }
  }

  // f(scene, slot, end, whether they are the first of the scene) for the slots of this thread block, of active scenes.
  template <class F>
  __device__ void for_slots(const F& f) const {
    const int last = first_slot(blockIdx.x + 1);
    for (int slot = first_slot(blockIdx.x), end; slot < last; slot = end) {
      const int scene = scene_of_slot(slot);
      end = min(last, w.range[scene].slot_end);
      if (takes(scene)) f(scene, slot, end, slot == w.range[scene].slot);
    }
  }
  // f(first node) for the quads of slots, one per thread.
  template <class F>
  __device__ static void for_quads(int slot, int end, const F& f) {
    for (int64_t quad = int64_t(slot) * kSlotQuads<D> + threadIdx.x; quad < int64_t(end) * kSlotQuads<D>;
         quad += blockDim.x)
      f(quad * kBlockWidth);
  }
  template <class V>
  __device__ void put_part(V* parts, int scene, const V& of_thread) const {
    const V sum = sum_of_block(of_thread);
    if (threadIdx.x == 0) parts[blockIdx.x + scene] = sum;
  }
  template <class V>
  __device__ static void add_parts(const V* parts, int scene, int block, int end, V& sum) {
    for (block += threadIdx.x; block < end; block += blockDim.x) sum.add(parts[block + scene]);
  }
  // Decision of thread 0, in all threads.
  template <class F>
  __device__ static HeatScene decide(const F& f) {
    __shared__ HeatScene scene;
    __syncthreads();
    if (threadIdx.x == 0) scene = f();
    __syncthreads();
    return scene;
  }

  // Adds a sum over particles to `out`, for active scenes; the parts of p · H p are stored.
  template <HeatSum Sum, class Values, class Wanted>
  __device__ void sum_to(const Values& u, T* out, WarpMemory<S>& memory, const Wanted& wanted) const {
    for (int colour = a.deterministic ? 0 : -1; colour < (a.deterministic ? 1 << D : 0); colour++) {
      const int last = w.first_item[blockIdx.x + 1];
      for (int item = w.first_item[blockIdx.x], end; item < last; item = end) {
        const int scene = scene_of_item(item);
        end = min(last, w.range[scene].item_end);
        if (!wanted(scene)) continue;
        Curvature sum{0};
        for_items(a.topology, item + threadIdx.x / 32, end, blockDim.x / 32, colour, [&](int number, int end) {
          const T power = sum_items<Sum, S>(a.topology, w.packed, number, end, u, out, a.deterministic, memory);
          if (lane_index() == 0) sum.value += double(power);
        });
        if (Sum != HeatSum::product) continue;
        if (colour > 0 && threadIdx.x == 0) sum.add(w.item_curvature[blockIdx.x + scene]);
        put_part(w.item_curvature, scene, sum);
      }
      if (a.deterministic) wait_for_all();
    }
  }

  __device__ void start(WarpMemory<S>& memory) const;
  __device__ void direct(bool first) const;
  // The last of a few steps without scalar products.
  __device__ void take_last_step(const T& omega, int slot, int end) const {
    for_quads(slot, end, [&](int64_t i) {
      const Vec4<T> inverse = load_vec4(w.v.inverse + i), r = load_vec4(w.v.r + i);
      Vec4<T> increment = load_vec4(a.increment + i);
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++) increment.e[k] += omega * (inverse.e[k] * r.e[k]);
      store_vec4(a.increment + i, increment);
    });
  }
  __device__ void product(WarpMemory<S>& memory) const {
    sum_to<HeatSum::product>(StoredValues<T>{w.v.p}, w.v.product, memory,
                             [&](int scene) { return w.scene[1][scene].running; });
    wait_for_all();
  }
  __device__ void update() const;
  __device__ void finish() const;
};

template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::start(WarpMemory<S>& memory) const {
  const Topology<T, D>& t = a.topology;
  const int64_t threads = int64_t(gridDim.x) * blockDim.x, thread = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  const auto all = [&](int scene) { return takes(scene); };
  for (int64_t quad = thread; quad < int64_t(t.max_blocks) * kSlotQuads<D>; quad += threads) {
    T* const vectors[] = {w.v.product, w.v.inverse, w.v.weight};
#pragma unroll
    for (T* vector : vectors) store_vec4(vector + quad * kBlockWidth, Vec4<T>{});
  }
  for (int64_t scene = thread; scene < t.scenes; scene += threads) {
    lay_out_scene(int(scene));
    w.scene[1][scene].running = false;
  }
  for (int64_t block = thread; block <= gridDim.x; block += threads) lay_out_items(int(block));
  for (int64_t part = thread; part < gridDim.x + t.scenes; part += threads) {
    w.start[part] = StartSums<double>::zero();
    w.step[part] = StepSums<double>::zero();
    w.item_curvature[part] = w.slot_curvature[part] = {0};
  }
  if (thread == 0) *w.running = *w.arrived = 0;
  for_items(t, -1, [&](int i, int) {
    if (takes(scene_of_item(i))) pack_item<S>(t, x, conductance, items()[i], i, w.packed, memory);
  });
  cg::this_grid().sync();
  for (int64_t scene = thread; scene < t.scenes; scene += threads) lay_out_parts(int(scene));
  if (has_theta(a)) sum_to<HeatSum::product>(StartValues<T, D>{a}, w.v.product, memory, all);
  if (a.method == HeatMethod::chebyshev)
    sum_to<HeatSum::bound>(StoredValues<T>{}, w.v.weight, memory, all);
  else
    sum_to<HeatSum::diagonal>(StoredValues<T>{}, w.v.inverse, memory,
                              [&](int scene) { return takes(scene) && simple_steps(a, scene) == 0; });
  wait_for_all();
  for_slots([&](int scene, int slot, int end, bool) {
    const double dt = step_of_scene(a, scene);
    auto sums = StartSums<double>::zero();
    for_quads(slot, end, [&](int64_t i) {
      Vec4<T> mass, weight = load_vec4(w.v.weight + i), inverse = load_vec4(w.v.inverse + i), r, p;
      Vec4<T> product = load_vec4(w.v.product + i);
      const HeatVectors<T> v{mass.e, weight.e, inverse.e, r.e, p.e, product.e};
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++) sums.add(start_node(a, v, i + k, k, dt, true));
      store_vec4(w.v.mass + i, mass);
      store_vec4(w.v.weight + i, weight);
      store_vec4(w.v.inverse + i, inverse);
      store_vec4(w.v.r + i, r);
      store_vec4(w.v.p + i, p);
      store_vec4(w.v.product + i, product);
      store_vec4(a.increment + i, Vec4<T>{});
    });
    put_part(w.start, scene, sums);
  });
  for (int64_t quad = int64_t(*w.used) * kSlotQuads<D> + thread; quad < int64_t(t.max_blocks) * kSlotQuads<D>;
       quad += threads)
    store_vec4(a.increment + quad * kBlockWidth, Vec4<T>{});
  wait_for_all();
}

// The decision after an update, and the next direction.
template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::direct(bool first) const {
  for_slots([&](int scene, int slot, int end, bool owner) {
    const SceneRange range = w.range[scene];
    HeatScene s;
    if (first) {
      auto sums = StartSums<double>::zero();
      add_parts(w.start, scene, range.slot_block, range.slot_block_end, sums);
      sums = sum_of_block(sums);
      s = decide([&] { return start_scene(a, scene, sums); });
    } else {
      s = w.scene[0][scene];
      if (s.running) {
        auto sums = StepSums<double>::zero();
        if (wants_sums(s, a.method)) add_parts(w.step, scene, range.slot_block, range.slot_block_end, sums);
        sums = sum_of_block(sums);
        s = decide([&] {
          HeatScene next = s;
          finish_iteration(a, scene, next, sums);
          return next;
        });
        if (owner && threadIdx.x == 0 && !s.running) atomicSub(w.running, 1);
      }
    }
    const bool last = is_last_simple_step(s);
    if (last) finish_simple_steps(a, scene, s);
    if (owner && threadIdx.x == 0) {
      if (first && s.running) atomicAdd(w.running, 1);
      if (!first && last) atomicSub(w.running, 1);
      w.scene[1][scene] = s;
    }
    if (last) return take_last_step(T(s.alpha), slot, end);
    if (!s.running) return;
    const T beta = T(s.beta), gamma = T(s.gamma);
    Curvature sum{0};
    for_quads(slot, end, [&](int64_t i) {
      Vec4<T> weight = load_vec4(w.v.weight + i), inverse = load_vec4(w.v.inverse + i), r = load_vec4(w.v.r + i);
      Vec4<T> p = load_vec4(w.v.p + i);
      const HeatVectors<T> v{nullptr, weight.e, inverse.e, r.e, p.e, nullptr};
      T weighted = T(0);
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++) weighted += direct_node(v, k, beta, gamma);
      store_vec4(w.v.p + i, p);
      sum.value += double(weighted);
    });
    put_part(w.slot_curvature, scene, sum);
  });
  wait_for_all();
}

// The step length, and the step.
template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::update() const {
  for_slots([&](int scene, int slot, int end, bool owner) {
    const SceneRange range = w.range[scene];
    HeatScene s = w.scene[1][scene];
    if (s.running && a.method == HeatMethod::conjugate_gradients && s.simple == 0) {
      Curvature sum{0};
      add_parts(w.item_curvature, scene, range.item_block, range.item_block_end, sum);
      add_parts(w.slot_curvature, scene, range.slot_block, range.slot_block_end, sum);
      sum = sum_of_block(sum);
      s = decide([&] {
        HeatScene next = s;
        set_step(next, sum.value);
        return next;
      });
      if (owner && threadIdx.x == 0 && !s.running) atomicSub(w.running, 1);
    }
    if (owner && threadIdx.x == 0) w.scene[0][scene] = s;
    if (!s.running) return;
    const T alpha = T(s.alpha);
    auto sums = StepSums<double>::zero();
    for_quads(slot, end, [&](int64_t i) {
      Vec4<T> mass = load_vec4(w.v.mass + i), weight = load_vec4(w.v.weight + i), inverse = load_vec4(w.v.inverse + i);
      Vec4<T> r = load_vec4(w.v.r + i), p = load_vec4(w.v.p + i), product = load_vec4(w.v.product + i);
      Vec4<T> increment = load_vec4(a.increment + i);
      const HeatVectors<T> v{mass.e, weight.e, inverse.e, r.e, p.e, product.e};
      auto of_quad = StepSums<T>::zero();
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++) of_quad.add(update_node(v, increment.e, k, alpha));
      store_vec4(w.v.product + i, product);
      store_vec4(w.v.r + i, r);
      store_vec4(a.increment + i, increment);
      sums.add(of_quad);
    });
    if (wants_sums(s, a.method)) put_part(w.step, scene, sums);
  });
  wait_for_all();
}

template <int Order, class T, int D>
__device__ void HeatKernel<Order, T, D>::finish() const {
  for_slots([&](int scene, int slot, int end, bool) {
    const T shift = T(energy_shift(w.scene[1][scene]));
    for_quads(slot, end, [&](int64_t i) {
      const Vec4<T> mass = load_vec4(w.v.mass + i);
      Vec4<T> increment = load_vec4(a.increment + i);
#pragma unroll
      for (int k = 0; k < kBlockWidth; k++)
        if (mass.e[k] != T(0)) increment.e[k] += shift;
      store_vec4(a.increment + i, increment);
    });
  });
  for (int scene = blockIdx.x * blockDim.x + threadIdx.x; scene < a.topology.scenes; scene += gridDim.x * blockDim.x) {
    if (!takes(scene)) continue;
    const bool empty = w.range[scene].slot == w.range[scene].slot_end;
    report_scene(a, scene, empty ? start_scene(a, scene, StartSums<double>::zero()) : w.scene[1][scene]);
  }
}

template <int Order, class T, int D>
__global__ void __launch_bounds__(kHeatThreads<Order, T>, 1) heat_kernel(const HeatKernel<Order, T, D> kernel) {
  extern __shared__ uint4 dynamic[];
  auto& own = reinterpret_cast<WarpMemory<HeatShape<Order, T, D>>*>(dynamic)[threadIdx.x / 32];
  if (!kernel.takes_any()) return;
  kernel.start(own);
  for (kernel.direct(true); *static_cast<volatile int*>(kernel.w.running) > 0; kernel.direct(false)) {
    kernel.product(own);
    kernel.update();
  }
  kernel.finish();
}

template <int Order, class T, int D>
void heat_cg(const HeatArguments<T, D>& a, Stream stream) {
  const Topology<T, D>& t = a.topology;
  HeatKernel<Order, T, D> kernel(a);
  if (small_scenes(t)) solve_scenes<Order, T, D>({a, kernel.w.packed.particles, kernel.w.v, kernel.w.apart}, stream);
  constexpr int threads = kHeatThreads<Order, T>,
                shared_memory = threads / 32 * sizeof(WarpMemory<HeatShape<Order, T, D>>);
  const auto function = heat_kernel<Order, T, D>;
  int resident = 0;
  check(cudaFuncSetAttribute(function, cudaFuncAttributeMaxDynamicSharedMemorySize, shared_memory));
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, function, threads, shared_memory));
  const unsigned blocks = unsigned(
      std::min<int64_t>(most_thread_blocks(t), int64_t(device_attribute(cudaDevAttrMultiProcessorCount)) * resident));
  void* arguments[] = {&kernel};
  check(cudaLaunchCooperativeKernel(function, blocks, threads, arguments, shared_memory, stream));
}

template <class T, int D>
int64_t heat_workspace(const HeatArguments<T, D>& a) {
  return HeatWorkspace<T, D>(a).size;
}
MPM_INSTANTIATE_SIZE(heat_workspace, HeatArguments)
MPM_INSTANTIATE_ORDERS(heat_cg, HeatArguments)

}  // namespace mpm::cuda
