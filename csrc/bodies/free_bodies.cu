#include "bodies/free_bodies.h"
#include "cuda/launch.cuh"

// A thread block per scene computes the step of its bodies: it lists the nodes in contact in the order of the slots,
// stores what they meet, and runs all iterations of Newton's method. Sums have a fixed order.
namespace mpm::cuda {
namespace {

// Threads of a block: few for many scenes, so that their latencies overlap.
constexpr int kFewThreads = 128, kManyThreads = 512, kManyScenes = 256;
// Nodes per slot, on average over a scene, whose surfaces are stored; those of others are found in every pass.
constexpr int kRoom = 8;
// Nodes whose impulses are in shared memory at a time, whole warps.
template <class T>
constexpr int kTile = sizeof(T) == 4 ? 64 : 32;
constexpr int64_t kMostShared = 1 << 15;  // bytes of a scene's bodies and numbers that may be there, too

struct NearObstacles {
  uint64_t near, touching;  // see ContactSlot
};

// The work space in global memory.
template <class T, int D>
struct BodiesMemory {
  NearObstacles* near;    // [slots]
  int* list;              // [slots * kBlockNodes] nodes of a scene: first those that have mass near bodies
  BodyNode<T, D>* nodes;  // [slots * kRoom]
  BodyNow<D>* now;        // [scenes, bodies], where shared memory has no room for these and the numbers
  double* numbers;
  bool shares;  // whether it has
  int64_t bytes;

  BodiesMemory(const FreeBodiesArguments<T, D>& a, char* memory) {
    int64_t at = 0;
    const auto take = [&](int64_t size) {
      char* const p = memory + at;
      at += (size + 255) / 256 * 256;
      return p;
    };
    const int64_t slots = a.contact.max_blocks, of_scene = bytes_of_scene(a);
    shares = of_scene <= kMostShared;
    near = reinterpret_cast<NearObstacles*>(take(slots * int64_t(sizeof(NearObstacles))));
    list = reinterpret_cast<int*>(take(slots * kBlockNodes<D> * int64_t(sizeof(int))));
    nodes = reinterpret_cast<BodyNode<T, D>*>(take(slots * kRoom * int64_t(sizeof(BodyNode<T, D>))));
    now = reinterpret_cast<BodyNow<D>*>(take(shares ? 0 : a.scenes * int64_t(a.bodies) * int64_t(sizeof(BodyNow<D>))));
    numbers = reinterpret_cast<double*>(take(shares ? 0 : a.scenes * numbers_of_scene(a) * int64_t(sizeof(double))));
    bytes = at;
  }

  __host__ __device__ static int64_t numbers_of_scene(const FreeBodiesArguments<T, D>& a) {
    return SceneNumbers::count(a.bodies, a.bodies * kMotions<D>);
  }
  static int64_t bytes_of_scene(const FreeBodiesArguments<T, D>& a) {
    return a.bodies * int64_t(sizeof(BodyNow<D>)) + numbers_of_scene(a) * int64_t(sizeof(double));
  }
  int64_t shared_bytes(const FreeBodiesArguments<T, D>& a, int threads) const {
    return int64_t(sizeof(double)) * threads + kTile<T> * int64_t(sizeof(NodePush<T, D>)) +
           (shares ? bytes_of_scene(a) : 0);
  }
};

// The slots of a scene, first those with particles and then those of the margin.
struct SceneSlots {
  int begin, count, margin_begin, margin_count, first_slots;

  __device__ int total() const { return count + margin_count; }
  __device__ int operator[](int i) const { return i < count ? begin + i : margin_begin + (i - count); }
  // Slots of the scenes before.
  __device__ int64_t before() const { return int64_t(begin) + (margin_begin - first_slots); }
};

// First slot from `begin` on with block `least` or a later one, or unused.
__device__ int first_slot_from(const int* block, int begin, int end, int64_t least) {
  while (begin < end) {
    const int middle = begin + (end - begin) / 2;
    if (block[middle] >= 0 && block[middle] < least)
      begin = middle + 1;
    else
      end = middle;
  }
  return begin;
}

template <class T, int D>
__device__ SceneSlots slots_of_scene(const FreeBodiesArguments<T, D>& a, int scene) {
  const ContactArguments<T, D>& c = a.contact;
  const int64_t first = int64_t(scene) * c.geometry.blocks_per_scene, next = first + c.geometry.blocks_per_scene;
  SceneSlots s;
  s.first_slots = a.first_slots;
  s.begin = first_slot_from(c.block, 0, a.first_slots, first);
  s.count = first_slot_from(c.block, s.begin, a.first_slots, next) - s.begin;
  s.margin_begin = first_slot_from(c.block, a.first_slots, c.max_blocks, first);
  s.margin_count = first_slot_from(c.block, s.margin_begin, c.max_blocks, next) - s.margin_begin;
  return s;
}

// The slot of a node with what the kernel has stored of it; an inactive one where it is not wanted.
template <class T, int D>
__device__ ContactSlot<T, D> stored_slot(bool wanted, const ContactArguments<T, D>& a, const NearObstacles* near,
                                         int node) {
  ContactSlot<T, D> s;
  if (!wanted) return s;
  const int slot = node / kBlockNodes<D>;
  s.scene = block_coordinates(a.geometry, a.block[slot], s.corner);
#pragma unroll
  for (int i = 0; i < D; i++) s.corner[i] *= kBlockWidth;
  s.active = true;
  s.walled = is_walled(a, s.corner);
  s.near = near[slot].near;
  s.touching = near[slot].touching;
  s.row = rows_of_scene(a, s.scene);
  return s;
}

// The surfaces of a node that the kernel has not stored. By all threads of a warp, as `any_of_warp`.
template <class T, int D>
__device__ __noinline__ void search_node(bool wanted, const ContactArguments<T, D>& a, const NearObstacles* near,
                                         int node, BodyNode<T, D>& result) {
  const SlotPoses<T, D> poses(a, stored_slot(wanted, a, near, node));
  const int local = node % kBlockNodes<D>;
  NodeContact<T, D> contact;
  find_contact(wanted, poses, node_position(a, poses.s.corner, local), contact);
  if (any_of_warp(wanted)) {
    set_body_node(wanted, poses, contact, node, local, result);
    join_warp();
  }
}

// The threads of a block with the nodes of their scene, as SceneBodies has it.
template <int kThreads, class T, int D>
struct BlockTeam {
  const FreeBodiesArguments<T, D>& a;
  const NearObstacles* near;
  int* list;              // of the scene
  BodyNode<T, D>* nodes;  // of the scene
  int room;               // of `nodes`
  NodePush<T, D>* push;   // [kTile] in shared memory
  double* partial;        // [kThreads] in shared memory
  int* of_warps;          // [kWarps] in shared memory
  int count = 0;          // of nodes in contact

  static constexpr int n = kMotions<D>, kWarps = kThreads / 32;
  static_assert(kThreads % kTile<T> == 0);

  template <class F>
  __device__ void each(int items, const F& f) const {
    for (int i = threadIdx.x; i < items; i += kThreads) f(i);
  }
  __device__ void sync() const { __syncthreads(); }

  // ---- the list of nodes

  // The place of the flags of this thread among those of the block, in the order of threads; adds them to `total`.
  __device__ int place(bool flag, int& total) const {
    const unsigned flags = __ballot_sync(~0u, flag);
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    if (lane == 0) of_warps[warp] = __popc(flags);
    __syncthreads();
    int before = total + __popc(flags & ((1u << lane) - 1));
    for (int w = 0; w < kWarps; w++) {
      if (w < warp) before += of_warps[w];
      total += of_warps[w];
    }
    __syncthreads();
    return before;
  }

  // Lists the nodes in contact, and stores the surfaces of as many as there is room for.
  __device__ void find_nodes(const SceneSlots& slots, NearObstacles* to) {
    each(slots.total(), [&](int i) {
      const ContactSlot<T, D> s = contact_slot(a.contact, slots[i]);
      to[slots[i]] = {s.near, s.touching};
    });
    __syncthreads();
    int candidates = 0;
    const int all = slots.total() * kBlockNodes<D>;
    for (int first = 0; first < all; first += kThreads) {
      const int i = first + int(threadIdx.x);
      const int slot = i < all ? slots[i / kBlockNodes<D>] : 0, node = slot * kBlockNodes<D> + i % kBlockNodes<D>;
      const bool wanted = i < all && near[slot].near && has_mass(a.contact, node);
      const int at = place(wanted, candidates);
      if (wanted) list[at] = node;
    }
    __syncthreads();
    for (int first = 0; first < candidates; first += kThreads) keep_if_in_contact(first, candidates);
    __syncthreads();
  }

  // Keeps the candidates from number `first` on that are in contact, by all threads of the block.
  __device__ void keep_if_in_contact(int first, int candidates) {
    const int i = first + int(threadIdx.x);
    const bool wanted = i < candidates;
    const int node = wanted ? list[i] : 0, local = node % kBlockNodes<D>;
    const SlotPoses<T, D> poses(a.contact, stored_slot(wanted, a.contact, near, node));
    NodeContact<T, D> contact;
    find_contact(wanted, poses, node_position(a.contact, poses.s.corner, local), contact);
    const bool meets = wanted && contact.count > 0;
    const int at = place(meets, count);  // a thread has read its candidate by then
    if (meets) list[at] = node;
    const bool stores = meets && at < room;
    if (any_of_warp(stores)) {
      set_body_node(stores, poses, contact, node, local, nodes[stores ? at : 0]);
      join_warp();
    }
  }

  // Node number i, with the velocities of its surfaces, its mass and its velocity. By all threads of a warp.
  template <class Scene>
  __device__ void load(bool wanted, int i, const Scene& scene, BodyNode<T, D>& node, T& mass, Vector<T, D>& v) const {
    const bool searches = wanted && i >= room;
    if (any_of_warp(searches)) {
      search_node(searches, a.contact, near, searches ? list[i] : 0, node);
      join_warp();
    }
    mass = T(0);
    v = zero_vector<T, D>();
    if (!wanted) return;
    if (!searches) node = nodes[i];
    set_surface_velocities(scene.rows, node);
    mass = a.contact.mass[node.node * a.contact.mass_stride];
    v = load_node<T, D>(a.velocity, a.stride, node.node);
  }

  // ---- sums over the nodes

  // sums[e] = Σ value(push, e) for `entries` numbers; fill(first, size) sets the pushes of a tile of nodes.
  template <class Fill, class Value>
  __device__ void add_up(int entries, double* sums, const Fill& fill, const Value& value) const {
    const int chunks = entries < kThreads ? kThreads / entries : 1;
    partial[threadIdx.x] = 0;
    each(entries, [&](int e) { sums[e] = 0; });
    __syncthreads();
    for (int first = 0; first < count; first += kTile<T>) {
      const int size = min(kTile<T>, count - first);
      fill(first, size);
      __syncthreads();
      each(entries * chunks, [&](int t) {
        const int e = t % entries;
        double sum = 0;
        for (int i = t / entries; i < size; i += chunks) sum += value(push[i], e);
        (chunks > 1 ? partial[t] : sums[e]) += sum;
      });
      __syncthreads();
    }
    if (chunks == 1) return;
    each(entries, [&](int e) {
      double sum = 0;
      for (int c = 0; c < chunks; c++) sum += partial[e + c * entries];
      sums[e] = sum;
    });
    __syncthreads();
  }

  template <class Scene>
  __device__ void add_up_impulses(const Scene& scene, double* sums) const {
    add_up(
        a.bodies * n, sums, [&](int first, int size) { fill_impulses(scene, first, size); },
        [&](const NodePush<T, D>& p, int e) {
          const int k = e / n;
          double sum = 0;
          for (int face = 0; face < p.faces; face++)
            if (a.owner[p.obstacle[face]] == k) sum += impulse_along(p, face, scene.now[k], e % n);
          return sum;
        });
  }

  template <class Scene>
  __device__ void add_up_slopes(const Scene& scene, double* sums) const {
    const int m = a.bodies * n;
    add_up(
        m * m, sums, [&](int first, int size) { fill_slopes(scene, first, size); },
        [&](const NodePush<T, D>& p, int e) {
          const int row = e / m, column = e % m, k = row / n, l = column / n;
          double sum = 0;
          for (int by = 0; by < p.faces; by++) {
            if (a.owner[p.obstacle[by]] != l) continue;
            for (int face = 0; face < p.faces; face++)
              if (a.owner[p.obstacle[face]] == k)
                sum += slope_along(p, impulse_slope(p, face, by, scene.now[l], column % n), scene.now[k], row % n);
          }
          return sum;
        });
  }

  // Impulses of a tile, by one thread per node.
  template <class Scene>
  __device__ void fill_impulses(const Scene& scene, int first, int size) const {
    const int i = threadIdx.x;
    if (i >= kTile<T>) return;  // whole warps
    const bool wanted = i < size;
    BodyNode<T, D> node;
    T mass;
    Vector<T, D> v;
    load(wanted, first + i, scene, node, mass, v);
    if (any_of_warp(wanted)) {
      set_impulses(wanted, node, mass, v, push[i]);
      join_warp();
    }
    if (wanted) set_faces(a.contact, node, push[i]);
  }

  // Derivatives of the impulses of a tile, by a thread for each node and axis of a face.
  template <class Scene>
  __device__ void fill_slopes(const Scene& scene, int first, int size) const {
    const int i = threadIdx.x % kTile<T>;
    const bool wanted = i < size;
    BodyNode<T, D> node;
    T mass;
    Vector<T, D> v;
    load(wanted, first + i, scene, node, mass, v);
    const bool one = wanted && node.met.constraints.count == 1;
    if (wanted && threadIdx.x < kTile<T>) {
      set_faces(a.contact, node, push[i]);
      if (one) set_slopes_of_one(node, mass, v, push[i]);
    }
    for (int seed = threadIdx.x / kTile<T>; seed < D * D; seed += kThreads / kTile<T>) {
      const Constraints<T, D>& c = node.met.constraints;
      const bool acts = wanted && !one && seed / D < c.count && c.e[seed / D].owner >= 0;
      if (any_of_warp(acts)) {
        set_slopes(acts, node, mass, v, seed / D, seed % D, push[i]);
        join_warp();
      }
    }
  }

  template <class Scene>
  __device__ void change_nodes(const Scene& scene) const {
    for (int first = 0; first < count; first += kThreads) {
      const int i = first + int(threadIdx.x);
      const bool wanted = i < count;
      BodyNode<T, D> node;
      T mass;
      Vector<T, D> v;
      load(wanted, i, scene, node, mass, v);
      if (any_of_warp(wanted)) {
        change_velocity(wanted, node, v);
        join_warp();
      }
      for (int axis = 0; wanted && axis < D; axis++) a.velocity[node.node * a.stride + axis] = v[axis];
    }
  }
};

template <int kThreads, class T, int D>
__global__ void __launch_bounds__(kThreads)
    free_bodies_kernel(const __grid_constant__ FreeBodiesArguments<T, D> a, const BodiesMemory<T, D> memory) {
  extern __shared__ double shared[];
  __shared__ int of_warps[kThreads / 32];
  double* const numbers_here = shared + kThreads;
  const int scene = blockIdx.x, m = a.bodies * kMotions<D>;
  const int64_t count = SceneNumbers::count(a.bodies, m);
  double* const numbers = memory.shares ? numbers_here : memory.numbers + scene * count;
  BodyNow<D>* const now =
      memory.shares ? reinterpret_cast<BodyNow<D>*>(numbers_here + count) : memory.now + int64_t(scene) * a.bodies;
  char* const rest = memory.shares ? reinterpret_cast<char*>(now + a.bodies) : reinterpret_cast<char*>(numbers_here);
  const SceneSlots slots = slots_of_scene(a, scene);
  BlockTeam<kThreads, T, D> team{a,
                                 memory.near,
                                 memory.list + slots.before() * kBlockNodes<D>,
                                 memory.nodes + slots.before() * kRoom,
                                 slots.total() * kRoom,
                                 reinterpret_cast<NodePush<T, D>*>(rest),
                                 shared,
                                 of_warps};
  SceneBodies<T, D, BlockTeam<kThreads, T, D>> bodies(a, scene, now, numbers, team);
  bodies.begin();
  team.find_nodes(slots, memory.near);
  bodies.solve();
}

template <int kThreads, class T, int D>
void run(const FreeBodiesArguments<T, D>& a, Stream stream) {
  const BodiesMemory<T, D> memory(a, a.workspace);
  launch(free_bodies_kernel<kThreads, T, D>, unsigned(a.scenes), kThreads, size_t(memory.shared_bytes(a, kThreads)),
         stream, a, memory);
}

}  // namespace

template <class T, int D>
int64_t free_bodies_workspace(const FreeBodiesArguments<T, D>& a) {
  return BodiesMemory<T, D>(a, nullptr).bytes;
}

template <class T, int D>
void free_bodies(const FreeBodiesArguments<T, D>& a, Stream stream) {
  a.scenes < kManyScenes ? run<kManyThreads>(a, stream) : run<kFewThreads>(a, stream);
}

MPM_INSTANTIATE_SIZE(free_bodies_workspace, FreeBodiesArguments)
MPM_INSTANTIATE(free_bodies, FreeBodiesArguments)

}  // namespace mpm::cuda
