#pragma once

#include <cmath>
#include <limits>

#include "common/lanes.h"
#include "grid/box_distance.h"
#include "grid/shapes.h"
#include "heat/particle.h"
#include "heat/transfer.h"

// Work of a step of heat at one node, particle or scene. The loops of both backends go over them.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// ---- particles

// β of a transfer that is not the hybrid: none for FLIP, all for APIC and PIC.
template <class T>
MPM_HD T blend_of(HeatTransfer transfer, const T& hybrid) {
  return transfer == HeatTransfer::hybrid ? hybrid : T(transfer == HeatTransfer::flip ? 0 : 1);
}

template <class T, int D>
MPM_HD void heat_volume(const HeatVolumesArguments<T, D>& a, int64_t p) {
  const One<T> at{p};
  T volume = load_scalar(at, a.rest);
  if (a.J.pointer)
    volume = volume * load_scalar(at, a.J);
  else if (a.F.pointer)
    volume = volume * determinant(load_matrix<D>(at, a.F));
  store_scalar(at, a.volume, volume);
  if (a.dissipated.pointer) store_scalar(at, a.dissipated, T(0));
}

// Signed distance from an obstacle; infinite while it is not there. The kernel of contact needs no distance from the
// edges of a box.
template <class S, int D>
MPM_HD S distance_from(const ObstaclePose<S, D>& pose, const Vector<ValueOf<S>, D>& position) {
  if (!pose.acts) return lift<S>(ValueOf<S>(INFINITY));
  const Vector<S, D> body = to_body(pose, position);
  Vector<S, D> other;
  if (pose.shape != ObstacleShape::box) return surface(pose, body, other);
  MPM_UNROLL for (int i = 0; i < D; i++)
    other[i] = pose.row->extent[i];
  return box_distance(body, other);
}

template <class T, int D>
MPM_HD ObstaclePose<T, D> pose_of(const ContactArguments<T, D>& a, int obstacle, int scene) {
  return obstacle_pose(a, a.kind[obstacle], rows_of_scene(a, scene)[obstacle], scene);
}

// Of a particle, clamped to those that exist.
template <class T, int D>
MPM_HD int scene_of_particle(const HeatLayersArguments<T, D>& a, int64_t p) {
  const int scene = a.scene.pointer ? a.scene.pointer[p * a.scene.stride[0]] : 0;
  return scene < 0 || a.scenes <= 0 ? 0 : scene < a.scenes ? scene : int(a.scenes - 1);
}

// Returns the exchange.
template <class T, int D>
MPM_HD T heat_layer_of(const HeatLayersArguments<T, D>& a, const ObstaclePose<T, D>& pose, int64_t p) {
  const One<T> at{p};
  const T distance = distance_from(pose, load_vector<D>(at, a.x)), width = T(a.width);
  T conductance = load_scalar(at, constant(a.conductance)), exchange = T(0);
  if (!(distance >= width)) {
    const HeatLayerAt<T> layer = heat_layer(distance, width);
    exchange = conductance * layer.rate;
    conductance = layer.share * conductance - exchange / T(a.inverse_inertia);
    store_scalar(at, a.conductance, conductance);
  }
  store_scalar(at, a.exchange, exchange);
  return exchange;
}

// Heat from inside the matter of a particle [W], in a step of dt; none in a paused scene.
template <class T>
MPM_HD T dissipated_power(const T& energy, const T& rest_volume, const T& dt) {
  return energy * rest_volume / select(dt > T(0), dt, T(1));
}

// ---- nodes

template <class T, int D>
MPM_HD void heat_mean(const HeatMeansArguments<T, D>& a, int64_t i) {
  T* const sum = a.sums + i * kHeatChannels;
  const T capacity = sum[kHeatCapacity], varying = sum[kHeatVarying];
  const T theta = mean_of(sum[kHeatTheta], capacity);
  a.theta[i] = theta;
  a.capacity[i] = capacity;
  sum[kHeatMean] = mean_of(sum[kHeatMean], varying);
  if (!a.start) return;
  a.start[i] = theta;
  a.fixed[i] = false;
}

// A scene whose simple steps are not finite, or whose time step is negative. Nodes may report it at the same time.
MPM_HD void report_unsolved(double* status) {
  status[kLargestResidual] = double(NAN);
  if (!(status[kUnsolved] > 0)) status[kUnsolved] = 1;
}

template <class T, int D>
MPM_HD void finish_node(const HeatFinishArguments<T, D>& a, int scene, int64_t i) {
  const HeatArguments<T, D>& solve = a.simple.solve;
  const int steps = simple_steps(solve, scene);
  T increment = T(0);
  if (steps > 0) {
    const double dt = step_of_scene(solve, scene);
    increment = simple_increment(a.simple, i, steps, bound_of_scene(solve, scene), dt);
    if (dt < 0 || !(increment - increment == T(0))) report_unsolved(a.status + scene * kHeatStatusSize);
  } else if (capacity_at(solve, i) > T(0)) {  // the solver has no results of blocks without particles
    increment = solve.increment[i];
  }
  if (a.increment) a.increment[i] = increment;
  if (!a.sums) return;
  T* const sum = a.sums + i * kHeatChannels;
  sum[kHeatTheta] = solve.sums ? increment : increment + (solve.theta[i] - a.theta[i]);
  if (solve.sums) sum[kHeatMean] = mean_of(sum[kHeatMean], sum[kHeatVarying]);
}

// Whether an obstacle that acts contains a node of a block.
template <class T, int D>
MPM_HD bool is_held(const HeatHoldArguments<T, D>& a, const ObstaclePose<T, D>& pose, const int (&corner)[D],
                    int local) {
  return distance_from(pose, node_position(a.contact, corner, local)) <= a.contact.rounding;
}

template <class T, int D>
MPM_HD void hold_node(const HeatHoldArguments<T, D>& a, const ObstaclePose<T, D>& pose, int scene,
                      const int (&corner)[D], int local, int64_t i) {
  if (a.fixed[i] || !(a.capacity[i] > T(0)) || !is_held(a, pose, corner, local)) return;
  a.fixed[i] = true;
  a.theta[i] = a.temperature[scene * a.stride];
}

template <class T, int D>
MPM_HD void heat_of_surface(const HeatFromSurfaceArguments<T, D>& a, int scene, int64_t i) {
  a.source[i] = a.exchange[i] * a.temperature[scene * a.stride];
}

// Heat into a node by a term of the free surface, linear in its temperature θ: power − coefficient θ. The sum Σ V ∇N of
// the node is a normal with the length of its area.
template <class T, int D>
MPM_HD HeatRadiationAt<T> heat_of_term(HeatTerm term, const Vector<T, D>& normal, const T& theta, const T& first,
                                       const T& second, const T& reference) {
  const T amount = safe_root(dot(normal, normal)) * first;
  if (term == HeatTerm::convection) return {amount, amount * second};
  if (term == HeatTerm::radiation) return heat_radiation(amount, theta, second, reference);
  return {T(0), amount};  // a flux
}

// Area of a node that is rounding, of places and of the sum (`area_rounding` in torch_mpm/heat/boundaries.py).
template <class T, int D>
MPM_HD T area_rounding(const Geometry<T, D>& g) {
  T reach = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T upper = g.lower[i] + T(g.blocks[i] * kBlockWidth) * g.dx,
            low = g.lower[i] < T(0) ? -g.lower[i] : g.lower[i];
    reach = upper > reach ? upper : reach;
    reach = low > reach ? low : reach;
  }
  return std::numeric_limits<T>::epsilon() * (T(64) * g.dx + T(16) * reach) * (D == 2 ? T(1) : g.dx);
}

// The sum Σ V ∇N of a node. Inside of evenly spread particles it is rounding, whose direction means nothing: the
// derivative of its length would be that direction. Such sums are zero.
template <class T, int D>
MPM_HD Vector<T, D> normal_of_node(const HeatTermArguments<T, D>& a, int64_t i) {
  const T least = area_rounding(a.topology.geometry);
  Vector<T, D> normal;
  MPM_UNROLL for (int d = 0; d < D; d++)
    normal[d] = a.sums[i * kHeatChannels + 1 + d];
  return dot(normal, normal) <= least * least ? zero_vector<T, D>() : normal;
}

template <class T, int D>
MPM_HD void heat_term(const HeatTermArguments<T, D>& a, int scene, int64_t i) {
  if (a.term == HeatTerm::power) {
    a.source[i] += a.sums[i * kHeatChannels];
    return;
  }
  const T* const number = a.number + 2 * int64_t(scene);
  const HeatRadiationAt<T> linear =
      heat_of_term(a.term, normal_of_node(a, i), a.theta[i], number[0], number[1], T(a.reference));
  a.exchange[i] += linear.coefficient;
  a.source[i] += linear.power;
}

// Boundaries of heat at a node.
template <class T, int D>
MPM_HD void heat_boundaries(const HeatNodesArguments<T, D>& a, int scene, int64_t i) {
  if (a.surface.exchange) heat_of_surface(a.surface, scene, i);
  HeatTermArguments<T, D> term = a.terms;
  for (int k = 0; k < a.term_count; k++) {
    term.term = a.term[k];
    term.number = a.number[k];
    heat_term(term, scene, i);
  }
}

// ---- scenes

// A paused scene has nothing to solve. A residual that is NaN stays.
template <class T, int D>
MPM_HD void count_solve(const HeatCountArguments<T, D>& a, int64_t scene) {
  if (a.converged[scene] || (a.scene_dt && a.scene_dt[scene] == T(0))) return;
  double* const row = a.status + scene * kHeatStatusSize;
  const double residual = double(a.residual[scene]);
  row[kUnsolved] += 1;
  row[kLargestResidual] = larger_or_nan(row[kLargestResidual], residual);
}

// Of a solve whose increments are finished.
template <class T, int D>
MPM_HD HeatCountArguments<T, D> count_of(const HeatFinishArguments<T, D>& a) {
  const HeatArguments<T, D>& solve = a.simple.solve;
  return {solve.converged, solve.residual, solve.scene_dt, a.status};
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
