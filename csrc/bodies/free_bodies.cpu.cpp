#include "bodies/free_bodies.h"

#include <algorithm>
#include <vector>

#include "cpu/parallel.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 64;  // slots below which a range is not split

// One thread for all of a scene.
template <class T, int D>
struct OneThread {
  static constexpr int n = kMotions<D>;
  const FreeBodiesArguments<T, D>& a;
  // Of the scene, in the order of the slots; each pass sets the velocities of their surfaces.
  mutable std::vector<BodyNode<T, D>> nodes;

  template <class F>
  void each(int count, const F& f) const {
    for (int i = 0; i < count; i++) f(i);
  }
  void sync() const {}

  template <class Visit>
  void each_node(const ObstacleRow<T, D>* rows, const Visit& visit) const {
    for (BodyNode<T, D>& node : nodes) {
      set_surface_velocities(rows, node);
      visit(node, a.contact.mass[node.node * a.contact.mass_stride], load_node<T, D>(a.velocity, a.stride, node.node));
    }
  }

  template <class Scene>
  void add_up_impulses(const Scene& scene, double* sums) const {
    std::fill_n(sums, a.bodies * n, 0.0);
    each_node(scene.rows, [&](const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v) {
      NodePush<T, D> push;
      set_faces(a.contact, node, push);
      set_impulses(true, node, mass, v, push);
      for (int face = 0; face < push.faces; face++) {
        const int k = a.owner[push.obstacle[face]];
        MPM_UNROLL for (int i = 0; i < n; i++)
          sums[k * n + i] += impulse_along(push, face, scene.now[k], i);
      }
    });
  }

  template <class Scene>
  void add_up_slopes(const Scene& scene, double* sums) const {
    const int m = a.bodies * n;
    std::fill_n(sums, m * m, 0.0);
    each_node(scene.rows, [&](const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v) {
      NodePush<T, D> push;
      set_faces(a.contact, node, push);
      const bool one = node.met.constraints.count == 1;
      if (one) set_slopes_of_one(node, mass, v, push);
      for (int by = 0; by < push.faces; by++) {
        for (int axis = 0; axis < D && !one; axis++) set_slopes(true, node, mass, v, by, axis, push);
        for (int face = 0; face < push.faces; face++)
          add_slopes(push, face, by, a.owner[push.obstacle[face]], a.owner[push.obstacle[by]], scene.now, sums, m);
      }
    });
  }

  // Derivatives of the impulse of a face of body k by the motion of body l, which owns the face `by`.
  static void add_slopes(const NodePush<T, D>& push, int face, int by, int k, int l, const BodyNow<D>* now,
                         double* sums, int m) {
    MPM_UNROLL for (int j = 0; j < n; j++) {
      const Vector<double, D> slope = impulse_slope(push, face, by, now[l], j);
      MPM_UNROLL for (int i = 0; i < n; i++)
        sums[(k * n + i) * m + l * n + j] += slope_along(push, slope, now[k], i);
    }
  }

  template <class Scene>
  void change_nodes(const Scene& scene) const {
    each_node(scene.rows, [&](const BodyNode<T, D>& node, const T&, Vector<T, D> v) {
      change_velocity(true, node, v);
      std::copy_n(v.e, D, a.velocity + node.node * a.stride);
    });
  }
};

// Finds the nodes of a slot that are in contact.
template <class T, int D>
void find_nodes(const FreeBodiesArguments<T, D>& a, int slot, std::vector<BodyNode<T, D>>& nodes) {
  const int first = slot * kBlockNodes<D>;
  bool any = false;
  for (int local = 0; local < kBlockNodes<D>; local++) any |= has_mass(a.contact, first + local);
  if (!any) return;
  const SlotPoses<T, D> poses(a.contact, slot);
  for (int local = 0; local < kBlockNodes<D> && poses.s.near; local++) {
    if (!has_mass(a.contact, first + local)) continue;
    NodeContact<T, D> contact;
    find_contact(true, poses, node_position(a.contact, poses.s.corner, local), contact);
    if (contact.count == 0) continue;
    nodes.emplace_back();
    set_body_node(true, poses, contact, first + local, local, nodes.back());
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
  const int m = a.bodies * kMotions<D>, scenes = a.scenes;
  const int64_t numbers = SceneNumbers::count(a.bodies, m);
  std::vector<BodyNow<D>> now(size_t(scenes) * size_t(a.bodies));
  std::vector<double> memory(size_t(scenes * numbers));
  std::vector<OneThread<T, D>> teams(size_t(scenes), OneThread<T, D>{a, {}});
  const auto scene_of = [&](int64_t scene) {
    return SceneBodies<T, D, OneThread<T, D>>(a, int(scene), now.data() + scene * a.bodies,
                                              memory.data() + scene * numbers, teams[size_t(scene)]);
  };
  parallel_ranges(scenes, 1, [&](int64_t begin, int64_t end) {
    for (int64_t scene = begin; scene < end; scene++) scene_of(scene).begin();
  });
  const int slots = a.contact.max_blocks;
  std::vector<std::vector<BodyNode<T, D>>> of_slot{size_t(slots)};
  parallel_ranges(slots, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) find_nodes(a, int(slot), of_slot[size_t(slot)]);
  });
  for (int slot = 0; slot < slots; slot++) {
    const auto& found = of_slot[size_t(slot)];
    if (found.empty()) continue;
    auto& nodes = teams[size_t(a.contact.block[slot] / a.contact.geometry.blocks_per_scene)].nodes;
    nodes.insert(nodes.end(), found.begin(), found.end());
  }
  parallel_ranges(scenes, 1, [&](int64_t begin, int64_t end) {
    for (int64_t scene = begin; scene < end; scene++) scene_of(scene).solve();
  });
}

MPM_INSTANTIATE_SIZE(free_bodies_workspace, FreeBodiesArguments)
MPM_INSTANTIATE(free_bodies, FreeBodiesArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
