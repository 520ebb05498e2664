#include "heat/local.h"

#include "cuda/for_each.cuh"
#include "heat/begin_node.cuh"
#include "heat/kernels.h"

// Steps of heat at single nodes, particles and scenes, and boundaries of heat.
namespace mpm::cuda {
namespace {

__host__ __device__ inline void request_activations(Displacement* displacement,
                                                    [[maybe_unused]] Displacement* next_displacement) {
  displacement->requested = 1;
#ifdef __CUDA_ARCH__
  if (next_displacement) atomicOr(&next_displacement->lost, Displacement::kLost);
#endif
}

template <class T, int D>
MPM_HD void hold(const HeatHoldArguments<T, D>& a, int64_t i) {
  if (a.fixed[i] || !(a.capacity[i] > T(0))) return;
  int corner[D];
  const int scene = scene_of_slot(a.topology, i / kBlockNodes<D>, corner);
  if (scene < 0) return;
  const ObstaclePose<T, D> pose = pose_of(a.contact, a.obstacle, scene);
  if (pose.acts) hold_node(a, pose, scene, corner, int(i % kBlockNodes<D>), i);
}

// Work at a scene: i < scenes.
template <class T, int D>
MPM_HD void finish_scene(const HeatFinishArguments<T, D>& a, int64_t scene) {
  constexpr double kGrowth = 2;  // of the bound, until the activation
  const HeatArguments<T, D>& solve = a.simple.solve;
  if (a.displacement && simple_steps_of(kGrowth * bound_of_scene(solve, int(scene)), solve.relative_tolerance) == 0)
    request_activations(a.displacement, a.next_displacement);
  if (simple_steps(solve, int(scene)) == 0) count_solve(count_of(a), scene);
}

template <class T, int D>
MPM_HD void finish(const HeatFinishArguments<T, D>& a, int64_t i) {
  const Topology<T, D>& t = a.simple.solve.topology;
  if (i < t.scenes) finish_scene(a, i);
  if (i >= nodes_of(t)) return;
  at_node<finish_node<T, D>>(t, a, i);
  clear(a.cleared, i, nodes_of(t));
}

}  // namespace

template <class T, int D>
void heat_finish(const HeatFinishArguments<T, D>& a, Stream stream) {
  const Topology<T, D>& t = a.simple.solve.topology;
  for_each<finish<T, D>>(std::max<int64_t>(nodes_of(t), t.scenes), a, stream);
}

template <class T, int D>
void heat_volumes(const HeatVolumesArguments<T, D>& a, Stream stream) {
  for_each<heat_volume<T, D>>(a.particles, a, stream);
}

template <class T, int D>
void heat_nodes(const HeatNodesArguments<T, D>& a, Stream stream) {
  for_each<begin_node<T, D>>(a.means.nodes, a, stream);
}

template <class T, int D>
void heat_hold(const HeatHoldArguments<T, D>& a, Stream stream) {
  for_each<hold<T, D>>(nodes_of(a.topology), a, stream);
}

MPM_INSTANTIATE(heat_volumes, HeatVolumesArguments)
MPM_INSTANTIATE(heat_nodes, HeatNodesArguments)
MPM_INSTANTIATE(heat_finish, HeatFinishArguments)
MPM_INSTANTIATE(heat_hold, HeatHoldArguments)

}  // namespace mpm::cuda
