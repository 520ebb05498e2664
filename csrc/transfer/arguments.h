#pragma once

#include "common/fields.h"
#include "grid/fixed_point.h"
#include "grid/topology.h"
#include "transfer/momentum.h"

// Arguments of the transfer kernels.
namespace mpm {

// On CUDA, for P2G with the law: one of two launches of a step has work, by whether the activation lasts.
struct WorkOfLaunch {
  const Displacement* displacement = nullptr;  // absent: there is one launch, which has work
  int out_of_block_cost = kOutOfBlockCost;
  bool where_it_lasts = false;

  MPM_HD bool is_due(int64_t particles) const {
    return !displacement || displacement->lasts(particles, out_of_block_cost) == where_it_lasts;
  }
};

template <class T, int D>
struct P2GArguments {
  Topology<T, D> topology;
  Field<const T> x, mass, velocity, affine, stress, volume;
  Field<const T> scene_dt;  // [scenes], or absent; the time step of a particle is dt * scene_dt[its scene]
  double dt = 0;
  StressForm form = StressForm::mls;
  bool deterministic = false;
  bool displaced = false;  // particles may be in active blocks other than those of the activation; with stress, on CUDA
  NodeField<T> nodes;      // zero on entry; 1 + D channels: mass, momentum
  FixedPoint fixed;        // sums of the nodes, on CUDA
  WorkOfLaunch work;
};

// ∂Φ/∂x_p of the trilinear form Φ = Σ_p Σ_i g_i · [N_i (value_p + scale moment_p (x_i − x_p)) + gradient_p ∇N_i], which
// has scatter as ∂Φ/∂g and gather as ∂Φ/∂(value, moment, gradient): the position gradient of both.
template <class T, int D>
struct PositionGradientArguments {
  Topology<T, D> topology;
  Field<const T> x, value, moment, gradient;
  NodeField<const T> nodes;  // g
  double moment_scale = 1;
  Field<T> position_gradient;  // [P, D], zero for particles outside
  bool adds = false;           // added to the present values
};

template <class T, int D>
struct P2GBackwardArguments {
  P2GArguments<T, D> forward;  // its `nodes` are unused
  NodeField<const T> grad_nodes;
  Field<T> x, mass, velocity, affine, stress, volume,
      dt;             // adjoints per particle, dt with respect to the product dt * scene_dt; absent where not needed
  bool adds = false;  // x, mass and volume: added to the present values
  // Position gradient of the G2P of the same step, which comes first: it may read the outputs of this. Absent without
  // nodes.
  PositionGradientArguments<T, D> motion;
};

// nodes_i += Σ_p N_i (value_p + scale moment_p · (x_i − x_p)) + gradient_p · ∇N_i, for any number of channels. The
// scale is 1 for an affine field, D⁻¹ for the adjoint of G2P.
template <class T, int D>
struct ScatterArguments {
  Topology<T, D> topology;
  Field<const T> x, value, moment, gradient;  // [P, K], [P, K, D], [P, K, D]; the last two may be absent
  double moment_scale = 1;
  bool deterministic = false;
  NodeField<T> nodes;  // zero on entry, K channels
};

// Adjoint of scatter: value_p = Σ_i N_i g_i, moment_p = scale Σ_i N_i g_i (x_i − x_p), gradient_p = Σ_i g_i ∇N_i.
template <class T, int D>
struct GatherArguments {
  Topology<T, D> topology;
  Field<const T> x;
  NodeField<const T> nodes;
  double moment_scale = 1;
  double lost = 0;                   // result of particles whose position is not finite
  Field<T> value, moment, gradient;  // absent where not requested; zero for other particles outside
};

}  // namespace mpm
