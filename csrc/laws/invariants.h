#pragma once

#include "common/wide.h"
#include "laws/law.h"
#include "laws/strain.h"
#include "laws/tangent.h"

// Laws without a decomposition: stress and energy follow from F Fᵀ, J and the velocity gradient. Such a law defines
//   energy(s, p), stress(s, p)          ψ and the Kirchhoff stress τ of a Strain s, with its parameters p;
//   wave_modulus(s, p)                  ρ₀ c² of the fastest plane wave, or an upper bound;
//   stiffness(s, p)                     an upper bound of the tangent modulus over all velocity gradients of unit norm.
// It has no history. Derivatives of first and second order come from dual numbers.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class Law>
struct InvariantKernels;

struct InvariantLaw {
  static constexpr bool viscous = false, plastic = false, twice_differentiable = true, optional_history = false,
                        twice_differentiable_energy = true, in_2d = true, has_tangent = true, additive = false;
  static constexpr auto history = no_history;
  static constexpr auto options = no_options;
  static constexpr bool memory_bound = true;
  static constexpr int gpu_threads = 256, gpu_update_blocks = 0, gpu_backward_blocks = 0, gpu_p2g_blocks = 4;
  template <class Law>
  using Kernels = InvariantKernels<Law>;
};

template <class Law>
constexpr bool kShear = Law::field == Deformation::gradient;

// Inputs of a law at a particle: F with shear, otherwise J; C with viscosity.
template <class Law, class T, int D>
struct InvariantState {
  Matrix<T, D> F;
  T J;
  Matrix<T, D> C;
  T parameters[kParameters<Law>];

  MPM_HD Strain<T, D> strain() const {
    if constexpr (kShear<Law>)
      return strain_of_deformation(F, C);
    else
      return strain_of_volume(J, C);
  }
};

// J > 0 and x finite, per lane.
template <class T>
MPM_HD auto is_valid(const T& J, const T& x) {
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
  return select(keep, a, zero_matrix<T, D>());
}

template <class Law, class T, int D, class Mask>
MPM_HD InvariantState<Law, T, D> or_zero(const Mask& keep, const InvariantState<Law, T, D>& a) {
  InvariantState<Law, T, D> r;
  r.F = or_zero(keep, a.F);
  r.C = or_zero(keep, a.C);
  r.J = select(keep, a.J, T(0));
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    r.parameters[k] = select(keep, a.parameters[k], T(0));
  return r;
}

template <class Law, class T, int D>
MPM_HD Matrix<T, D> stress_of(const InvariantState<Law, T, D>& state) {
  const Strain<T, D> s = state.strain();
  const Matrix<T, D> tau = Law::stress(s, state.parameters);
  return or_zero(is_valid(s.J, sum_of_entries(tau)), tau);
}

// Requested adjoints.
struct InvariantNeeds {
  bool state, C, parameters;
};

// Gradient of a scalar function of strain and parameters. `derivative(strain, parameters)` returns its derivative in
// the direction of the dual numbers; it is evaluated once for each independent direction.
template <class Law, class T, int D, class Derivative>
MPM_HD InvariantState<Law, T, D> gradient(const InvariantState<Law, T, D>& state, const Strain<T, D>& s,
                                          const InvariantNeeds& needs, const Derivative& derivative) {
  Dual<T> p[kParameters<Law>];
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    p[k] = Dual<T>(state.parameters[k], T(0));

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

  InvariantState<Law, T, D> g;
  g.F = g.C = zero_matrix<T, D>();
  g.J = T(0);
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    g.parameters[k] = T(0);
  if (needs.state) {
    g.J = derivative(vary_volume(s), p);
    if constexpr (kShear<Law>) g.F = T(2) * (symmetric(&Strain<Dual<T>, D>::e) * state.F) + g.J * cofactor(state.F);
  }
  if constexpr (Law::viscous)
    if (needs.C) g.C = symmetric(&Strain<Dual<T>, D>::rate);
  if (needs.parameters) {
    MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++) {
      p[k].derivative = T(1);
      g.parameters[k] = derivative(constant(s), p);
      p[k].derivative = T(0);
    }
  }
  return g;
}

template <class Law, class T, int D>
MPM_HD InvariantState<Law, T, D> stress_adjoint(const InvariantState<Law, T, D>& state, const Matrix<T, D>& grad,
                                                const InvariantNeeds& needs) {
  const Strain<T, D> s = state.strain();
  const auto valid = is_valid(s.J, sum_of_entries(Law::stress(s, state.parameters)));
  const auto work = [&](const Strain<Dual<T>, D>& v, const Dual<T>* p) {
    const Matrix<Dual<T>, D> tau = Law::stress(v, p);
    T r = T(0);
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) r = r + grad[i][j] * tau[i][j].derivative;
    return r;
  };
  return or_zero(valid, gradient(state, s, needs, work));
}

template <class Law, class T, int D>
MPM_HD InvariantState<Law, T, D> energy_adjoint(const InvariantState<Law, T, D>& state, const T& grad,
                                                const InvariantNeeds& needs) {
  const Strain<T, D> s = state.strain();
  const auto valid = is_valid(s.J, Law::energy(s, state.parameters));
  const auto work = [&](const Strain<Dual<T>, D>& v, const Dual<T>* p) { return grad * Law::energy(v, p).derivative; };
  return or_zero(valid, gradient(state, s, needs, work));
}

// Loads and stores of such states, converted to and from the arithmetic V.
template <class Law, class V, class At, class T, int D>
MPM_HD InvariantState<Law, V, D> load_state(const At& at, const LawArguments<T, D>& a) {
  InvariantState<Law, V, D> r;
  if constexpr (kShear<Law>)
    r.F = convert<V>(load_matrix<D>(at, a.state));
  else
    r.J = convert<V>(at.load(a.state.pointer, a.state.stride[0]));
  r.C = zero_matrix<V, D>();
  if constexpr (Law::viscous)
    if (a.C.pointer) r.C = convert<V>(load_matrix<D>(at, a.C));
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    r.parameters[k] = convert<V>(load_parameter(at, a, k));
  return r;
}

template <class Law, class At, class V, class T, int D>
MPM_HD void store_state(const At& at, const InvariantState<Law, V, D>& g, const Field<T>& state, const Field<T>& C,
                        const Field<T>& parameters) {
  using Value = typename At::Value;
  if (state.pointer) {
    if constexpr (kShear<Law>)
      store_matrix<D>(at, state, convert<Value>(g.F));
    else
      at.store(state.pointer, state.stride[0], convert<Value>(g.J));
  }
  if constexpr (Law::viscous)
    if (C.pointer) store_matrix<D>(at, C, convert<Value>(g.C));
  if (parameters.pointer) MPM_UNROLL
    for (int k = 0; k < kParameters<Law>; k++) store_entry(at, parameters, k, convert<Value>(g.parameters[k]));
}

// State with derivatives along a direction; an absent part of it is zero.
template <class Law, class V, class At, class T, int D>
MPM_HD InvariantState<Law, Dual<V>, D> load_direction(const At& at, const LawArguments<T, D>& a,
                                                      const Field<const T>& along_state, const Field<const T>& along_C,
                                                      const Field<const T>& along_parameters) {
  const InvariantState<Law, V, D> s = load_state<Law, V>(at, a);
  const auto pair = [](const Matrix<V, D>& value, const Matrix<V, D>& derivative) {
    Matrix<Dual<V>, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) r[i][j] = Dual<V>(value[i][j], derivative[i][j]);
    return r;
  };
  InvariantState<Law, Dual<V>, D> r;
  if constexpr (kShear<Law>)
    r.F = pair(s.F, convert<V>(load_matrix_or_zero<D>(at, along_state)));
  else
    r.J = Dual<V>(s.J, convert<V>(load_scalar_or_zero(at, along_state)));
  r.C = pair(s.C, convert<V>(load_matrix_or_zero<D>(at, along_C)));
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    r.parameters[k] =
        Dual<V>(s.parameters[k], along_parameters.pointer ? convert<V>(load_entry(at, along_parameters, k)) : V(0));
  return r;
}

template <class Law, class V, int D>
MPM_HD InvariantState<Law, V, D> derivative_of(const InvariantState<Law, Dual<V>, D>& a) {
  InvariantState<Law, V, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) {
      r.F[i][j] = a.F[i][j].derivative;
      r.C[i][j] = a.C[i][j].derivative;
    }
  r.J = a.J.derivative;
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    r.parameters[k] = a.parameters[k].derivative;
  return r;
}

// Tangent of a law with shear: dual numbers at diag(σ), along each strain and along each shear of the principal axes,
// which rotates the axes of the stress by as much as the stretches: dτᵢⱼ = (τᵢ − τⱼ) σⱼ²/(σᵢ² − σⱼ²).
template <class Law, class V, int D>
MPM_HD Tangent<V, D> tangent_of_deformation(const InvariantState<Law, V, D>& state, const HenckyStrain<V, D>& s,
                                            const Matrix<V, D>& before, const V& weight) {
  Vector<V, D> stretch, tau;
  InvariantState<Law, Dual<V>, D> at_rest;
  at_rest.C = zero_matrix<Dual<V>, D>();
  at_rest.F = zero_matrix<Dual<V>, D>();
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    at_rest.parameters[k] = {state.parameters[k], V(0)};
  MPM_UNROLL for (int i = 0; i < D; i++) {
    stretch[i] = exponential(s.h[i]);
    at_rest.F[i][i].value = stretch[i];
  }
  Matrix<V, D> moduli;
  MPM_UNROLL for (int j = 0; j < D; j++) {
    InvariantState<Law, Dual<V>, D> moved = at_rest;
    moved.F[j][j].derivative = stretch[j];
    const Matrix<Dual<V>, D> stress = Law::stress(moved.strain(), moved.parameters);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      moduli[i][j] = stress[i][i].derivative;
      tau[i] = stress[i][i].value;
    }
  }
  return principal_tangent(s, tau, moduli, before, weight, [&](int i, int j) {
    InvariantState<Law, Dual<V>, D> sheared = at_rest;
    sheared.F[i][j].derivative = stretch[j];
    const V turned = Law::stress(sheared.strain(), sheared.parameters)[i][j].derivative;
    return V(2) * turned * stretch[i] / stretch[j] * sinhc(s.h[i] - s.h[j]);
  });
}

// For a fluid, with dJ = J₀ tr L: the same number between all diagonal entries.
template <class Law, class V, int D>
MPM_HD Tangent<V, D> tangent_of_volume(const InvariantState<Law, V, D>& state, const V& before, const V& weight) {
  Dual<V> p[kParameters<Law>];
  MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
    p[k] = {state.parameters[k], V(0)};
  const Dual<V> tension = Law::stress(vary_volume(state.strain()), p)[0][0];  // J ∂ψ/∂J
  const V curvature = (tension.derivative - tension.value / state.J) / state.J;
  Tangent<V, D> t;
  t.U = t.B = identity<V, D>();
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) t.diagonal[i][j] = weight * curvature * before * before;
  MPM_UNROLL for (int k = 0; k < kShears<D>; k++)
    t.even[k] = t.odd[k] = V(0);
  return t;
}

// Bodies of the kernels. Energies are small differences of large terms near rest: they are evaluated in float64 for
// either scalar type.
template <class Law>
struct InvariantKernels {
  template <class At, class T, int D>
  MPM_HD static void update(const LawUpdateArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const InvariantState<Law, V, D> state = load_state<Law, V>(at, a.law);
    store_matrix<D>(at, a.stress, stress_of(state));
    if (a.dissipated.pointer) at.store(a.dissipated.pointer, a.dissipated.stride[0], V(0));
    if (a.multiplier.pointer) at.store(a.multiplier.pointer, a.multiplier.stride[0], V(0));
    if (a.branch) {
      const Strain<V, D> s = state.strain();
      const auto valid = is_valid(s.J, sum_of_entries(Law::stress(s, state.parameters)));
      at.store_integer(a.branch, select(valid, V(kElasticFlow), V(kInvalidFlow)));
    }
  }

  template <class At, class T, int D>
  MPM_HD static void update_backward(const LawBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const InvariantNeeds needs = {a.state.pointer != nullptr, a.C.pointer != nullptr, a.parameters.pointer != nullptr};
    const Matrix<V, D> grad = load_matrix_or_zero<D>(at, a.grad_stress);
    const auto g = stress_adjoint(load_state<Law, V>(at, a.law), grad, needs);
    store_state(at, g, a.state, a.C, a.parameters);
  }

  // For L = τ̄ : τ(z) with gradient ∇L: the derivative of ∇L along a direction, and that of τ, which is ∂/∂τ̄ of ∇L
  // along it.
  template <class At, class T, int D>
  MPM_HD static void double_backward(const LawDoubleBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const auto z = load_direction<Law, V>(at, a.law, a.along_state, a.along_C, a.along_parameters);
    const InvariantNeeds needs = {a.state.pointer != nullptr, a.C.pointer != nullptr, a.parameters.pointer != nullptr};
    const Matrix<V, D> grad = load_matrix<D>(at, a.grad_stress);
    Matrix<Dual<V>, D> constant_grad;
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) constant_grad[i][j] = Dual<V>(grad[i][j], V(0));
    store_state(at, derivative_of(stress_adjoint(z, constant_grad, needs)), a.state, a.C, a.parameters);
    if (!a.stress.pointer) return;
    const Matrix<Dual<V>, D> tau = stress_of(z);
    Matrix<V, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) r[i][j] = tau[i][j].derivative;
    store_matrix<D>(at, a.stress, r);
  }

  template <class At, class T, int D>
  MPM_HD static void scalar(const LawScalarArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    if (a.which == LawScalar::energy) {
      const auto state = load_state<Law, Wide<V>>(at, a.law);
      const auto s = state.strain();
      const Wide<V> value = Law::energy(s, state.parameters);
      at.store(a.value.pointer, a.value.stride[0], convert<V>(select(is_valid(s.J, value), value, Wide<V>(INFINITY))));
      return;
    }
    const InvariantState<Law, V, D> state = load_state<Law, V>(at, a.law);
    const Strain<V, D> s = state.strain();
    const V value =
        a.which == LawScalar::stiffness ? Law::stiffness(s, state.parameters) : Law::wave_modulus(s, state.parameters);
    at.store(a.value.pointer, a.value.stride[0], select(is_valid(s.J, value), value, V(0)));
  }

  template <class At, class T, int D>
  MPM_HD static void energy_backward(const LawEnergyBackwardArguments<T, D>& a, const At& at) {
    using W = Wide<typename At::Value>;
    const InvariantNeeds needs = {a.state.pointer != nullptr, false, a.parameters.pointer != nullptr};
    const W grad = convert<W>(at.load(a.grad_energy.pointer, a.grad_energy.stride[0]));
    store_state(at, energy_adjoint(load_state<Law, W>(at, a.law), grad, needs), a.state, {}, a.parameters);
  }

  template <class At, class T, int D>
  MPM_HD static void tangent(const LawTangentArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    InvariantState<Law, V, D> state = load_state<Law, V>(at, a.law);
    state.C = zero_matrix<V, D>();
    const V weight = load_scalar(at, a.weight);
    if constexpr (kShear<Law>) {
      const HenckyStrain<V, D> s = hencky_strain(state.F);
      Tangent<V, D> t = tangent_of_deformation(state, s, load_matrix<D>(at, a.before), weight);
      if (a.projected) project(t);
      store_tangent(at, a.tangent, s.valid, t);
    } else {
      Tangent<V, D> t = tangent_of_volume(state, load_scalar(at, a.before), weight);
      if (a.projected) project(t);
      store_tangent(at, a.tangent, state.J > V(0), t);
    }
  }

  template <class At, class T, int D>
  MPM_HD static void energy_double_backward(const LawEnergyDoubleBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    using W = Wide<V>;
    const auto z = load_direction<Law, W>(at, a.law, a.along_state, Field<const T>{}, a.along_parameters);
    const InvariantNeeds needs = {a.state.pointer != nullptr, false, a.parameters.pointer != nullptr};
    const Dual<W> grad(convert<W>(at.load(a.grad_energy.pointer, a.grad_energy.stride[0])), W(0));
    store_state(at, derivative_of(energy_adjoint(z, grad, needs)), a.state, {}, a.parameters);
    if (!a.energy.pointer) return;
    const auto s = z.strain();
    const Dual<W> value = Law::energy(s, z.parameters);
    at.store(a.energy.pointer, a.energy.stride[0], convert<V>(select(is_valid(s.J, value), value.derivative, W(0))));
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
