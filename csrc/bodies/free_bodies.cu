#include "bodies/free_bodies.h"

#include "bodies/warp_sums.cuh"
#include "cuda/programmatic_launch.cuh"

// A thread block per scene computes the step of its bodies: it lists the nodes in contact in the order of the slots,
// stores what they meet, and runs all iterations of Newton's method. What does not depend on the nodes, the poses and
// the slots near them, is computed while the previous kernel ends. Sums have a fixed order.
namespace mpm::cuda {
namespace {

// Threads of a block: a warp for each of many scenes, so that all run at once; and more where a scene is alone or
// large.
constexpr int kFewThreads = 32, kSomeThreads = 128, kManyThreads = 512;
constexpr int kManyScenes = 256, kManySlots = 256;  // the slots of a scene on average
// Nodes per slot, on average over a scene, whose surfaces are stored; those of others are found in every pass.
constexpr int kRoom = 8;
template <int D>
constexpr int kLoneRoom = D == 2 ? 8 : 16;  // the same of nodes that meet one surface
constexpr int64_t kMostShared = 1 << 15;    // bytes of a scene's bodies and numbers, and of its sums, in shared memory

template <class T, int D>
struct NearSlot {
  int number;
  ContactSlot<T, D> slot;
};

// The slots of a scene, first those with particles and then those of the margin.
struct SceneSlots {
  int begin, count, margin_begin, margin_count, first_slots;

  __device__ int total() const { return count + margin_count; }
  __device__ int operator[](int i) const { return i < count ? begin + i : margin_begin + (i - count); }
  // Slots of the scenes before.
  __device__ int64_t before() const { return int64_t(begin) + (margin_begin - first_slots); }
};

// Threads of a block.
template <class T, int D>
int threads_of(const FreeBodiesArguments<T, D>& a) {
  if (a.contact.max_blocks / a.scenes > kManySlots) return a.scenes < kManyScenes ? kManyThreads : kSomeThreads;
  return a.scenes < kManyScenes ? kSomeThreads : kFewThreads;
}

// The work space in global memory. A scene has its part of each array.
template <class T, int D>
struct BodiesMemory {
  NearSlot<T, D>* near;   // [slots]
  int* list;              // [slots * kBlockNodes] nodes of a scene as `node_of` has them
  BodyNode<T, D>* nodes;  // [slots * kRoom]
  LoneNode<T, D>* lone;   // [slots * kLoneRoom + scenes * threads]
  BodyNow<D>* now;        // [scenes, bodies], where shared memory has no room for these and the numbers
  double* numbers;
  bool shares;  // whether it has
  int adders;   // warps that add up, each with sums of its own
  int64_t bytes;

  BodiesMemory(const FreeBodiesArguments<T, D>& a, char* memory) {
    int64_t at = 0;
    const auto take = [&](auto*& pointer, int64_t count) {
      pointer = reinterpret_cast<std::remove_reference_t<decltype(pointer)>>(memory + at);
      at += (count * int64_t(sizeof(*pointer)) + 255) / 256 * 256;
    };
    const int64_t slots = a.contact.max_blocks;
    const int threads = threads_of(a);
    shares = bytes_of_scene(a) <= kMostShared;
    adders = int(std::clamp<int64_t>(kMostShared / (sums_of_scene(a) * int64_t(sizeof(double))), 1, threads / 32));
    take(near, slots);
    take(list, slots * kBlockNodes<D>);
    take(nodes, slots * kRoom);
    take(lone, slots * kLoneRoom<D> + int64_t(a.scenes) * threads);
    take(now, shares ? 0 : a.scenes * int64_t(a.bodies));
    take(numbers, shares ? 0 : a.scenes * numbers_of_scene(a));
    bytes = at;
  }

  __host__ __device__ static int64_t numbers_of_scene(const FreeBodiesArguments<T, D>& a) {
    return SceneNumbers::count(a.bodies, a.bodies * kMotions<D>);
  }
  static int64_t bytes_of_scene(const FreeBodiesArguments<T, D>& a) {
    return a.bodies * int64_t(sizeof(BodyNow<D>)) + numbers_of_scene(a) * int64_t(sizeof(double));
  }
  // Impulses and slopes.
  __host__ __device__ static int64_t sums_of_scene(const FreeBodiesArguments<T, D>& a) {
    const int64_t m = a.bodies * kMotions<D>;
    return m * (m + 1);
  }
  int64_t shared_bytes(const FreeBodiesArguments<T, D>& a) const {
    return (adders > 1 ? adders * sums_of_scene(a) * int64_t(sizeof(double)) : 0) + (shares ? bytes_of_scene(a) : 0) +
           a.contact.obstacles * int64_t(sizeof(ObstaclePose<T, D>) + sizeof(ObstacleRow<T, D>));
  }

  // Of a scene; sets the sums of the adders in shared memory.
  __device__ SceneMemory<T, D> of_scene(const FreeBodiesArguments<T, D>& a, int scene, double* shared,
                                        double*& sums) const {
    SceneMemory<T, D> m;
    sums = shared;
    if (adders > 1) shared += adders * sums_of_scene(a);
    m.numbers = shares ? shared : numbers + scene * numbers_of_scene(a);
    if (shares) shared += numbers_of_scene(a);
    m.now = shares ? reinterpret_cast<BodyNow<D>*>(shared) : now + int64_t(scene) * a.bodies;
    if (shares) shared = reinterpret_cast<double*>(m.now + a.bodies);
    m.poses = reinterpret_cast<ObstaclePose<T, D>*>(shared);
    m.rows = reinterpret_cast<ObstacleRow<T, D>*>(m.poses + a.contact.obstacles);
    return m;
  }
};

// Four searches at once in the blocks of the slots, which are in order, by eight lanes each. By all threads of a warp.
template <class T, int D>
__device__ SceneSlots slots_of_scene(const FreeBodiesArguments<T, D>& a, int scene) {
  constexpr int lanes = 8;
  const int lane = int(threadIdx.x) % 32, search = lane / lanes, part = lane % lanes;
  // The first slot with this block or a later one, or unused.
  const int64_t least = int64_t(scene + search % 2) * a.contact.geometry.blocks_per_scene;
  int begin = search < 2 ? 0 : a.first_slots, end = search < 2 ? a.first_slots : a.contact.max_blocks;
  while (any_of_warp(begin < end)) {
    const int step = (end - begin + lanes - 1) / lanes, at = begin + part * step;
    const int block = at < end ? a.contact.block[at] : -1;
    const unsigned flags = __ballot_sync(~0u, block >= 0 && block < least) >> (lane - part);
    const int before = __popc(flags & ((1u << lanes) - 1));
    end = before ? min(begin + before * step, end) : begin;
    if (before) begin += (before - 1) * step + 1;
  }
  int found[4];
#pragma unroll
  for (int i = 0; i < 4; i++) found[i] = __shfl_sync(~0u, begin, i * lanes);
  return {found[0], found[1] - found[0], found[2], found[3] - found[2], a.first_slots};
}

// The threads of a block with the nodes of their scene, as SceneBodies has it.
template <int kThreads, class T, int D>
struct BlockTeam {
  const FreeBodiesArguments<T, D>& a;
  const int scene;
  const SceneMemory<T, D>& memory;
  // Of the scene, as BodiesMemory has them.
  NearSlot<T, D>* near;
  int* list;
  BodyNode<T, D>* nodes;
  LoneNode<T, D>* lone;
  int room, lone_room;  // numbers of nodes that these have room for
  int adders;
  double* sums;                                   // [adders, m + m²] in shared memory
  int* of_warps;                                  // [kWarps] in shared memory
  int near_count = 0, count = 0, lone_count = 0;  // of slots, and of nodes in contact
  bool overflows = false;                         // whether there was no room for lone nodes

  static constexpr int n = kMotions<D>, kWarps = kThreads / 32;

  template <class F>
  __device__ void each(int items, const F& f) const {
#pragma unroll 1
    for (int i = threadIdx.x; i < items; i += kThreads) f(i);
  }
  __device__ static void sync() { kWarps == 1 ? __syncwarp() : __syncthreads(); }
  __device__ static int lane() { return int(threadIdx.x) % 32; }

  // ---- lists

  // The place of the flags of this thread among those of the block, in the order of threads; adds them to `total`.
  __device__ int place(bool flag, int& total) const {
    const unsigned flags = __ballot_sync(~0u, flag);
    int before = total + __popc(flags & ((1u << lane()) - 1));
    if constexpr (kWarps == 1) {
      total += __popc(flags);
      return before;
    }
    const int warp = int(threadIdx.x) / 32;
    if (lane() == 0) of_warps[warp] = __popc(flags);
    __syncthreads();
    MPM_LOOP for (int w = 0; w < kWarps; w++) {
      if (w < warp) before += of_warps[w];
      total += of_warps[w];
    }
    __syncthreads();
    return before;
  }

  // Lists the slots near parts.
  __device__ void find_slots(const SceneSlots& slots) {
    const int all = slots.total();
    for (int first = 0; first < all; first += kThreads) {
      const int i = first + int(threadIdx.x);
      NearSlot<T, D> found;
      if (i < all) {
        found.number = slots[i];
        int corner[D];
        block_coordinates(a.contact.geometry, a.contact.block[found.number], corner);
#pragma unroll
        for (int k = 0; k < D; k++) corner[k] *= kBlockWidth;
        found.slot = slot_of_bodies(a.contact, memory.poses, scene, corner);
      }
      const bool is_near = i < all && found.slot.near;
      const int at = place(is_near, near_count);
      if (is_near) near[at] = found;
    }
    sync();
  }

  // A node of the list: number of a near slot times kBlockNodes, and number in the block.
  __device__ const NearSlot<T, D>& near_of(int entry) const { return near[entry / kBlockNodes<D>]; }
  __device__ StoredPoses<T, D> poses_of(int entry) const { return {a.contact, near_of(entry).slot, memory.poses}; }
  __device__ static int local_of(int entry) { return entry % kBlockNodes<D>; }
  __device__ int node_of(int entry) const { return near_of(entry).number * kBlockNodes<D> + local_of(entry); }

  // Lists the nodes in contact, and stores what they meet, as far as there is room.
  __device__ void find_nodes() {
    int candidates = 0, several = 0;
    list_nodes_with_mass(candidates);
    for (int first = 0; first < candidates; first += kThreads) find_touch(first, candidates, several);
    sync();
    for (int first = 0; first < several; first += kThreads) find_surfaces_of(first, several);
    sync();
  }

  __device__ void list_nodes_with_mass(int& candidates) {
    constexpr int ahead = 4;  // loads of a thread at a time
    const int all = near_count * kBlockNodes<D>;
    for (int first = 0; first < all; first += ahead * kThreads) {
      bool wanted[ahead];
#pragma unroll
      for (int k = 0; k < ahead; k++) {
        const int entry = first + k * kThreads + int(threadIdx.x);
        wanted[k] = entry < all && has_mass(a.contact, node_of(entry));
      }
#pragma unroll
      for (int k = 0; k < ahead; k++) {
        if (first + k * kThreads >= all) break;
        const int at = place(wanted[k], candidates);
        if (wanted[k]) list[at] = first + k * kThreads + int(threadIdx.x);
      }
    }
    sync();
  }

  // Stores candidates from number `first` on that meet one surface, and keeps those in the list that may meet several.
  // By all threads of the block, as the next function.
  __device__ void find_touch(int first, int candidates, int& several) {
    const int i = first + int(threadIdx.x);
    const bool wanted = i < candidates;
    const int entry = wanted ? list[i] : 0;
    NodeTouch<T, D> touch;
    find_touch_of(wanted, entry, touch);
    const bool meets = add_lone(touch.obstacle >= 0, entry, touch.obstacle, touch.normal);
    const bool keeps = meets || touch.obstacle == touch.several;
    const int at = place(keeps, several);  // a thread has read its candidate by then
    if (keeps) list[at] = entry;
  }

  // Stores nodes that meet one surface. Returns whether there is no room for a node.
  __device__ bool add_lone(bool wanted, int entry, int obstacle, const Vector<T, D>& normal) {
    if (lone_count + kThreads > lone_room) {
      overflows = true;
      return wanted;
    }
    const int at = place(wanted, lone_count);
    if (wanted)
      lone[at] = lone_node(a.contact, a.velocity, a.stride, node_of(entry),
                           lattice_node<D>(near_of(entry).slot.corner, local_of(entry)), obstacle, normal);
    return false;
  }

  // The same for nodes that may meet several surfaces.
  __device__ void find_surfaces_of(int first, int several) {
    const int i = first + int(threadIdx.x);
    const bool wanted = i < several;
    const int entry = wanted ? list[i] : 0;
    BodyNode<T, D> node;
    node.met.any = 0;
    if (any_of_warp(wanted)) {
      search_node(wanted, !overflows, entry, node);
      join_warp();
    }
    const bool meets = wanted && node.met.any, single = meets && is_lone(a.contact, node);
    const Constraint<T, D>& only = node.met.constraints.e[0];
    const bool keeps = add_lone(single, entry, only.owner, only.normal) || (meets && !single);
    const int at = place(keeps, count);
    if (keeps) list[at] = entry;
    if (keeps && at < room) copy_node(node, nodes[at]);
  }

  __device__ __noinline__ void find_touch_of(bool wanted, int entry, NodeTouch<T, D>& touch) const {
    if (!wanted) return;
    const StoredPoses<T, D> poses = poses_of(entry);
    touch = touch_of_node<true>(poses, node_position(a.contact, poses.s.corner, local_of(entry)));
  }

  // The surfaces of a node, if it meets any; `several` where it is known that it may meet several. By all threads of a
  // warp, as `any_of_warp`.
  __device__ __noinline__ void search_node(bool wanted, bool several, int entry, BodyNode<T, D>& result) const {
    NodeTouch<T, D> touch;
    const bool touches = wanted && !several;
    if (any_of_warp(touches)) {
      find_touch_of(touches, entry, touch);
      join_warp();
    }
    const StoredPoses<T, D> poses = poses_of(entry);
    const int local = local_of(entry);
    const Vector<T, D> position = node_position(a.contact, poses.s.corner, local);
    NodeContact<T, D> contact;
    several = wanted && (several || touch.obstacle == touch.several);
    if (any_of_warp(several)) {
      find_surfaces(several, poses, position, contact);
      join_warp();
    }
    if (touch.obstacle >= 0) meet_alone(poses, touch.obstacle, position, contact);
    const bool meets = wanted && contact.count > 0;
    if (any_of_warp(meets)) {
      set_body_node(meets, poses, contact, node_of(entry), local, result);
      join_warp();
    }
  }

  // Node number i of those that are not lone, with the velocities of its surfaces, its mass and its velocity. By all
  // threads of a warp.
  __device__ __noinline__ void load(bool wanted, int i, BodyNode<T, D>& node, T& mass, Vector<T, D>& v) const {
    const bool searches = wanted && i >= room;
    if (any_of_warp(searches)) {
      search_node(searches, false, list[searches ? i : 0], node);
      join_warp();
    }
    mass = T(0);
    v = zero_vector<T, D>();
    if (!wanted) return;
    if (!searches) copy_node(nodes[i], node);
    set_surface_velocities(memory.poses, node);
    mass = a.contact.mass[node.node * a.contact.mass_stride];
    v = load_node<T, D>(a.velocity, a.stride, node.node);
  }

  // ---- sums over the nodes

  template <class Scene>
  __device__ void add_up(const Scene&, double* impulses, double* slopes) const {
    add_up(impulses, slopes);
  }

  // The first warps, `adders` of them, add up; a warp processes the nodes of every `adders`-th tile. A warp adds its
  // nodes in their order. The sums of the warps are added in the order of the warps.
  __device__ __noinline__ void add_up(double* impulses, double* slopes) const {
    const int m = a.bodies * n, warp = int(threadIdx.x) / 32;
    const int of_impulses = impulses ? m : 0, of_slopes = slopes ? m * m : 0, entries = of_impulses + of_slopes;
    double *own_impulses = impulses, *own_slopes = slopes;
    if (adders > 1) {
      own_impulses = sums + warp * entries;
      own_slopes = own_impulses + of_impulses;
      each(adders * entries, [&](int i) { sums[i] = 0; });
    } else {
      each(of_impulses, [&](int i) { impulses[i] = 0; });
      each(of_slopes, [&](int i) { slopes[i] = 0; });
    }
    sync();
    if (any_of_warp(warp < adders)) {
      add_nodes(warp, impulses ? own_impulses : nullptr, slopes ? own_slopes : nullptr);
      join_warp();
    }
    sync();
    if (adders == 1) return;
    each(entries, [&](int e) {
      double sum = 0;
      MPM_LOOP for (int w = 0; w < adders; w++)
        sum += sums[w * entries + e];
      (e < of_impulses ? impulses[e] : slopes[e - of_impulses]) = sum;
    });
    sync();
  }

  __device__ void add_nodes(int warp, double* impulses, double* slopes) const {
    const auto impulse_of = [&](int body, int e) { return impulses + (body * n + e); };
    SumsByKey<n, double, decltype(impulse_of)> of_impulses(impulse_of);
    const int m = a.bodies * n;
    const auto slope_of = [&](int pair, int e) {
      return slopes + (int64_t((pair >> 8) * n + e / n) * m + (pair & 255) * n + e % n);
    };
    SumsByKey<n * n, T, decltype(slope_of)> of_slopes(slope_of);
    constexpr int tile = 32;  // nodes of a warp
    for (int first = warp * tile; first < lone_count; first += adders * tile)
      add_lone_node(first + lane(), impulses, of_impulses, slopes, of_slopes);
    for (int first = warp * tile; first < count; first += adders * tile)
      add_node(first + lane(), impulses, of_impulses, slopes, of_slopes);
    of_impulses.finish();
    of_slopes.finish();
  }

  // A pair of bodies as a key of sums; negative where a body is.
  __device__ static int pair_of(int k, int l) { return k < 0 ? -1 : k << 8 | l; }

  template <class Impulses, class Slopes>
  __device__ void add_lone_node(int i, bool wants_impulses, Impulses& impulses, bool wants_slopes,
                                Slopes& slopes) const {
    int k = -1;
    double along[n];
    T block[n * n];
    if (i < lone_count) {
      const LoneNode<T, D> node = lone[i];
      const LoneContact<T, D> contact(a.contact, memory.poses, node);
      k = a.owner[node.obstacle];
      set_along_motions(arm_from(memory.now[k], contact.at), contact.impulse(), along);
      const Vector<T, D> arm = rounded_arm_from<T>(memory.now[k], contact.at);
      if (wants_slopes) set_slope_block([&](int axis) { return contact.slope(axis); }, arm, arm, block);
    }
    if (wants_impulses) impulses.add(k, along);
    if (wants_slopes) slopes.add(pair_of(k, k), block);
  }

  // A node that is not lone.
  template <class Impulses, class Slopes>
  __device__ void add_node(int i, bool wants_impulses, Impulses& impulses, bool wants_slopes, Slopes& slopes) const {
    const bool wanted = i < count;
    BodyNode<T, D> node;
    MetBodies bodies;
    T mass;
    Vector<T, D> v;
    load(wanted, i, node, mass, v);
    if (wanted) bodies = bodies_of(a.owner, node);
    if (wants_impulses) add_impulses(wanted, node, mass, v, bodies, impulses);
    MPM_LOOP for (int by = 0; wants_slopes && any_of_warp(by < bodies.count); by++)
      add_slopes_by(by < bodies.count, node, mass, v, bodies, by, slopes);
  }

  // Impulses of a node on its bodies.
  template <class Sums>
  __device__ void add_impulses(bool wanted, const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v,
                               const MetBodies& bodies, Sums& sums) const {
    TakenVelocities<T, D> taken;
    if (any_of_warp(wanted)) {
      take_from_node(wanted, node, v, taken);
      join_warp();
    }
    MPM_LOOP for (int number = 0; any_of_warp(number < bodies.count); number++) {
      const int k = number < bodies.count ? bodies[number] : -1;
      double along[n];
      if (k >= 0)
        set_along_motions(arm_from(memory.now[k], place_of(a.contact, node.lattice)),
                          impulse_on(number, bodies, mass, taken), along);
      sums.add(k, along);
    }
  }

  // Derivatives of the impulses of a node on its bodies by the velocity of one of these.
  template <class Sums>
  __device__ void add_slopes_by(bool acts, const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v,
                                const MetBodies& bodies, int by, Sums& sums) const {
    ImpulseSlopes<T, D> slopes;
    if (any_of_warp(acts)) {
      set_slopes(acts, node, mass, v, bodies, by, slopes);
      join_warp();
    }
    const int l = acts ? bodies[by] : -1;
    MPM_LOOP for (int number = 0; any_of_warp(acts && number < bodies.count); number++) {
      const int k = acts && number < bodies.count ? bodies[number] : -1;
      T block[n * n];
      if (k >= 0)
        set_slope_block(slope_of(slopes, number), rounded_arm_from<T>(memory.now[k], place_of(a.contact, node.lattice)),
                        rounded_arm_from<T>(memory.now[l], as_double(node.position)), block);
      sums.add(pair_of(k, l), block);
    }
  }

  template <class Scene>
  __device__ void change_nodes(const Scene&) const {
    each(lone_count, [&](int i) {
      const LoneNode<T, D> node = lone[i];
      store(node.node, node.velocity + LoneContact<T, D>(a.contact, memory.poses, node).change());
    });
    for (int first = 0; first < count; first += kThreads) {
      const int i = first + int(threadIdx.x);
      const bool wanted = i < count;
      BodyNode<T, D> node;
      T mass;
      Vector<T, D> v;
      load(wanted, i, node, mass, v);
      TakenVelocities<T, D> taken;
      if (any_of_warp(wanted)) {
        take_from_node(wanted, node, v, taken);
        join_warp();
      }
      if (wanted) store(node.node, without(taken, v));
    }
  }

  __device__ void store(int node, const Vector<T, D>& v) const {
#pragma unroll
    for (int axis = 0; axis < D; axis++) a.velocity[node * a.stride + axis] = v[axis];
  }
};

// Least number of blocks of a multiprocessor.
template <int kThreads, class T>
constexpr int kLeastBlocks = kThreads == kFewThreads ? (sizeof(T) == 4 ? 16 : 8) : 1;

template <int kThreads, class T, int D>
__global__ void __launch_bounds__(kThreads, kLeastBlocks<kThreads, T>)
    free_bodies_kernel(const __grid_constant__ FreeBodiesArguments<T, D> a, const BodiesMemory<T, D> memory) {
  using Team = BlockTeam<kThreads, T, D>;
  using Bodies = SceneBodies<T, D, Team>;
  extern __shared__ double shared[];
  __shared__ int of_warps[kThreads / 32];
  const int scene = blockIdx.x;
  double* sums;
  const SceneMemory<T, D> here = memory.of_scene(a, scene, shared, sums);
  const SceneSlots slots = slots_of_scene(a, scene);
  const int64_t before = slots.before();
  Team team{a,
            scene,
            here,
            memory.near + before,
            memory.list + before * kBlockNodes<D>,
            memory.nodes + before * kRoom,
            memory.lone + (before * kLoneRoom<D> + int64_t(scene) * kThreads),
            slots.total() * kRoom,
            slots.total() * kLoneRoom<D> + kThreads,
            memory.adders,
            sums,
            of_warps};
  Bodies::begin(a, scene, here, team);
  team.find_slots(slots);
  grid_dependency_sync();
  team.find_nodes();
  Bodies(a, scene, here, team).solve();
}

template <int kThreads, class T, int D>
void run(const FreeBodiesArguments<T, D>& a, Stream stream) {
  const BodiesMemory<T, D> memory(a, a.workspace);
  launch_in_chain(free_bodies_kernel<kThreads, T, D>, unsigned(a.scenes), kThreads, size_t(memory.shared_bytes(a)),
                  stream, a, memory);
}

}  // namespace

template <class T, int D>
int64_t free_bodies_workspace(const FreeBodiesArguments<T, D>& a) {
  return BodiesMemory<T, D>(a, nullptr).bytes;
}

template <class T, int D>
void free_bodies(const FreeBodiesArguments<T, D>& a, Stream stream) {
  const int threads = threads_of(a);
  if (threads == kFewThreads) return run<kFewThreads>(a, stream);
  threads == kSomeThreads ? run<kSomeThreads>(a, stream) : run<kManyThreads>(a, stream);
}

MPM_INSTANTIATE_SIZE(free_bodies_workspace, FreeBodiesArguments)
MPM_INSTANTIATE(free_bodies, FreeBodiesArguments)

}  // namespace mpm::cuda
