#include "bodies/free_bodies.h"

#include <vector>

#include "cpu/parallel.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 64;  // slots below which a range is not split

// One thread for all of a scene.
template <class T, int D>
struct OneThread {
  const FreeBodiesArguments<T, D>& a;
  std::vector<BodyNode<T, D>> nodes;  // of the scene, in the order of the slots

  template <class F>
  void each(int count, const F& f) const {
    for (int i = 0; i < count; i++) f(i);
  }
  void sync() const {}

  template <class F>
  void each_node(const ObstacleRow<T, D>* rows, const F& f) const {
    for (const BodyNode<T, D>& found : nodes) {
      BodyNode<T, D> node = found;
      set_surface_velocities(rows, node);
      f(node, a.contact.mass[node.node * a.contact.mass_stride], load_node<T, D>(a.velocity, a.stride, node.node));
    }
  }

  template <class Scene>
  void add_up_impulses(const Scene& scene, double* sums) const {
    constexpr int n = kMotions<D>;
    for (int i = 0; i < a.bodies * n; i++) sums[i] = 0;
    each_node(scene.rows, [&](const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v) {
      NodePush<T, D> push;
      set_impulses(true, a.contact, node, mass, v, push);
      for (int face = 0; face < push.faces; face++) {
        const int k = a.owner[push.obstacle[face]];
        for (int i = 0; i < n; i++) sums[k * n + i] += impulse_along(push, face, scene.now[k], i);
      }
    });
  }

  template <class Scene>
  void add_up_slopes(const Scene& scene, double* sums) const {
    constexpr int n = kMotions<D>;
    const int m = a.bodies * n;
    for (int i = 0; i < m * m; i++) sums[i] = 0;
    each_node(scene.rows, [&](const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v) {
      NodePush<T, D> push;
      set_impulses(true, a.contact, node, mass, v, push);
      for (int by = 0; by < push.faces; by++) {
        for (int axis = 0; axis < D; axis++) set_slopes(true, node, mass, v, by, axis, push);
        const int l = a.owner[push.obstacle[by]];
        for (int j = 0; j < n; j++)
          for (int face = 0; face < push.faces; face++) {
            const int k = a.owner[push.obstacle[face]];
            const Vector<double, D> slope = impulse_slope(push, face, by, scene.now[l], j);
            for (int i = 0; i < n; i++) sums[(k * n + i) * m + l * n + j] += slope_along(push, slope, scene.now[k], i);
          }
      }
    });
  }

  template <class Scene>
  void change_nodes(const Scene& scene) const {
    each_node(scene.rows, [&](const BodyNode<T, D>& node, const T&, const Vector<T, D>& v) {
      Vector<T, D> after = v;
      change_velocity(true, node, after);
      for (int i = 0; i < D; i++) a.velocity[node.node * a.stride + i] = after[i];
    });
  }
};

// Finds the nodes of a slot that are in contact.
template <class T, int D>
void find_nodes(const FreeBodiesArguments<T, D>& a, int slot, std::vector<BodyNode<T, D>>& nodes) {
  const SlotPoses<T, D> poses(a.contact, slot);
  const int first = slot * kBlockNodes<D>;
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
