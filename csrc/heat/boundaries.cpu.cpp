#include "heat/blocks.cpu.h"
#include "heat/local.h"

// Boundaries of heat at the nodes: temperatures that obstacles hold, in them and near their surfaces; and the free
// surface.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
template <class T, int D>
void heat_hold(const HeatHoldArguments<T, D>& a) {
  for_blocks(a.topology, [&](int scene, const int (&corner)[D], int64_t slot) {
    const ObstaclePose<T, D> pose = pose_of(a.contact, a.obstacle, scene);
    if (!pose.acts) return;
    const int64_t first = slot * kBlockNodes<D>;
    for (int local = 0; local < kBlockNodes<D>; local++) hold_node(a, pose, scene, corner, local, first + local);
  });
}

template <class T, int D>
void heat_layers(const HeatLayersArguments<T, D>& a) {
  constexpr int64_t grain = 1024;  // particles below which a range is not split
  parallel_ranges(a.particles, grain, [&](int64_t begin, int64_t end) {
    ObstaclePose<T, D> pose;
    int of = -1;  // scene of the pose
    for (int64_t p = begin; p < end; p++) {
      const int scene = scene_of_particle(a, p);
      if (scene != of) pose = pose_of(a.contact, a.obstacle, of = scene);
      heat_layer_of(a, pose, p);
    }
  });
}

template <class T, int D>
void heat_from_surface(const HeatFromSurfaceArguments<T, D>& a) {
  for_nodes(a.topology, [&](int scene, int64_t i) { heat_of_surface(a, scene, i); });
}

template <class T, int D>
void heat_add_term(const HeatTermArguments<T, D>& a) {
  for_nodes(a.topology, [&](int scene, int64_t i) { heat_term(a, scene, i); });
}

MPM_INSTANTIATE(heat_add_term, HeatTermArguments)
MPM_INSTANTIATE(heat_hold, HeatHoldArguments)
MPM_INSTANTIATE(heat_layers, HeatLayersArguments)
MPM_INSTANTIATE(heat_from_surface, HeatFromSurfaceArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
