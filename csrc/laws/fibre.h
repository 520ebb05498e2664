#pragma once

#include "laws/invariants.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class Law>
struct FibreKernels;

// Fibres with a direction d at rest and an active stress a, added to a law of the surrounding solid:
//   ψ = a/2 (|F d|² − 1),   τ = a (F d) (F d)ᵀ,
// the actuation F A Fᵀ of ChainQueen (Hu et al. 2019) with A = a d dᵀ. In 2-D the last entry of d has no meaning.
struct Fibre : InvariantLaw {
  static constexpr const char* name = "fibre";
  static constexpr Deformation field = Deformation::gradient;
  static constexpr std::array parameters = {real("activation", "Pa"), real("direction_x", ""), real("direction_y", ""),
                                            real("direction_z", "")};
  static constexpr bool additive = true, has_tangent = false;
  template <class Law>
  using Kernels = FibreKernels<Law>;
};

// Fibre of a particle; also the adjoints of its entries.
template <class S, int D>
struct FibreState {
  Matrix<S, D> F;
  S active_stress;
  Vector<S, D> direction;

  MPM_HD Vector<S, D> stretched() const { return F * direction; }
  MPM_HD Matrix<S, D> stress() const {
    const Vector<S, D> f = stretched();
    return outer(active_stress * f, f);
  }
  MPM_HD S energy() const {
    const Vector<S, D> f = stretched();
    return S(0.5) * active_stress * (dot(f, f) - S(1));
  }

  // Of τ̄ : τ.
  MPM_HD FibreState stress_adjoint(const Matrix<S, D>& grad) const {
    const Vector<S, D> f = stretched(), twice = grad * f + transpose(grad) * f;
    return by_stretched(S(0.5) * dot(f, twice), active_stress * twice);
  }
  // Of ψ̄ ψ.
  MPM_HD FibreState energy_adjoint(const S& grad) const {
    const Vector<S, D> f = stretched();
    return by_stretched(S(0.5) * grad * (dot(f, f) - S(1)), (grad * active_stress) * f);
  }

 private:
  MPM_HD FibreState by_stretched(const S& by_active_stress, const Vector<S, D>& by_f) const {
    return {outer(by_f, direction), by_active_stress, transpose(F) * by_f};
  }
};

// Bodies of the kernels.
template <class Law>
struct FibreKernels {
  template <class At, class T, int D>
  MPM_HD static FibreState<typename At::Value, D> load(const At& at, const LawArguments<T, D>& a) {
    return load_as<typename At::Value>(at, a);
  }

  // In the arithmetic V.
  template <class V, class At, class T, int D>
  MPM_HD static FibreState<V, D> load_as(const At& at, const LawArguments<T, D>& a) {
    FibreState<V, D> s;
    s.F = convert<V>(load_matrix<D>(at, a.state));
    s.active_stress = convert<V>(load_parameter(at, a, 0));
    MPM_UNROLL for (int i = 0; i < D; i++)
      s.direction[i] = convert<V>(load_parameter(at, a, 1 + i));
    return s;
  }

  // Whether the solid has a valid stress. An active stress that is not finite is not hidden.
  template <class V, int D>
  MPM_HD static MaskOf<V> is_valid_at(const FibreState<V, D>& s) {
    const V J = determinant(s.F);
    return is_valid(J, J);
  }

  // State with derivatives along a direction; an absent part of it is zero.
  template <class At, class T, int D>
  MPM_HD static FibreState<Dual<typename At::Value>, D> load_direction(const At& at, const LawArguments<T, D>& a,
                                                                       const Field<const T>& along_state,
                                                                       const Field<const T>& along_parameters) {
    using V = typename At::Value;
    const FibreState<V, D> s = load(at, a);
    const Matrix<V, D> along = load_matrix_or_zero<D>(at, along_state);
    const auto entry = [&](int k) { return along_parameters.pointer ? load_entry(at, along_parameters, k) : V(0); };
    FibreState<Dual<V>, D> z;
    z.active_stress = {s.active_stress, entry(0)};
    MPM_UNROLL for (int i = 0; i < D; i++) {
      z.direction[i] = {s.direction[i], entry(1 + i)};
      MPM_UNROLL for (int j = 0; j < D; j++)
        z.F[i][j] = {s.F[i][j], along[i][j]};
    }
    return z;
  }

  template <class At, class V, class T, int D>
  MPM_HD static void store(const At& at, const MaskOf<V>& valid, const FibreState<V, D>& g, const Field<T>& state,
                           const Field<T>& parameters) {
    if (state.pointer) store_matrix<D>(at, state, or_zero(valid, g.F));
    if (!parameters.pointer) return;
    store_entry(at, parameters, 0, select(valid, g.active_stress, V(0)));
    MPM_UNROLL for (int i = 0; i < 3; i++)
      store_entry(at, parameters, 1 + i, i < D ? select(valid, g.direction[i < D ? i : 0], V(0)) : V(0));
  }

  template <class V, int D>
  MPM_HD static FibreState<V, D> derivative(const FibreState<Dual<V>, D>& z) {
    FibreState<V, D> g;
    g.active_stress = z.active_stress.derivative;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      g.direction[i] = z.direction[i].derivative;
      MPM_UNROLL for (int j = 0; j < D; j++)
        g.F[i][j] = z.F[i][j].derivative;
    }
    return g;
  }

  template <class At, class T, int D>
  MPM_HD static void update(const LawUpdateArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const FibreState<V, D> s = load(at, a.law);
    const MaskOf<V> valid = is_valid_at(s);
    store_matrix<D>(at, a.stress, or_zero(valid, s.stress()));
    if (a.dissipated.pointer) at.store(a.dissipated.pointer, a.dissipated.stride[0], V(0));
    if (a.multiplier.pointer) at.store(a.multiplier.pointer, a.multiplier.stride[0], V(0));
    if (a.branch) at.store_integer(a.branch, select(valid, V(kElasticFlow), V(kInvalidFlow)));
  }

  template <class At, class T, int D>
  MPM_HD static void update_backward(const LawBackwardArguments<T, D>& a, const At& at) {
    const auto s = load(at, a.law);
    store(at, is_valid_at(s), s.stress_adjoint(load_matrix_or_zero<D>(at, a.grad_stress)), a.state, a.parameters);
  }

  template <class At, class T, int D>
  MPM_HD static void double_backward(const LawDoubleBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const FibreState<Dual<V>, D> z = load_direction(at, a.law, a.along_state, a.along_parameters);
    const MaskOf<V> valid = is_valid_at(load(at, a.law));
    const Matrix<V, D> grad = load_matrix<D>(at, a.grad_stress);
    Matrix<Dual<V>, D> constant_grad;
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) constant_grad[i][j] = Dual<V>(grad[i][j], V(0));
    store(at, valid, derivative(z.stress_adjoint(constant_grad)), a.state, a.parameters);
    if (!a.stress.pointer) return;
    const Matrix<Dual<V>, D> tau = z.stress();
    Matrix<V, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) r[i][j] = tau[i][j].derivative;
    store_matrix<D>(at, a.stress, or_zero(valid, r));
  }

  // The second variation of ψ is a |G F d|², at most |a| |F d|² |G|², as for a plane wave; |dτ/dF : G F| is at most
  // twice as much.
  template <class At, class T, int D>
  MPM_HD static void scalar(const LawScalarArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const FibreState<V, D> s = load(at, a.law);
    const MaskOf<V> valid = is_valid_at(s);
    if (a.which == LawScalar::energy) {  // a small difference near rest
      const V energy = convert<V>(load_as<Wide<V>>(at, a.law).energy());
      return at.store(a.value.pointer, a.value.stride[0], select(valid, energy, V(INFINITY)));
    }
    const Vector<V, D> f = s.stretched();
    const V modulus = abs(s.active_stress) * dot(f, f),
            value = a.which == LawScalar::stiffness ? V(2) * modulus : modulus;
    at.store(a.value.pointer, a.value.stride[0], select(valid, value, V(0)));
  }

  template <class At, class T, int D>
  MPM_HD static void energy_backward(const LawEnergyBackwardArguments<T, D>& a, const At& at) {
    const auto s = load(at, a.law);
    store(at, is_valid_at(s), s.energy_adjoint(load_scalar(at, a.grad_energy)), a.state, a.parameters);
  }

  template <class At, class T, int D>
  MPM_HD static void energy_double_backward(const LawEnergyDoubleBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const FibreState<Dual<V>, D> z = load_direction(at, a.law, a.along_state, a.along_parameters);
    const MaskOf<V> valid = is_valid_at(load(at, a.law));
    const Dual<V> grad(load_scalar(at, a.grad_energy), V(0));
    store(at, valid, derivative(z.energy_adjoint(grad)), a.state, a.parameters);
    if (a.energy.pointer) at.store(a.energy.pointer, a.energy.stride[0], select(valid, z.energy().derivative, V(0)));
  }
};

MPM_REGISTER_LAW(Fibre)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
