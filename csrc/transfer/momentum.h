#pragma once

#include "common/bspline.h"
#include "common/matrix.h"

// Contribution of one particle to its nodes in P2G, and the chain rule from the adjoint sums over those nodes.
//   mass:      m_i    = Σ_p N_i m_p
//   momentum:  (mv)_i = Σ_p N_i (m_p v_p + Q_p (x_i − x_p)) + G_p ∇N_i
// APIC (Jiang et al. 2015) has Q = m C; MLS-MPM (Hu et al. 2018, eq. 18) includes the stress, Q = m C − dt V D⁻¹ τ; the
// B-spline-gradient form separates it, G = −dt V τ (Kirchhoff stress τ, rest volume V).
namespace mpm {

enum class StressForm : int { mls = 0, gradient = 1 };

inline namespace TORCH_MPM_ISA {

// Inputs of one particle; affine and stress are zero where absent.
template <class T, int D>
struct ParticleMomentum {
  T mass;
  Vector<T, D> velocity;
  Matrix<T, D> affine;  // C [1/s]
  Matrix<T, D> stress;  // Kirchhoff stress τ [Pa]
  T volume;             // rest volume
  T dt;
};

// The same in node form; distances and gradients are in cells, so Q includes a factor dx and G a factor 1/dx.
template <class T, int D>
struct NodeMomentum {
  T mass;
  Vector<T, D> momentum;
  Matrix<T, D> moment;    // Q dx
  Matrix<T, D> gradient;  // G / dx
};

// Factor of τ V in Q dx (MLS) or in G/dx (gradient form), per unit of −dt.
template <int Order, class T>
MPM_HD T stress_scale(StressForm form, const T& inverse_dx) {
  return form == StressForm::mls ? T(BSpline<Order>::inverse_inertia) * inverse_dx : inverse_dx;
}

template <int Order, class T, int D>
MPM_HD NodeMomentum<T, D> to_nodes(const ParticleMomentum<T, D>& p, StressForm form, bool has_affine, bool has_stress,
                                   const T& dx, const T& inverse_dx) {
  NodeMomentum<T, D> n;
  n.mass = p.mass;
  n.momentum = p.mass * p.velocity;
  n.moment = has_affine ? (p.mass * dx) * p.affine : zero_matrix<T, D>();
  n.gradient = zero_matrix<T, D>();
  if (has_stress) {
    const Matrix<T, D> impulse = (T(0) - p.dt * p.volume * stress_scale<Order>(form, inverse_dx)) * p.stress;
    if (form == StressForm::mls)
      n.moment = n.moment + impulse;
    else
      n.gradient = impulse;
  }
  return n;
}

// From the adjoint sums S (the gathers of the node gradient for each field of NodeMomentum) to the adjoints of the
// particle's inputs.
template <int Order, class T, int D>
MPM_HD ParticleMomentum<T, D> adjoint(const ParticleMomentum<T, D>& p, const NodeMomentum<T, D>& s, StressForm form,
                                      bool has_affine, bool has_stress, const T& dx, const T& inverse_dx) {
  ParticleMomentum<T, D> g;
  g.mass = s.mass + dot(p.velocity, s.momentum);
  g.velocity = p.mass * s.momentum;
  g.affine = zero_matrix<T, D>();
  g.stress = zero_matrix<T, D>();
  g.volume = T(0);
  g.dt = T(0);
  if (has_affine) {
    g.mass = g.mass + dx * contract(p.affine, s.moment);
    g.affine = (p.mass * dx) * s.moment;
  }
  if (has_stress) {
    const Matrix<T, D>& sum = form == StressForm::mls ? s.moment : s.gradient;
    const T scale = T(0) - stress_scale<Order>(form, inverse_dx);
    const T work = scale * contract(p.stress, sum);
    g.stress = (scale * p.dt * p.volume) * sum;
    g.volume = p.dt * work;
    g.dt = p.volume * work;
  }
  return g;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
