#pragma once

#include "laws/arguments.h"

// Stress, energy and moduli of one particle (or of one pack of particles) and their adjoints.
// Where J is not positive, or the result is not finite, the law has no meaning: the stress and the moduli are zero, so
// that such a particle does no harm to its neighbours, the energy is infinite, and all derivatives are zero.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// What a law reads of a particle; F only with shear, otherwise J; C only with viscosity.
template <class Law, class T, int D>
struct Particle {
  Matrix<T, D> F;
  T J;
  Matrix<T, D> C;
  T parameters[Law::parameters];

  MPM_HD Strain<T, D> strain() const {
    if constexpr (Law::shear)
      return strain_of_deformation(F, C);
    else
      return strain_of_volume(J, C);
  }
};

// J > 0 and x finite, per lane.
template <class T>
MPM_HD auto meaningful(const T& J, const T& x) {
  return (J > T(0)) & (x - x == T(0));
}

template <class T, int D>
MPM_HD T sum_of_entries(const Matrix<T, D>& a) {
  T r = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = i; j < D; j++) r = r + a[i][j];
  return r;
}

template <class Mask, class T, int D>
MPM_HD Matrix<T, D> or_zero(const Mask& keep, const Matrix<T, D>& a) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = select(keep, a[i][j], T(0));
  return r;
}

template <class Law, class T, int D>
MPM_HD Matrix<T, D> evaluate_stress(const Particle<Law, T, D>& particle) {
  const Strain<T, D> s = particle.strain();
  const Matrix<T, D> tau = Law::stress(s, particle.parameters);
  return or_zero(meaningful(s.J, sum_of_entries(tau)), tau);
}

template <class Law, class T, int D>
MPM_HD T evaluate_modulus(const Particle<Law, T, D>& particle, Scalar which) {
  const Strain<T, D> s = particle.strain();
  const T value =
      which == Scalar::stiffness ? Law::stiffness(s, particle.parameters) : Law::wave_modulus(s, particle.parameters);
  return select(meaningful(s.J, value), value, T(0));
}

template <class Law, class T, int D>
MPM_HD T evaluate_energy(const Particle<Law, T, D>& particle) {
  const Strain<T, D> s = particle.strain();
  const T value = Law::energy(s, particle.parameters);
  return select(meaningful(s.J, value), value, T(INFINITY));
}

// The gradient of a scalar function of strain and parameters. `derivative(strain, parameters)` gives its derivative in
// the direction that the dual numbers carry; it is asked once for each independent direction.
template <class Law, class T, int D, class Derivative>
MPM_HD Particle<Law, T, D> gradient(const Particle<Law, T, D>& particle, const Strain<T, D>& s, int needs,
                                    const Derivative& derivative) {
  Dual<T> p[Law::parameters];
  MPM_UNROLL for (int k = 0; k < Law::parameters; k++)
    p[k] = Dual<T>(particle.parameters[k], T(0));

  // With respect to a symmetric matrix: half of the derivative in which both off-diagonal entries vary.
  const auto symmetric = [&](Matrix<Dual<T>, D> Strain<Dual<T>, D>::* member) {
    Matrix<T, D> g;
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = i; j < D; j++) {
        Strain<Dual<T>, D> v = constant(s);
        (v.*member)[i][j].derivative = (v.*member)[j][i].derivative = T(1);
        g[i][j] = g[j][i] = T(i == j ? 1 : 0.5) * derivative(v, p);
      }
    return g;
  };

  Particle<Law, T, D> g;
  if (needs & kState) {
    g.J = derivative(vary_volume(s), p);
    if constexpr (Law::shear)
      g.F = T(2) * (symmetric(&Strain<Dual<T>, D>::e) * particle.F) + g.J * cofactor(particle.F);
  }
  if constexpr (Law::viscous)
    if (needs & kVelocityGradient) g.C = symmetric(&Strain<Dual<T>, D>::rate);
  if (needs & kParameters) {
    MPM_UNROLL for (int k = 0; k < Law::parameters; k++) {
      p[k].derivative = T(1);
      g.parameters[k] = derivative(constant(s), p);
      p[k].derivative = T(0);
    }
  }
  return g;
}

template <class Law, class T, int D, class Mask>
MPM_HD Particle<Law, T, D> or_zero(const Mask& keep, const Particle<Law, T, D>& a) {
  Particle<Law, T, D> r;
  r.F = or_zero(keep, a.F);
  r.C = or_zero(keep, a.C);
  r.J = select(keep, a.J, T(0));
  MPM_UNROLL for (int k = 0; k < Law::parameters; k++)
    r.parameters[k] = select(keep, a.parameters[k], T(0));
  return r;
}

template <class Law, class T, int D>
MPM_HD Particle<Law, T, D> stress_adjoint(const Particle<Law, T, D>& particle, const Matrix<T, D>& grad, int needs) {
  const Strain<T, D> s = particle.strain();
  const auto keep = meaningful(s.J, sum_of_entries(Law::stress(s, particle.parameters)));
  const auto work = [&](const Strain<Dual<T>, D>& v, const Dual<T>* p) {
    const Matrix<Dual<T>, D> tau = Law::stress(v, p);
    T r = T(0);
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) r = r + grad[i][j] * tau[i][j].derivative;
    return r;
  };
  return or_zero(keep, gradient(particle, s, needs, work));
}

template <class Law, class T, int D>
MPM_HD Particle<Law, T, D> energy_adjoint(const Particle<Law, T, D>& particle, const T& grad, int needs) {
  const Strain<T, D> s = particle.strain();
  const auto keep = meaningful(s.J, Law::energy(s, particle.parameters));
  const auto work = [&](const Strain<Dual<T>, D>& v, const Dual<T>* p) { return grad * Law::energy(v, p).derivative; };
  return or_zero(keep, gradient(particle, s, needs, work));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
