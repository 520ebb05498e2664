#include "bodies/free_bodies.h"

#include <algorithm>
#include <vector>

#include "cpu/parallel.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 64;  // slots below which a range is not split

template <class T, int D>
struct SceneNodes {
  std::vector<LoneNode<T, D>> lone;
  std::vector<BodyNode<T, D>> others;

  void add(const SceneNodes& n) {
    lone.insert(lone.end(), n.lone.begin(), n.lone.end());
    others.insert(others.end(), n.others.begin(), n.others.end());
  }
};

// One thread for all of a scene.
template <class T, int D>
struct OneThread {
  static constexpr int n = kMotions<D>;
  const FreeBodiesArguments<T, D>& a;
  SceneNodes<T, D> nodes;  // in the order of the slots

  template <class F>
  void each(int count, const F& f) const {
    for (int i = 0; i < count; i++) f(i);
  }
  void sync() const {}

  template <class Scene>
  void add_up(const Scene& scene, double* impulses, double* slopes) const {
    const int m = a.bodies * n;
    if (impulses) std::fill_n(impulses, m, 0.0);
    if (slopes) std::fill_n(slopes, m * m, 0.0);
    for (const LoneNode<T, D>& node : nodes.lone) {
      const LoneContact<T, D> contact(a.contact, scene.poses, node);
      const int k = a.owner[node.obstacle];
      if (impulses) add_impulse(arm_from(scene.now[k], contact.at), contact.impulse(), impulses + k * n);
      const auto arm = rounded_arm_from<T>(scene.now[k], contact.at);
      if (slopes) add_slopes([&](int axis) { return contact.slope(axis); }, arm, arm, k, k, slopes);
    }
    each_other(scene, [&](const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v) {
      const MetBodies bodies = bodies_of(a.owner, node);
      if (impulses) add_impulses(scene, node, mass, v, bodies, impulses);
      for (int by = 0; slopes && by < bodies.count; by++) add_slopes_by(scene, node, mass, v, bodies, by, slopes);
    });
  }

  template <class Scene>
  void change_nodes(const Scene& scene) const {
    for (const LoneNode<T, D>& node : nodes.lone) {
      const Vector<T, D> v = node.velocity + LoneContact<T, D>(a.contact, scene.poses, node).change();
      std::copy_n(v.e, D, a.velocity + node.node * a.stride);
    }
    each_other(scene, [&](const BodyNode<T, D>& node, const T&, const Vector<T, D>& v) {
      TakenVelocities<T, D> taken;
      take_from_node(true, node, v, taken);
      std::copy_n(without(taken, v).e, D, a.velocity + node.node * a.stride);
    });
  }

 private:
  template <class Scene, class Visit>
  void each_other(const Scene& scene, const Visit& visit) const {
    for (BodyNode<T, D> node : nodes.others) {
      set_surface_velocities(scene.poses, node);
      visit(node, a.contact.mass[node.node * a.contact.mass_stride], load_node<T, D>(a.velocity, a.stride, node.node));
    }
  }

  static void add_impulse(const Vector<double, D>& arm, const Vector<double, D>& impulse, double* sums) {
    double along[n];
    set_along_motions(arm, impulse, along);
    MPM_UNROLL for (int i = 0; i < n; i++)
      sums[i] += along[i];
  }

  template <class Scene>
  void add_impulses(const Scene& scene, const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v,
                    const MetBodies& bodies, double* sums) const {
    TakenVelocities<T, D> taken;
    take_from_node(true, node, v, taken);
    const Vector<double, D> at = place_of(a.contact, node.lattice);
    for (int number = 0; number < bodies.count; number++) {
      const int k = bodies[number];
      add_impulse(arm_from(scene.now[k], at), impulse_on(number, bodies, mass, taken), sums + k * n);
    }
  }

  // Derivatives of the impulses on all bodies by the velocity of one.
  template <class Scene>
  void add_slopes_by(const Scene& scene, const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v,
                     const MetBodies& bodies, int by, double* sums) const {
    ImpulseSlopes<T, D> slopes;
    set_slopes(true, node, mass, v, bodies, by, slopes);
    const Vector<double, D> at = place_of(a.contact, node.lattice);
    const int l = bodies[by];
    for (int number = 0; number < bodies.count; number++) {
      const int k = bodies[number];
      add_slopes(slope_of(slopes, number), rounded_arm_from<T>(scene.now[k], at),
                 rounded_arm_from<T>(scene.now[l], as_double(node.position)), k, l, sums);
    }
  }

  template <class Slope>
  void add_slopes(const Slope& slope, const Vector<T, D>& at, const Vector<T, D>& by, int k, int l,
                  double* sums) const {
    const int m = a.bodies * n;
    T block[n * n];
    set_slope_block(slope, at, by, block);
    MPM_UNROLL for (int i = 0; i < n; i++) MPM_UNROLL
      for (int j = 0; j < n; j++) sums[(k * n + i) * m + l * n + j] += double(block[i * n + j]);
  }
};

// Adds a node of a slot that may meet several surfaces.
template <class T, int D>
void add_node(const FreeBodiesArguments<T, D>& a, const StoredPoses<T, D>& poses, int slot, int local,
              SceneNodes<T, D>& nodes) {
  NodeContact<T, D> contact;
  find_surfaces(true, poses, node_position(a.contact, poses.s.corner, local), contact);
  if (contact.count == 0) return;
  BodyNode<T, D> node;
  set_body_node(true, poses, contact, slot * kBlockNodes<D> + local, local, node);
  if (is_lone(a.contact, node))
    nodes.lone.push_back(lone_node(a.contact, a.velocity, a.stride, node.node, node.lattice,
                                   node.met.constraints.e[0].owner, node.met.constraints.e[0].normal));
  else
    nodes.others.push_back(node);
}

// Finds the nodes of a slot that are in contact, by the poses of the obstacles of all scenes.
template <class T, int D>
void find_nodes(const FreeBodiesArguments<T, D>& a, const ObstaclePose<T, D>* poses, int slot,
                SceneNodes<T, D>& nodes) {
  const int first = slot * kBlockNodes<D>;
  bool any = false;
  for (int local = 0; local < kBlockNodes<D>; local++) any |= has_mass(a.contact, first + local);
  if (!any) return;
  int corner[D];
  const int block = a.contact.block[slot], scene = block_coordinates(a.contact.geometry, block, corner);
  if (block < 0 || scene >= a.scenes) return;
  for (int& i : corner) i *= kBlockWidth;
  poses += int64_t(scene) * a.contact.obstacles;
  const ContactSlot<T, D> near = slot_of_bodies(a.contact, poses, scene, corner);
  const StoredPoses<T, D> of_slot(a.contact, near, poses);
  if (near.near) nodes.lone.reserve(kBlockNodes<D>);
  for (int local = 0; local < kBlockNodes<D> && near.near; local++) {
    if (!has_mass(a.contact, first + local)) continue;
    const NodeTouch<T, D> touch = touch_of_node<true>(of_slot, node_position(a.contact, corner, local));
    if (touch.obstacle >= 0)
      nodes.lone.push_back(lone_node(a.contact, a.velocity, a.stride, first + local, lattice_node<D>(corner, local),
                                     touch.obstacle, touch.normal));
    if (touch.obstacle == touch.several) add_node(a, of_slot, slot, local, nodes);
  }
}

}  // namespace

// Vectors serve as work space.
template <class T, int D>
int64_t free_bodies_workspace(const FreeBodiesArguments<T, D>&) {
  return 0;
}

template <class T, int D>
void free_bodies(const FreeBodiesArguments<T, D>& a) {
  using Team = OneThread<T, D>;
  using Bodies = SceneBodies<T, D, Team>;
  const int64_t scenes = a.scenes, obstacles = a.contact.obstacles;
  const int64_t numbers = SceneNumbers::count(a.bodies, a.bodies * kMotions<D>);
  std::vector<BodyNow<D>> now(size_t(scenes * a.bodies));
  std::vector<ObstacleRow<T, D>> rows(size_t(scenes * obstacles));
  std::vector<ObstaclePose<T, D>> poses(rows.size());
  std::vector<double> memory(size_t(scenes * numbers));
  std::vector<Team> teams(size_t(scenes), Team{a, {}});
  const auto memory_of = [&](int64_t scene) {
    return SceneMemory<T, D>{now.data() + scene * a.bodies, rows.data() + scene * obstacles,
                             poses.data() + scene * obstacles, memory.data() + scene * numbers};
  };
  parallel_ranges(scenes, 1, [&](int64_t begin, int64_t end) {
    for (int64_t scene = begin; scene < end; scene++)
      Bodies::begin(a, int(scene), memory_of(scene), teams[size_t(scene)]);
  });
  const int slots = a.contact.max_blocks;
  std::vector<SceneNodes<T, D>> of_slot{size_t(slots)};
  parallel_ranges(slots, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) find_nodes(a, poses.data(), int(slot), of_slot[size_t(slot)]);
  });
  for (int slot = 0; slot < slots; slot++) {
    const SceneNodes<T, D>& found = of_slot[size_t(slot)];
    if (found.lone.empty() && found.others.empty()) continue;
    teams[size_t(a.contact.block[slot] / a.contact.geometry.blocks_per_scene)].nodes.add(found);
  }
  parallel_ranges(scenes, 1, [&](int64_t begin, int64_t end) {
    for (int64_t scene = begin; scene < end; scene++)
      Bodies(a, int(scene), memory_of(scene), teams[size_t(scene)]).solve();
  });
}

MPM_INSTANTIATE_SIZE(free_bodies_workspace, FreeBodiesArguments)
MPM_INSTANTIATE(free_bodies, FreeBodiesArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
