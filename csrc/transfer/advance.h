#pragma once

#include "common/lanes.h"
#include "transfer/arguments.h"
#include "transfer/own_rows.h"

// End of a symplectic Euler step, with the gathered velocity and affine field:
//   x ← x + dt v,   F ← (I + dt C) F,   J ← J (1 + dt tr C).
// Compensated positions carry the accumulated rounding error of x, so that motion below half a unit in the last place
// of x is not lost.
namespace mpm {

template <class T, int D>
struct AdvanceArguments {
  int64_t particles = 0;
  Field<const T> x, velocity, affine, F, J;  // affine, F and J may be absent
  const int* scene = nullptr;                // [P], where scene_dt has more than one entry
  int64_t scene_stride = 0;
  Field<const T> scene_dt;  // [B] or absent
  int64_t scenes = 1;
  double dt = 0;
  Field<T> x_next, F_next, J_next;
};

template <class T, int D>
struct AdvanceBackwardArguments {
  AdvanceArguments<T, D> forward;                   // its outputs are unused
  Field<const T> grad_x, grad_F, grad_J;            // adjoints of the outputs; the last two absent with F and J
  Field<T> velocity, affine, F, J, dt;              // adjoints per particle; absent where not needed
  bool adds_velocity = false, adds_affine = false;  // added to the present values
};

// Adjoint of G2P and the end of the step in one: the adjoint of the end, followed by the sums over the particles of its
// result at the adjoints of their motion.
template <class T, int D>
struct G2PAdvanceBackwardArguments {
  AdvanceBackwardArguments<T, D> advance;  // its velocity and affine, or velocity gradient, are scattered
  ScatterArguments<T, D> scatter;          // D channels
};

// G2P and the end of the step in one: the velocity gradient of F and J is the affine field (MLS) or ∇v.
template <class T, int D>
struct G2PAdvanceArguments {
  GatherArguments<T, D> gather;  // of the node velocities; value is v, moment C (may be absent), gradient unused
  Field<const T> F, J;           // may be absent
  Field<const T> residual;       // of x, [P, D]; absent where positions are not compensated
  Field<const T> scene_dt;       // [scenes] or absent
  double dt = 0;
  StressForm form = StressForm::mls;
  Field<T> x_next, F_next, J_next, residual_next;
  bool late = false;  // F and J are updated by P2G (LateDeformation) or by laws (DeferredMotion); on CUDA
  // On CUDA: particles may be in active blocks other than those of the activation, and their new places are counted
  // here.
  Displacement* displacement = nullptr;
  RestoreOrder<T> own;  // on CUDA
  // On CUDA: whether the previous kernel writes only nodes of the inputs of this one, so that it can load all other
  // inputs meanwhile.
  bool loads_ahead = false;
};

// Update of F or J that G2P defers to the next P2G, which loads them anyway and has the affine field for it.
template <class T, int D>
struct LateDeformation {
  Field<T> state;              // destination of the updated F or J, possibly in place; absent where G2P updates it
  bool moves = false;          // whether a G2P has deferred an update
  const int* scene = nullptr;  // [P], where scenes have time steps of their own
  int64_t scene_stride = 0;
  Field<T> volume;  // result after the update: present volume; absent where it is not needed
};

inline namespace TORCH_MPM_ISA {

template <class T, int D>
MPM_HD Vector<T, D> advance_position(const Vector<T, D>& x, const Vector<T, D>& v, const T& dt) {
  return x + dt * v;
}

// Compensated position; `residual` becomes that of the result, exactly (TwoSum: Knuth 1969).
template <class T, int D>
MPM_HD Vector<T, D> advance_position(const Vector<T, D>& x, const Vector<T, D>& v, const T& dt,
                                     Vector<T, D>& residual) {
  Vector<T, D> next;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T move = residual[i] + dt * v[i];
    next[i] = x[i] + move;
    const T moved = next[i] - x[i];
    residual[i] = (x[i] - (next[i] - moved)) + (move - moved);
  }
  return next;
}

template <class T, int D>
MPM_HD Matrix<T, D> advance_deformation(const Matrix<T, D>& F, const Matrix<T, D>& C, const T& dt) {
  return F + dt * (C * F);
}

template <class T, int D>
MPM_HD T advance_volume_ratio(const T& J, const Matrix<T, D>& C, const T& dt) {
  return J + dt * trace(C) * J;
}

// Time step of a particle. An absent particle, of a negative scene, has that of scene 0. A particle of a scene without
// one has NaN, as `load_parameter` of laws.
template <class T, int D>
MPM_HD T particle_dt(const AdvanceArguments<T, D>& a, const One<T>& at) {
  if (!a.scene_dt.pointer) return T(a.dt);
  const int64_t s = a.scene ? a.scene[at.p * a.scene_stride] : 0;
  if (s >= a.scenes) return T(NAN);
  return T(a.dt) * a.scene_dt.pointer[(s > 0 ? s : 0) * a.scene_dt.stride[0]];
}

template <class T, int D>
MPM_HD void advance_particle(const AdvanceArguments<T, D>& a, const One<T>& at) {
  const T dt = particle_dt(a, at);
  store_vector<D>(at, a.x_next, advance_position(load_vector<D>(at, a.x), load_vector<D>(at, a.velocity), dt));
  if (!a.affine.pointer) return;
  const Matrix<T, D> C = load_matrix<D>(at, a.affine);
  if (a.F.pointer) store_matrix<D>(at, a.F_next, advance_deformation(load_matrix<D>(at, a.F), C, dt));
  if (a.J.pointer) store_scalar(at, a.J_next, advance_volume_ratio(load_scalar(at, a.J), C, dt));
}

// Velocity and affine field of the motion of a particle. Those of a particle whose position is not finite are NaN and
// count as zero: it is unchanged, and must not affect the gradients of others.
template <class T, int D>
MPM_HD void load_motion(const AdvanceArguments<T, D>& a, const One<T>& at, Vector<T, D>& v, Matrix<T, D>& C) {
  const bool moves = is_finite<D>(load_vector<D>(at, a.x).e);
  v = load_vector<D>(at, a.velocity);
  C = a.affine.pointer ? load_matrix<D>(at, a.affine) : zero_matrix<T, D>();
  MPM_UNROLL for (int i = 0; i < D; i++) {
    v[i] = moves ? v[i] : T(0);
    MPM_UNROLL for (int j = 0; j < D; j++)
      C[i][j] = moves ? C[i][j] : T(0);
  }
}

// Adjoints of the motion of a particle.
template <class T, int D>
struct MotionAdjoint {
  Vector<T, D> velocity;
  Matrix<T, D> affine;
};

// Returns the adjoints of the inputs, given those of the motion afterwards.
template <class T, int D>
MPM_HD MotionAdjoint<T, D> advance_particle_backward(const AdvanceBackwardArguments<T, D>& a, const One<T>& at) {
  const T dt = particle_dt(a.forward, at);
  const Vector<T, D> grad_x = load_vector<D>(at, a.grad_x);
  Vector<T, D> v;
  Matrix<T, D> C;
  load_motion(a.forward, at, v, C);
  // Present values are loaded before any is stored, as in lanes.h.
  const Vector<T, D> velocity = a.adds_velocity ? load_vector<D>(at, constant(a.velocity)) : zero_vector<T, D>();
  const Matrix<T, D> affine = a.adds_affine ? load_matrix<D>(at, constant(a.affine)) : zero_matrix<T, D>();
  MotionAdjoint<T, D> motion{dt * grad_x, zero_matrix<T, D>()};
  T grad_dt = dot(v, grad_x);
  if (a.forward.F.pointer) {
    const Matrix<T, D> F = load_matrix<D>(at, a.forward.F), G = load_matrix<D>(at, a.grad_F);
    if (a.F.pointer) store_matrix<D>(at, a.F, G + dt * (transpose(C) * G));
    motion.affine = dt * (G * transpose(F));
    grad_dt = grad_dt + contract(C * F, G);
  }
  if (a.forward.J.pointer) {
    const T J = load_scalar(at, a.forward.J), g = load_scalar(at, a.grad_J), rate = trace(C);
    if (a.J.pointer) store_scalar(at, a.J, g + dt * rate * g);
    MPM_UNROLL for (int i = 0; i < D; i++)
      motion.affine[i][i] = motion.affine[i][i] + dt * J * g;
    grad_dt = grad_dt + rate * J * g;
  }
  motion.velocity = velocity + motion.velocity;
  if (a.velocity.pointer) store_vector<D>(at, a.velocity, motion.velocity);
  motion.affine = affine + motion.affine;
  if (a.affine.pointer) store_matrix<D>(at, a.affine, motion.affine);
  if (a.dt.pointer) store_scalar(at, a.dt, grad_dt);
  return motion;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
