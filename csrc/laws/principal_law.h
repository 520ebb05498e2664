#pragma once

#include "common/dual.h"
#include "laws/principal.h"

// A law in principal strains is one header with a struct of:
//   name, parameters, history   how many parameters and history variables it has;
//   plastic                     whether it moves strains; without it F is never written;
//   flow(h, p, q)               the return map: moves the Hencky strains h and the history q of a particle with the
//                               parameters p, and tells what happened (plastic laws only);
//   map_quotient(...)           (Hᵢ − Hⱼ)/(hᵢ − hⱼ) of trial strains h and mapped strains H (plastic laws only);
//   lost(h, H, p, before, q)    energy that the map from h to H, of the history from `before` to q, turns into heat per
//                               rest volume: plastic work less what hardening stores (plastic laws only);
//   energy, stress, tangent     ψ(h), τᵢ = ∂ψ/∂hᵢ and ∂τ/∂h, at given history;
//   stress_quotient(a, b)       (τᵢ − τⱼ)/(hᵢ − hⱼ) at hᵢ = a, hⱼ = b.
// All of it is written for any scalar: its derivatives come from dual numbers. The map must be continuous; on a
// boundary between branches its derivative is that of the branch which the comparison takes.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// What a return map did: the factor of the deviator (radial maps), and where it is not the identity.
template <class T>
struct Flow {
  T kappa;
  MaskOf<T> plastic, converged;
};

// A tangent ∂τ/∂h = diag(shear) + dilation 1 1ᵀ.
template <class T, int D>
struct PrincipalTangent {
  Vector<T, D> shear;
  T dilation;
};

template <class T, int D>
struct Deviator {
  T mean, norm;  // norm 0 exactly where there is no deviator; its derivative is 0 there
  MaskOf<T> sheared;
};

template <class T, int D>
MPM_HD Deviator<T, D> deviator(const Vector<T, D>& h) {
  Deviator<T, D> r;
  r.mean = T(1.0 / D) * sum(h);
  T square = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    square = square + (h[i] - r.mean) * (h[i] - r.mean);
  r.sheared = square > T(0);
  r.norm = select(r.sheared, sqrt(select(r.sheared, square, T(1))), T(0));
  return r;
}

// mean 1 + κ dev h.
template <class T, int D>
MPM_HD Vector<T, D> scale_deviator(const Vector<T, D>& h, const T& trial_mean, const T& mean, const T& kappa) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = mean + kappa * (h[i] - trial_mean);
  return r;
}

template <class Mask, class T, int D>
MPM_HD Vector<T, D> select(const Mask& mask, const Vector<T, D>& a, const Vector<T, D>& b) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = select(mask, a[i], b[i]);
  return r;
}

template <class T>
MPM_HD Dual<T> exponential(const Dual<T>& x) {
  const T e = exponential(x.value);
  return {e, e * x.derivative};
}

template <class T>
MPM_HD T logarithm(const T& x) {
  return log_1p(x, x - T(1));
}

#ifndef __CUDACC__
template <class T, int N>
MPM_HD Pack<T, N> value_of(const Pack<T, N>& a) {
  return a;
}
#endif

template <class T>
struct NewtonTolerance;
template <>
struct NewtonTolerance<float> {
  static constexpr int most_steps = 60;
  static constexpr double value = 3e-5;  // of the last step, relative: the error after it is about its square
  static constexpr double rounding = 1e-6;
};
template <>
struct NewtonTolerance<double> {
  static constexpr int most_steps = 120;
  static constexpr double value = 1e-9;
  static constexpr double rounding = 2e-15;
};
#ifndef __CUDACC__
template <class T, int N>
struct NewtonTolerance<Pack<T, N>> : NewtonTolerance<T> {};
#endif

// τ(H) · (h − H): the work of a plastic step by backward Euler (Simo and Hughes 1998). ψ(h) − ψ(H) is more, by what the
// stress of the trial strain beyond the yield surface would do, which no step has done.
template <class T, int D>
MPM_HD T plastic_work(const Vector<T, D>& tau, const Vector<T, D>& h, const Vector<T, D>& H) {
  T r = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    r = r + tau[i] * (h[i] - H[i]);
  return r;
}

// Small strain elasticity in Hencky strains: ψ = μ Σ hᵢ² + λ/2 (tr h)² (Hencky 1928). The parameters begin with μ, λ
// [Pa]. Convex maps of the deviator and the trace alone are radial.
struct HenckyElasticity {
  template <class T, int D>
  MPM_HD static T energy(const Vector<T, D>& h, const T p[], const T[]) {
    const T trace = sum(h);
    return p[0] * dot(h, h) + T(0.5) * p[1] * trace * trace;
  }

  template <class T, int D>
  MPM_HD static Vector<T, D> stress(const Vector<T, D>& h, const T p[], const T[]) {
    const T dilation = p[1] * sum(h);
    Vector<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r[i] = T(2) * p[0] * h[i] + dilation;
    return r;
  }

  template <class T, int D>
  MPM_HD static PrincipalTangent<T, D> tangent(const Vector<T, D>&, const T p[], const T[]) {
    PrincipalTangent<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r.shear[i] = T(2) * p[0];
    r.dilation = p[1];
    return r;
  }

  template <class T>
  MPM_HD static T stress_quotient(const T&, const T&, const T p[], const T[]) {
    return T(2) * p[0];
  }

  template <class T, int D>
  MPM_HD static T map_quotient(const Flow<T>& flow, const Vector<T, D>&, const Vector<T, D>&, int, int) {
    return flow.kappa;
  }

  // Without a stored energy of hardening all plastic work is heat.
  template <class T, int D>
  MPM_HD static T lost(const Vector<T, D>& h, const Vector<T, D>& H, const T p[], const T[], const T q[]) {
    return max(plastic_work(stress(H, p, q), h, H), T(0));
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
