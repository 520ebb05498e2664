#pragma once

#include <cstdint>

#include "common/matrix.h"
#include "transfer/arguments.h"

// The end of a symplectic Euler step, with the velocity and the affine field just gathered:
//   x ← x + dt v,   F ← (I + dt C) F,   J ← J (1 + dt tr C).
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
  AdvanceArguments<T, D> forward;         // its outputs unused
  Field<const T> grad_x, grad_F, grad_J;  // adjoints of the outputs; the last two absent with F and J
  Field<T> velocity, affine, F, J, dt;    // adjoints per particle; absent where not needed
};

// G2P and the end of the step in one: the velocity gradient that moves F and J is the affine field (MLS) or ∇v.
template <class T, int D>
struct G2PAdvanceArguments {
  GatherArguments<T, D> gather;  // of the node velocities; value is v, moment C (may be absent), gradient unused
  Field<const T> F, J;           // may be absent
  Field<const T> scene_dt;       // [scenes] or absent
  double dt = 0;
  StressForm form = StressForm::mls;
  Field<T> x_next, F_next, J_next;
};

inline namespace TORCH_MPM_ISA {

template <class T, int D>
MPM_HD Vector<T, D> advance_position(const Vector<T, D>& x, const Vector<T, D>& v, const T& dt) {
  return x + dt * v;
}

template <class T, int D>
MPM_HD Matrix<T, D> advance_deformation(const Matrix<T, D>& F, const Matrix<T, D>& C, const T& dt) {
  return F + dt * (C * F);
}

template <class T, int D>
MPM_HD T advance_volume_ratio(const T& J, const Matrix<T, D>& C, const T& dt) {
  return J + dt * trace(C) * J;
}

template <class T>
MPM_HD T load_scalar(const Field<const T>& f, int64_t p) {
  return f.pointer[p * f.stride[0]];
}

template <class T, int D>
MPM_HD Vector<T, D> load_vector(const Field<const T>& f, int64_t p) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = f.pointer[p * f.stride[0] + i * f.stride[1]];
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> load_matrix(const Field<const T>& f, int64_t p) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = f.pointer[p * f.stride[0] + i * f.stride[1] + j * f.stride[2]];
  return r;
}

template <class T>
MPM_HD void store_scalar(const Field<T>& f, int64_t p, T a) {
  f.pointer[p * f.stride[0]] = a;
}

template <class T, int D>
MPM_HD void store_vector(const Field<T>& f, int64_t p, const Vector<T, D>& a) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    f.pointer[p * f.stride[0] + i * f.stride[1]] = a[i];
}

template <class T, int D>
MPM_HD void store_matrix(const Field<T>& f, int64_t p, const Matrix<T, D>& a) {
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) f.pointer[p * f.stride[0] + i * f.stride[1] + j * f.stride[2]] = a[i][j];
}

// Time step of a particle. A scene id out of range takes that of scene 0: such a particle is not transferred anyway.
template <class T, int D>
MPM_HD T particle_dt(const AdvanceArguments<T, D>& a, int64_t p) {
  if (!a.scene_dt.pointer) return T(a.dt);
  const int64_t s = a.scene ? a.scene[p * a.scene_stride] : 0;
  return T(a.dt) * a.scene_dt.pointer[(s >= 0 && s < a.scenes ? s : 0) * a.scene_dt.stride[0]];
}

template <class T, int D>
MPM_HD void advance_particle(const AdvanceArguments<T, D>& a, int64_t p) {
  const T dt = particle_dt(a, p);
  store_vector(a.x_next, p, advance_position(load_vector<T, D>(a.x, p), load_vector<T, D>(a.velocity, p), dt));
  if (!a.affine.pointer) return;
  const Matrix<T, D> C = load_matrix<T, D>(a.affine, p);
  if (a.F.pointer) store_matrix(a.F_next, p, advance_deformation(load_matrix<T, D>(a.F, p), C, dt));
  if (a.J.pointer) store_scalar(a.J_next, p, advance_volume_ratio(load_scalar(a.J, p), C, dt));
}

// The velocity and the affine field that moved a particle. Those of a particle whose position is not finite are NaN and
// count as zero: it stays as it is, and must not spoil the gradients of others.
template <class T, int D>
MPM_HD void load_motion(const AdvanceArguments<T, D>& a, int64_t p, Vector<T, D>& v, Matrix<T, D>& C) {
  const bool moves = is_finite<D>(load_vector<T, D>(a.x, p).e);
  v = load_vector<T, D>(a.velocity, p);
  C = a.affine.pointer ? load_matrix<T, D>(a.affine, p) : zero_matrix<T, D>();
  MPM_UNROLL for (int i = 0; i < D; i++) {
    v[i] = moves ? v[i] : T(0);
    MPM_UNROLL for (int j = 0; j < D; j++)
      C[i][j] = moves ? C[i][j] : T(0);
  }
}

template <class T, int D>
MPM_HD void advance_particle_backward(const AdvanceBackwardArguments<T, D>& a, int64_t p) {
  const T dt = particle_dt(a.forward, p);
  const Vector<T, D> grad_x = load_vector<T, D>(a.grad_x, p);
  Vector<T, D> v;
  Matrix<T, D> C, grad_affine = zero_matrix<T, D>();
  load_motion(a.forward, p, v, C);
  if (a.velocity.pointer) store_vector(a.velocity, p, dt * grad_x);
  T grad_dt = dot(v, grad_x);
  if (a.forward.F.pointer) {
    const Matrix<T, D> F = load_matrix<T, D>(a.forward.F, p), G = load_matrix<T, D>(a.grad_F, p);
    if (a.F.pointer) store_matrix(a.F, p, G + dt * (transpose(C) * G));
    grad_affine = dt * (G * transpose(F));
    grad_dt = grad_dt + contract(C * F, G);
  }
  if (a.forward.J.pointer) {
    const T J = load_scalar(a.forward.J, p), g = load_scalar(a.grad_J, p), rate = trace(C);
    if (a.J.pointer) store_scalar(a.J, p, g + dt * rate * g);
    MPM_UNROLL for (int i = 0; i < D; i++)
      grad_affine[i][i] = grad_affine[i][i] + dt * J * g;
    grad_dt = grad_dt + rate * J * g;
  }
  if (a.affine.pointer) store_matrix(a.affine, p, grad_affine);
  if (a.dt.pointer) store_scalar(a.dt, p, grad_dt);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
