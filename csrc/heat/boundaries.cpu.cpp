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
void heat_nodes(const HeatNodesArguments<T, D>& a) {
  constexpr int64_t grain = 16384;  // nodes below which a range is not split
  parallel_ranges(a.means.nodes, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i++) heat_mean(a.means, i);
  });
  if (a.surface.exchange || a.term_count > 0)
    for_nodes(a.topology, [&](int scene, int64_t i) { heat_boundaries(a, scene, i); });
}

MPM_INSTANTIATE(heat_nodes, HeatNodesArguments)
MPM_INSTANTIATE(heat_hold, HeatHoldArguments)
MPM_INSTANTIATE(heat_layers, HeatLayersArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
