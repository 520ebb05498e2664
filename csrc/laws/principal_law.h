#pragma once

#include "common/dual.h"
#include "laws/hencky_strain.h"
#include "laws/law.h"
#include "laws/tangent.h"

// Laws in principal strains: one decomposition of F, the map of the Hencky strains h, stress. Such a law defines
//   flow(h, p, q)               the return map: updates the Hencky strains h and the history q of a particle with the
//                               parameters p, and returns the outcome (plastic laws only);
//   map_quotient(...)           (Hᵢ − Hⱼ)/(hᵢ − hⱼ) of trial strains h and mapped strains H (plastic laws only);
//   lost(h, H, p, before, q)    energy that the map from h to H, of the history from `before` to q, turns into heat per
//                               rest volume: plastic work minus the energy stored by hardening (plastic laws only);
//   energy, stress, tangent     ψ(h), τᵢ = ∂ψ/∂hᵢ and ∂τ/∂h, at given history;
//   stress_quotient(a, b)       (τᵢ − τⱼ)/(hᵢ − hⱼ) at hᵢ = a, hⱼ = b.
// Its derivatives come from dual numbers: those of first order, and of second order of the energy only. The map must be
// continuous; on a boundary between branches its derivative is that of the branch selected by the comparison.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class Law>
struct PrincipalKernels;

struct PrincipalLaw {
  static constexpr Deformation field = Deformation::gradient;
  static constexpr bool viscous = false, plastic = false, twice_differentiable = false, optional_history = false,
                        in_2d = true;
  static constexpr bool twice_differentiable_energy = false;  // history is constant
  static constexpr bool has_tangent = true, additive = false;
  static constexpr auto history = no_history;
  static constexpr auto options = no_options;
  static constexpr bool memory_bound = false;
  static constexpr int gpu_threads = 128, gpu_update_blocks = 0, gpu_backward_blocks = 0, gpu_p2g_blocks = 3;
  template <class Law>
  using Kernels = PrincipalKernels<Law>;
};

// Outcome of a return map: the factor of the deviator (radial maps), and where it is not the identity.
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
MPM_HD Deviator<T, D> measure_deviator(const Vector<T, D>& h) {
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

// τ(H) · (h − H): the work of a plastic step by backward Euler (Simo and Hughes 1998). ψ(h) − ψ(H) exceeds it by the
// work of the stress beyond the yield surface, which no step has done.
template <class T, int D>
MPM_HD T plastic_work(const Vector<T, D>& tau, const Vector<T, D>& h, const Vector<T, D>& H) {
  T r = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    r = r + tau[i] * (h[i] - H[i]);
  return r;
}

// Parameters and history of a particle.
template <class Law, class T>
struct PrincipalData {
  T parameters[kParameters<Law>];
  T history[kHistoryLength<Law>];
};

template <class Law, class At, class T, int D>
MPM_HD PrincipalData<Law, typename At::Value> load_data(const At& at, const LawArguments<T, D>& a) {
  PrincipalData<Law, typename At::Value> r;
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    r.parameters[k] = load_parameter(at, a, k);
  MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
    r.history[k] = load_scalar_or_zero(at, a.history[k]);
  return r;
}

// Result of a law for a trial strain.
template <class Law, class T, int D>
struct Response {
  Vector<T, D> h, tau;
  T history[kHistoryLength<Law>];
  T dissipated;
  Flow<T> flow;
};

template <class Law, class T, int D>
MPM_HD Response<Law, T, D> respond(const Vector<T, D>& h, const PrincipalData<Law, T>& data) {
  Response<Law, T, D> r;
  r.h = h;
  MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
    r.history[k] = data.history[k];
  r.dissipated = T(0);
  r.flow = {T(1), T(0) < T(0), T(0) == T(0)};
  if constexpr (Law::plastic) {
    r.flow = Law::flow(r.h, data.parameters, r.history);
    r.dissipated = select(r.flow.plastic, Law::lost(h, r.h, data.parameters, data.history, r.history), T(0));
  }
  r.tau = Law::stress(r.h, data.parameters, r.history);
  return r;
}

// 0, or NaN where a result is not finite.
template <class Law, class T, int D>
MPM_HD T poison(const Response<Law, T, D>& r) {
  T nan = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    nan = nan + (r.tau[i] - r.tau[i]) + (r.h[i] - r.h[i]);
  MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
    nan = nan + (r.history[k] - r.history[k]);
  return nan;
}

// The plastic increment h − H of the strains: its length, and its direction, zero where there is none.
template <class T, int D>
struct PlasticIncrement {
  T norm;
  Vector<T, D> direction;
};

template <class T, int D>
MPM_HD PlasticIncrement<T, D> plastic_increment(const Vector<T, D>& h, const Vector<T, D>& H) {
  const Vector<T, D> lost = h + T(-1) * H;
  const T norm = sqrt(dot(lost, lost));
  return {norm, (T(1) / select(norm > T(0), norm, T(1))) * lost};
}

// Adjoints of the inputs of a law, from forward derivatives: `derivative(h, data)` returns the sum of the adjoints of
// the results times their derivatives in the direction of its arguments. It is evaluated once per requested strain,
// parameter and history variable; `parameter(k, value)` and `history(k, value)` receive theirs, those of the strains
// are returned.
template <class Law, class V, int D, class F, class StoreParameter, class StoreHistory>
MPM_HD Vector<V, D> differentiate(const Vector<V, D>& h, const PrincipalData<Law, V>& data, bool parameters,
                                  bool history, const StoreParameter& store_parameter,
                                  const StoreHistory& store_history, const F& derivative) {
  Vector<V, D> r = zero_vector<V, D>();
  const int first_history = D + (parameters ? kParameters<Law> : 0);
  const int count = first_history + (history ? kHistory<Law> : 0);
#ifdef __CUDACC__
#pragma unroll 1
#endif
  for (int direction = 0; direction < count; direction++) {
    const auto seed = [&](const V& value, int index) { return Dual<V>(value, V(index == direction ? 1.0 : 0.0)); };
    Vector<Dual<V>, D> strain;
    PrincipalData<Law, Dual<V>> given;
    MPM_UNROLL for (int i = 0; i < D; i++)
      strain[i] = seed(h[i], i);
    MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
      given.parameters[k] = seed(data.parameters[k], parameters ? D + k : -1);
    MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
      given.history[k] = seed(data.history[k], first_history + k);
    const V value = derivative(strain, given);
    MPM_UNROLL for (int i = 0; i < D; i++)
      r[i] = i == direction ? value : r[i];
    MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
      if (direction == first_history + k) store_history(k, value);
    if (direction >= D && direction < first_history) store_parameter(direction - D, value);
  }
  return r;
}

// Adjoints of the results of a law.
template <class Law, class V, int D>
struct PrincipalGrads {
  Matrix<V, D> F, stress;
  V history[kHistoryLength<Law>];
  V dissipated, multiplier;
};

// Absent ones are zero. They are loaded before the state, so that no load waits for the arithmetic on another.
template <class Law, class At, class T, int D>
MPM_HD PrincipalGrads<Law, typename At::Value, D> load_grads(const At& at, const LawBackwardArguments<T, D>& a) {
  PrincipalGrads<Law, typename At::Value, D> r;
  r.F = load_matrix_or_zero<D>(at, a.grad_state);
  r.stress = load_matrix_or_zero<D>(at, a.grad_stress);
  MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
    r.history[k] = a.grad_history.pointer ? load_entry(at, a.grad_history, k) : typename At::Value(0);
  r.dissipated = load_scalar_or_zero(at, a.grad_dissipated);
  r.multiplier = load_scalar_or_zero(at, a.grad_multiplier);
  return r;
}

// Adjoint of F through the map and its stress; those of parameters and history are stored by `differentiate`.
template <class Law, class V, int D, class StoreParameter, class StoreHistory>
MPM_HD Matrix<V, D> map_adjoint(const HenckyStrain<V, D>& s, const PrincipalData<Law, V>& data,
                                const Response<Law, V, D>& r, const PrincipalGrads<Law, V, D>& grad, bool parameters,
                                bool history, const StoreParameter& store_parameter,
                                const StoreHistory& store_history) {
  const Matrix<V, D> right = right_axes(s);
  const Matrix<V, D> M = transpose(s.U) * grad.F * right, N = transpose(s.U) * symmetric_part(grad.stress) * s.U;
  const Vector<V, D> by_multiplier = grad.multiplier * plastic_increment(s.h, r.h).direction;
  Vector<V, D> grad_h;
  MPM_UNROLL for (int i = 0; i < D; i++)
    grad_h[i] = M[i][i] * exponential(r.h[i]) - by_multiplier[i];
  const Vector<V, D> diagonal =
      by_multiplier + differentiate<Law>(s.h, data, parameters, history, store_parameter, store_history,
                                         [&](const Vector<Dual<V>, D>& h, const PrincipalData<Law, Dual<V>>& given) {
                                           const Response<Law, Dual<V>, D> moved = respond<Law>(h, given);
                                           V value = grad.dissipated * moved.dissipated.derivative;
                                           MPM_UNROLL for (int i = 0; i < D; i++)
                                             value = value + grad_h[i] * moved.h[i].derivative +
                                                     N[i][i] * moved.tau[i].derivative;
                                           MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
                                             value = value + grad.history[k] * moved.history[k].derivative;
                                           return value;
                                         });
  const Matrix<V, D> principal =
      principal_adjoint(s, r.h, diagonal, symmetric_part(M), skew_part(M), N, [&](int i, int j) {
        Quotients<V> q = {V(1), Law::stress_quotient(r.h[i], r.h[j], data.parameters, r.history)};
        if constexpr (Law::plastic) q.map = Law::map_quotient(r.flow, s.h, r.h, i, j);
        return q;
      });
  return s.U * principal * transpose(right);
}

// Adjoint of F through the energy, likewise.
template <class Law, class V, int D, class StoreParameter, class StoreHistory>
MPM_HD Matrix<V, D> energy_adjoint(const HenckyStrain<V, D>& s, const PrincipalData<Law, V>& data, const V& grad,
                                   bool parameters, bool history, const StoreParameter& store_parameter,
                                   const StoreHistory& store_history) {
  Vector<V, D> diagonal =
      differentiate<Law>(s.h, data, parameters, history, store_parameter, store_history,
                         [&](const Vector<Dual<V>, D>& h, const PrincipalData<Law, Dual<V>>& given) {
                           return grad * Law::energy(h, given.parameters, given.history).derivative;
                         });
  MPM_UNROLL for (int i = 0; i < D; i++)
    diagonal[i] = diagonal[i] * s.scale * s.inverse[i];
  return compose(s.U, diagonal, right_axes(s));
}

// Derivative of P = τ F⁻ᵀ = U diag(τᵢ/σᵢ) Vᵀ along A, in principal axes: M = Uᵀ A V, and `tau` carries the derivatives
// of the stresses along it. The off-diagonal entries are the shear moduli of laws/tangent.h.
template <class Law, class V, int D>
MPM_HD Matrix<V, D> stress_derivative(const HenckyStrain<V, D>& s, const PrincipalData<Law, V>& data,
                                      const Vector<Dual<V>, D>& h, const Vector<Dual<V>, D>& tau,
                                      const Matrix<V, D>& M) {
  Vector<V, D> inverse;  // of the stretches
  Matrix<V, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    inverse[i] = s.scale * s.inverse[i];
    r[i][i] = (tau[i].derivative - tau[i].value * h[i].derivative) * inverse[i];
  }
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = i + 1; j < D; j++) {
      const V half = V(0.5) * (s.h[i] - s.h[j]), mean = V(0.5) * (tau[i].value + tau[j].value);
      const V quotient = Law::stress_quotient(s.h[i], s.h[j], data.parameters, data.history);
      const ShearModuli<V> shear = shear_moduli(half, mean, quotient);
      const V even = shear.even * V(0.5) * (M[i][j] + M[j][i]), odd = shear.odd * V(0.5) * (M[i][j] - M[j][i]);
      r[i][j] = inverse[i] * inverse[j] * (even + odd);
      r[j][i] = inverse[i] * inverse[j] * (even - odd);
    }
  return r;
}

// ∂τ/∂h of the stress of the energy, without the return map.
template <class Law, class V, int D>
MPM_HD Matrix<V, D> principal_moduli(const Vector<V, D>& h, const PrincipalData<Law, V>& data, Vector<V, D>& tau) {
  PrincipalData<Law, Dual<V>> constant_data;
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    constant_data.parameters[k] = {data.parameters[k], V(0)};
  MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
    constant_data.history[k] = {data.history[k], V(0)};
  Matrix<V, D> moduli;
  MPM_UNROLL for (int j = 0; j < D; j++) {
    Vector<Dual<V>, D> strain;
    MPM_UNROLL for (int i = 0; i < D; i++)
      strain[i] = {h[i], V(i == j ? 1.0 : 0.0)};
    const Vector<Dual<V>, D> stress = Law::stress(strain, constant_data.parameters, constant_data.history);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      moduli[i][j] = stress[i].derivative;
      tau[i] = stress[i].value;
    }
  }
  return moduli;
}

// Upper bound of |dτ/dF : G F| + max |τᵢ| ≥ the second variation of ψ, over velocity gradients G with |G| = 1. In
// principal axes the diagonal of dτ is the tangent; off the diagonal, with d = hᵢ − hⱼ, its size is at most
// |τᵢ − τⱼ|/sinh d √cosh 2d ≤ |τᵢ − τⱼ|/d √(1 + 2d²).
template <class Law, class T, int D>
MPM_HD T stiffness_bound(const Response<Law, T, D>& r, const PrincipalData<Law, T>& data) {
  const PrincipalTangent<T, D> tangent = Law::tangent(r.h, data.parameters, r.history);
  T diagonal = T(0), shear = T(0), largest = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    diagonal = max(diagonal, abs(tangent.shear[i]));
    largest = max(largest, abs(r.tau[i]));
    MPM_UNROLL for (int j = i + 1; j < D; j++) {
      const T d = r.h[i] - r.h[j];
      const T quotient = abs(Law::stress_quotient(r.h[i], r.h[j], data.parameters, r.history));
      shear = max(shear, quotient * sqrt(T(1) + T(2) * d * d));
    }
  }
  return max(diagonal + T(D) * abs(tangent.dilation), shear) + largest;
}

// Upper bound of the second variation over G = a nᵀ with unit a and n, that is of ρ₀ c² of plane waves. With the
// tangent A it is Σ (Aᵢᵢ − τᵢ) aᵢ²nᵢ² + Σ_{i≠j} mᵢⱼ aᵢ²nⱼ² + 2 Σ_{i<j} cᵢⱼ aᵢaⱼnᵢnⱼ, where with d = hᵢ − hⱼ and the
// quotient t of the stresses m = t e^(−d)/(2 sinhc d) and c = Aᵢⱼ + t d coth d/2 − (τᵢ + τⱼ)/2, and 2 aᵢaⱼnᵢnⱼ ≤ aᵢ²nⱼ²
// + aⱼ²nᵢ²: a weighted mean of the coefficients, exact at rest.
template <class Law, class T, int D>
MPM_HD T wave_modulus_bound(const Response<Law, T, D>& r, const PrincipalData<Law, T>& data) {
  const PrincipalTangent<T, D> tangent = Law::tangent(r.h, data.parameters, r.history);
  T largest = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    largest = max(largest, tangent.shear[i] + tangent.dilation - r.tau[i]);
    MPM_UNROLL for (int j = i + 1; j < D; j++) {
      const T d = abs(r.h[i] - r.h[j]), root = sqrt(T(1) + d * d);  // ≥ d coth d ≥ 1
      const T half = T(0.5) * Law::stress_quotient(r.h[i], r.h[j], data.parameters, r.history);
      const T mean = tangent.dilation - T(0.5) * (r.tau[i] + r.tau[j]);
      const T mixed = max(abs(mean + half), abs(mean + half * root));
      largest = max(largest, max(half, T(0)) * (root + d) + mixed);
    }
  }
  return largest;
}

// Bodies of the kernels.
template <class Law>
struct PrincipalKernels {
  template <class At, class T, int D>
  MPM_HD static void update(const LawUpdateArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const Matrix<V, D> F = load_matrix<D>(at, a.law.state);
    const HenckyStrain<V, D> s = hencky_strain(F);
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    const Response<Law, V, D> r = respond<Law>(s.h, data);
    const auto valid = s.valid & (poison(r) == V(0));
    const auto moved = valid & r.flow.plastic;
    MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
      store_entry(at, a.history, k, select(moved, r.history[k], data.history[k]));
    if (a.dissipated.pointer) at.store(a.dissipated.pointer, a.dissipated.stride[0], select(moved, r.dissipated, V(0)));
    if (a.multiplier.pointer)
      at.store(a.multiplier.pointer, a.multiplier.stride[0], select(moved, plastic_increment(s.h, r.h).norm, V(0)));
    if (a.branch) {
      const V branch =
          select(r.flow.plastic, V(kPlasticFlow), V(kElasticFlow)) + select(r.flow.converged, V(0), V(kNotConverged));
      at.store_integer(a.branch, select(valid, branch, V(kInvalidFlow)));
    }
    store_matrix<D>(at, a.stress, select(valid, compose(s.U, r.tau, s.U), zero_matrix<V, D>()));
    if constexpr (Law::plastic) {
      Vector<V, D> factor;
      MPM_UNROLL for (int i = 0; i < D; i++)
        factor[i] = exponential(r.h[i] - s.h[i]) / s.scale;
      store_matrix<D>(at, a.state, select(moved, compose(s.U, factor, s.B), F));
    }
  }

  template <class At, class T, int D>
  MPM_HD static void update_backward(const LawBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const PrincipalGrads<Law, V, D> grad = load_grads<Law>(at, a);
    const Matrix<V, D> F = load_matrix<D>(at, a.law.state);
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    const HenckyStrain<V, D> s = hencky_strain(F);
    const Response<Law, V, D> r = respond<Law>(s.h, data);
    const auto valid = s.valid & (poison(r) == V(0));
    const Matrix<V, D> by_F = map_adjoint<Law>(
        s, data, r, grad, a.parameters.pointer != nullptr, a.history.pointer != nullptr,
        [&](int k, const V& value) { store_entry(at, a.parameters, k, select(valid, value, V(0))); },
        [&](int k, const V& value) { store_entry(at, a.history, k, select(valid, value, grad.history[k])); });
    if (a.state.pointer) store_matrix<D>(at, a.state, select(valid, by_F, grad.F));
  }

  template <class At, class T, int D>
  MPM_HD static void scalar(const LawScalarArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.law.state));
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    V value;
    if (a.which == LawScalar::energy) {
      value = Law::energy(s.h, data.parameters, data.history);
    } else {
      const Response<Law, V, D> r = respond<Law>(s.h, data);
      value = (a.which == LawScalar::stiffness ? stiffness_bound(r, data) : wave_modulus_bound(r, data)) + poison(r);
    }
    const V invalid = V(a.which == LawScalar::energy ? INFINITY : 0.0);
    at.store(a.value.pointer, a.value.stride[0], select(s.valid & (value - value == V(0)), value, invalid));
  }

  template <class At, class T, int D>
  MPM_HD static void energy_backward(const LawEnergyBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.law.state));
    const V grad = at.load(a.grad_energy.pointer, a.grad_energy.stride[0]);
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    const V energy = Law::energy(s.h, data.parameters, data.history);
    const auto valid = s.valid & (energy - energy == V(0));
    const Matrix<V, D> by_F = energy_adjoint<Law>(
        s, data, grad, a.parameters.pointer != nullptr, a.history.pointer != nullptr,
        [&](int k, const V& value) { store_entry(at, a.parameters, k, select(valid, value, V(0))); },
        [&](int k, const V& value) {  // a law may go without some of its history
          if (a.law.history[k].pointer) store_entry(at, a.history, k, select(valid, value, V(0)));
        });
    if (a.state.pointer) store_matrix<D>(at, a.state, select(valid, by_F, zero_matrix<V, D>()));
  }

  template <class At, class T, int D>
  MPM_HD static void tangent(const LawTangentArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.law.state));
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    Vector<V, D> tau;
    const Matrix<V, D> moduli = principal_moduli<Law>(s.h, data, tau);
    Tangent<V, D> t = principal_tangent(
        s, tau, moduli, load_matrix<D>(at, a.before), load_scalar(at, a.weight),
        [&](int i, int j) { return Law::stress_quotient(s.h[i], s.h[j], data.parameters, data.history); });
    if (a.projected) project(t);
    store_tangent(at, a.tangent, s.valid, t);
  }

  // For g ψ(F, p) along a direction: the derivatives of g ∂ψ/∂F and g ∂ψ/∂p, and that of ψ, which is by g.
  template <class At, class T, int D>
  MPM_HD static void energy_double_backward(const LawEnergyDoubleBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.law.state));
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    const V grad = at.load(a.grad_energy.pointer, a.grad_energy.stride[0]);
    const Matrix<V, D> right = right_axes(s), M = transpose(s.U) * load_matrix_or_zero<D>(at, a.along_state) * right;

    Vector<Dual<V>, D> h;
    PrincipalData<Law, Dual<V>> moved;
    MPM_UNROLL for (int i = 0; i < D; i++)
      h[i] = {s.h[i], M[i][i] * s.scale * s.inverse[i]};
    MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
      moved.parameters[k] = {data.parameters[k],
                             a.along_parameters.pointer ? load_entry(at, a.along_parameters, k) : V(0)};
    MPM_UNROLL for (int k = 0; k < kHistory<Law>; k++)
      moved.history[k] = {data.history[k], V(0)};
    const Dual<V> energy = Law::energy(h, moved.parameters, moved.history);
    const auto valid = s.valid & (energy.value - energy.value == V(0));

    if (a.energy.pointer) at.store(a.energy.pointer, a.energy.stride[0], select(valid, energy.derivative, V(0)));
    if (a.state.pointer) {
      const Vector<Dual<V>, D> tau = Law::stress(h, moved.parameters, moved.history);
      const Matrix<V, D> by_F = grad * (s.U * stress_derivative<Law>(s, data, h, tau, M) * transpose(right));
      store_matrix<D>(at, a.state, select(valid, by_F, zero_matrix<V, D>()));
    }
    if (a.parameters.pointer) MPM_UNROLL
      for (int k = 0; k < kParameters<Law>; k++)
        store_entry(at, a.parameters, k, select(valid, grad * energy_slope(h, moved, k).derivative, V(0)));
  }

 private:
  // ∂ψ/∂pₖ.
  template <class V, int D>
  MPM_HD static V energy_slope(const Vector<V, D>& h, const PrincipalData<Law, V>& data, int k) {
    Vector<Dual<V>, D> strain;
    PrincipalData<Law, Dual<V>> given;
    MPM_UNROLL for (int i = 0; i < D; i++)
      strain[i] = {h[i], V(0.0)};
    MPM_UNROLL for (int n = 0; n < kParameters<Law>; n++)
      given.parameters[n] = {data.parameters[n], V(n == k ? 1.0 : 0.0)};
    MPM_UNROLL for (int n = 0; n < kHistory<Law>; n++)
      given.history[n] = {data.history[n], V(0.0)};
    return Law::energy(strain, given.parameters, given.history).derivative;
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
