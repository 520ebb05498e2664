#include <algorithm>

#include "common/lanes.h"
#include "cpu/base_block.h"
#include "cpu/chunk.h"
#include "cpu/parallel.h"
#include "grid/box_distance.h"
#include "grid/shapes.h"
#include "heat/particle.h"
#include "heat/transfer.h"

// Boundaries of heat at the nodes: temperatures that obstacles hold, in them and near their surfaces; and the free
// surface.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

// Signed distance from an obstacle; infinite while it is not there. The kernel of contact needs no distance from the
// edges of a box.
template <class T, int D>
T distance_from(const ObstaclePose<T, D>& pose, const Vector<T, D>& position) {
  if (!pose.acts) return T(INFINITY);
  const Vector<T, D> body = to_body(pose, position);
  Vector<T, D> other;
  if (pose.shape != ObstacleShape::box) return surface(pose, body, other);
  for (int i = 0; i < D; i++) other[i] = pose.row->extent[i];
  return box_distance(body, other);
}

template <class T, int D>
ObstaclePose<T, D> pose_of(const ContactArguments<T, D>& a, int obstacle, int64_t scene) {
  return obstacle_pose(a, a.kind[obstacle], a.row[(a.rows == 1 ? 0 : scene) * a.obstacles + obstacle], int(scene));
}

// visit(first node, scene, corner) of each slot with a block.
template <class T, int D, class F>
void for_blocks(const Topology<T, D>& t, const F& visit) {
  constexpr int64_t grain = 64;  // slots below which a range is not split
  parallel_ranges(t.max_blocks, grain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      const int block = t.block[slot];
      if (block < 0 || block / t.geometry.blocks_per_scene >= t.scenes) continue;
      const BaseBlock<T, D> base(t, int(slot));
      visit(slot * kBlockNodes<D>, base.scene, base.corner);
    }
  });
}

}  // namespace

template <class T, int D>
void heat_hold(const HeatHoldArguments<T, D>& a) {
  for_blocks(a.topology, [&](int64_t first, int scene, const int* corner) {
    const ObstaclePose<T, D> pose = pose_of(a.contact, a.obstacle, scene);
    if (!pose.acts) return;
    for (int local = 0; local < kBlockNodes<D>; local++) {
      const int64_t i = first + local;
      if (a.fixed[i] || !(a.capacity[i] > T(0))) continue;
      if (!(distance_from(pose, node_position(a.contact, corner, local)) <= a.contact.rounding)) continue;
      a.fixed[i] = true;
      a.theta[i] = a.temperature[scene * a.stride];
    }
  });
}

template <class T, int D>
void heat_layers(const HeatLayersArguments<T, D>& a) {
  constexpr int64_t grain = 1024;  // particles below which a range is not split
  const T width = T(a.width);
  parallel_ranges(a.particles, grain, [&](int64_t begin, int64_t end) {
    ObstaclePose<T, D> pose;
    int64_t of = -1;  // scene of the pose
    for (int64_t p = begin; p < end; p++) {
      const int64_t scene =
          a.scene.pointer ? std::clamp<int64_t>(at(a.scene, p), 0, std::max<int64_t>(a.scenes - 1, 0)) : 0;
      if (scene != of) pose = pose_of(a.contact, a.obstacle, of = scene);
      const T distance = distance_from(pose, load_vector<D>(One<T>{p}, a.x));
      T& conductance = at(a.conductance, p);
      T& exchange = at(a.exchange, p);
      exchange = T(0);
      if (distance >= width) continue;
      const HeatLayerAt<T> layer = heat_layer(distance, width);
      exchange = conductance * layer.rate;
      conductance = layer.share * conductance - exchange / T(a.inverse_inertia);
    }
  });
}

template <class T, int D>
void heat_from_surface(const HeatFromSurfaceArguments<T, D>& a) {
  for_blocks(a.topology, [&](int64_t first, int scene, const int*) {
    for (int64_t i = first; i < first + kBlockNodes<D>; i++)
      a.source[i] = a.exchange[i] * a.temperature[scene * a.stride];
  });
}

template <class T, int D>
void heat_terms(const HeatTermsArguments<T, D>& a) {
  for_blocks(a.topology, [&](int64_t first, int scene, const int*) {
    for (int64_t i = first; i < first + kBlockNodes<D>; i++) {
      const T* const sum = a.sums + i * kHeatChannels;
      T squared = T(0), exchange = T(0), source = sum[kHeatChannels - 1];
      for (int d = 0; d < D; d++) squared += sum[d] * sum[d];
      const T area = safe_root(squared);
      for (int64_t k = 0; k < a.count; k++) {
        const T* const number = a.number + 2 * (k * a.scenes + scene);
        const T amount = area * number[0];
        HeatRadiationAt<T> linear{T(0), amount};  // a flux
        if (HeatTerm(a.term[k]) == HeatTerm::convection) linear = {amount, amount * number[1]};
        if (HeatTerm(a.term[k]) == HeatTerm::radiation)
          linear = heat_radiation(amount, a.theta[i], number[1], T(a.reference));
        exchange += linear.coefficient;
        source += linear.power;
      }
      a.exchange[i] += exchange;
      a.source[i] += source;
    }
  });
}

MPM_INSTANTIATE(heat_terms, HeatTermsArguments)
MPM_INSTANTIATE(heat_hold, HeatHoldArguments)
MPM_INSTANTIATE(heat_layers, HeatLayersArguments)
MPM_INSTANTIATE(heat_from_surface, HeatFromSurfaceArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
