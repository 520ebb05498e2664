#pragma once

#include "laws/elasticity.h"
#include "laws/neo_hookean_solid.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Maxwell branch of a viscoelastic solid in the Hencky strains of its elastic deformation F_e = F F_v⁻¹: ψ = μ_v |dev
// h|², so τ = 2μ_v dev h, and dh/dt = −dev h/T of the viscous flow, with T = η/μ_v (Reese and Govindjee 1998, equation
// 38, with a volume that does not flow). Backward Euler with the exponential map, which is closed: dev H = dev h/(1 +
// Δt/T).
struct MaxwellBranch : PrincipalLaw {
  static constexpr std::array parameters = {not_negative("branch_modulus", "Pa"), positive("relaxation_time", "s"),
                                            time_step};
  static constexpr bool plastic = true;

  // Flow of the deviator, without the difference of h and H.
  template <class T>
  MPM_HD static T share(const T p[]) {
    return p[2] / (p[1] + p[2]);
  }

  template <class T, int D>
  MPM_HD static Flow<T> flow(Vector<T, D>& h, const T p[], T[]) {
    const T kappa = p[1] / (p[1] + p[2]), mean = T(1.0 / D) * sum(h);
    h = scale_deviator(h, mean, mean, kappa);
    return {kappa, p[2] > T(0), T(0) == T(0)};
  }

  template <class T, int D>
  MPM_HD static T map_quotient(const Flow<T>& flow, const Vector<T, D>&, const Vector<T, D>&, int, int) {
    return flow.kappa;
  }

  template <class T, int D>
  MPM_HD static T lost(const Vector<T, D>& h, const Vector<T, D>& H, const T p[], const T[], const T q[]) {
    return share(p) * dot(stress(H, p, q), h);  // its mean does no work
  }

  template <class T, int D>
  MPM_HD static T energy(const Vector<T, D>& h, const T p[], const T[]) {
    const T mean = T(1.0 / D) * sum(h);
    T square = T(0);
    MPM_UNROLL for (int i = 0; i < D; i++)
      square = square + (h[i] - mean) * (h[i] - mean);
    return p[0] * square;
  }

  template <class T, int D>
  MPM_HD static Vector<T, D> stress(const Vector<T, D>& h, const T p[], const T[]) {
    const T mean = T(1.0 / D) * sum(h);
    Vector<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r[i] = T(2) * p[0] * (h[i] - mean);
    return r;
  }

  template <class T, int D>
  MPM_HD static PrincipalTangent<T, D> tangent(const Vector<T, D>&, const T p[], const T[]) {
    PrincipalTangent<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r.shear[i] = T(2) * p[0];
    r.dilation = T(-2.0 / D) * p[0];
    return r;
  }

  template <class T>
  MPM_HD static T stress_quotient(const T&, const T&, const T p[], const T[]) {
    return T(2) * p[0];
  }
};

template <class Law>
struct ViscoelasticKernels;

// Neo-Hookean solid with a parallel Maxwell branch. F itself is unchanged; the flow is in F_v⁻¹, whose difference from
// the identity is the history, zero at first.
struct Viscoelastic : PrincipalLaw {
  static constexpr const char* name = "viscoelastic";
  static constexpr std::array parameters = {NeoHookean::parameters[0], NeoHookean::parameters[1],
                                            MaxwellBranch::parameters[0], MaxwellBranch::parameters[1], time_step};
  static constexpr std::array history = {matrix("inverse_viscous_deformation", "")};
  static constexpr bool has_tangent = false;
  template <class Law>
  using Kernels = ViscoelasticKernels<Law>;
};

template <class Law>
struct ViscoelasticKernels {
  // The parts of a particle: the equilibrium solid, and the branch with its elastic trial deformation F F_v⁻¹.
  template <class V, int D>
  struct Parts {
    InvariantState<NeoHookean, V, D> solid;
    Matrix<V, D> inverse_flow;  // F_v⁻¹
    PrincipalData<MaxwellBranch, V> branch;

    MPM_HD Matrix<V, D> elastic() const { return solid.F * inverse_flow; }
  };

  template <class At, class T, int D>
  MPM_HD static Parts<typename At::Value, D> load(const At& at, const LawArguments<T, D>& a) {
    using V = typename At::Value;
    Parts<V, D> r;
    r.solid = load_state<NeoHookean, V>(at, a);
    r.inverse_flow = identity<V, D>() + load_matrix<D>(at, a.history[0]);
    MPM_UNROLL for (int k = 0; k < 3; k++)
      r.branch.parameters[k] = load_parameter(at, a, 2 + k);
    return r;
  }

  template <class V, int D>
  MPM_HD static Matrix<V, D> inverse(const Matrix<V, D>& F) {
    return (V(1) / determinant(F)) * transpose(cofactor(F));
  }

  // Branch strains, response and validity of the whole.
  template <class V, int D>
  struct State {
    HenckyStrain<V, D> s;
    Response<MaxwellBranch, V, D> r;
    Matrix<V, D> stress;
    MaskOf<V> valid;
  };

  template <class V, int D>
  MPM_HD static State<V, D> respond_to(const Parts<V, D>& p) {
    State<V, D> r;
    r.s = hencky_strain(p.elastic());
    r.r = respond<MaxwellBranch>(r.s.h, p.branch);
    r.stress = NeoHookean::stress(p.solid.strain(), p.solid.parameters) + compose(r.s.U, r.r.tau, r.s.U);
    const V nan = poison(r.r) + (sum_of_entries(r.stress) - sum_of_entries(r.stress));
    r.valid = r.s.valid & (determinant(p.solid.F) > V(0)) & (nan == V(0));
    return r;
  }

  // F_e after the flow, U diag(exp H) Vᵀ.
  template <class V, int D>
  MPM_HD static Matrix<V, D> flowed(const State<V, D>& state) {
    Vector<V, D> factor;
    MPM_UNROLL for (int i = 0; i < D; i++)
      factor[i] = exponential(state.r.h[i] - state.s.h[i]) / state.s.scale;
    return compose(state.s.U, factor, state.s.B);
  }

  template <class At, class V, class T, int D>
  MPM_HD static void store_entries(const At& at, const Field<T>& f, const Matrix<V, D>& a) {
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) store_entry(at, f, i * D + j, a[i][j]);
  }

  template <class At, class T, int D>
  MPM_HD static void update(const LawUpdateArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const Parts<V, D> p = load(at, a.law);
    const State<V, D> state = respond_to(p);
    store_matrix<D>(at, a.stress, select(state.valid, state.stress, zero_matrix<V, D>()));
    // F_v⁻¹ changes by F⁻¹ U diag(exp(H − h) − 1) Uᵀ F_e, which preserves the digits of a slow flow.
    const V share = MaxwellBranch::share(p.branch.parameters), mean = V(1.0 / D) * sum(state.s.h);
    Vector<V, D> rate;
    MPM_UNROLL for (int i = 0; i < D; i++)
      rate[i] = expm1(share * (mean - state.s.h[i]));
    const Matrix<V, D> change = inverse(p.solid.F) * (compose(state.s.U, rate, state.s.U) * p.elastic());
    const Matrix<V, D> before = load_matrix<D>(at, a.law.history[0]);
    store_entries(at, a.history, select(state.valid, before + change, before));
    if (a.dissipated.pointer)
      at.store(a.dissipated.pointer, a.dissipated.stride[0], select(state.valid, state.r.dissipated, V(0)));
    if (a.multiplier.pointer)
      at.store(a.multiplier.pointer, a.multiplier.stride[0],
               select(state.valid, plastic_increment(state.s.h, state.r.h).norm, V(0)));
    const V branch = select(state.r.flow.plastic, V(kPlasticFlow), V(kElasticFlow));
    if (a.branch) at.store_integer(a.branch, select(state.valid, branch, V(kInvalidFlow)));
  }

  // By F_e = F F_v⁻¹ of the branch and by F of the solid; then F_v⁻¹ after the flow is F⁻¹ F_e, whose adjoint adds to
  // that of F_e, and −F⁻ᵀ Ḡ Gᵀ to that of F.
  template <class At, class T, int D>
  MPM_HD static void update_backward(const LawBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const Parts<V, D> p = load(at, a.law);
    const State<V, D> state = respond_to(p);
    const Matrix<V, D> grad_stress = load_matrix_or_zero<D>(at, a.grad_stress), back = inverse(p.solid.F);
    Matrix<V, D> grad_flow = zero_matrix<V, D>();
    if (a.grad_history.pointer) MPM_UNROLL
      for (int i = 0; i < D; i++) MPM_UNROLL
        for (int j = 0; j < D; j++) grad_flow[i][j] = load_entry(at, a.grad_history, i * D + j);
    const Matrix<V, D> grad_mapped = transpose(back) * grad_flow;

    const auto solid = or_zero(state.valid, stress_adjoint(p.solid, grad_stress, needs(a.parameters)));
    store_state(at, solid, {}, {}, a.parameters);
    const PrincipalGrads<MaxwellBranch, V, D> grad = {grad_mapped,
                                                      grad_stress,
                                                      {V(0)},
                                                      load_scalar_or_zero(at, a.grad_dissipated),
                                                      load_scalar_or_zero(at, a.grad_multiplier)};
    const Matrix<V, D> by_elastic = map_adjoint<MaxwellBranch>(
        state.s, p.branch, state.r, grad, a.parameters.pointer != nullptr, false,
        [&](int k, const V& value) { store_entry(at, a.parameters, 2 + k, select(state.valid, value, V(0))); },
        [](int, const V&) {});
    if (a.state.pointer) {
      const Matrix<V, D> flow = back * flowed(state);
      const Matrix<V, D> by_F = solid.F + by_elastic * transpose(p.inverse_flow) - grad_mapped * transpose(flow);
      store_matrix<D>(at, a.state, select(state.valid, by_F, zero_matrix<V, D>()));
    }
    if (a.history.pointer)
      store_entries(at, a.history, select(state.valid, transpose(p.solid.F) * by_elastic, grad_flow));
  }

  template <class T>
  MPM_HD static InvariantNeeds needs(const Field<T>& parameters) {
    return {true, false, parameters.pointer != nullptr};
  }

  template <class At, class T, int D>
  MPM_HD static void scalar(const LawScalarArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const Parts<V, D> p = load(at, a.law);
    const State<V, D> state = respond_to(p);
    V value;
    if (a.which == LawScalar::energy) {
      const auto wide = load_state<NeoHookean, Wide<V>>(at, a.law);
      value = convert<V>(NeoHookean::energy(wide.strain(), wide.parameters)) +
              MaxwellBranch::energy(state.s.h, p.branch.parameters, p.branch.history);
    } else if (a.which == LawScalar::stiffness) {
      value = NeoHookean::stiffness(p.solid.strain(), p.solid.parameters) + stiffness_bound(state.r, p.branch);
    } else {
      value = NeoHookean::wave_modulus(p.solid.strain(), p.solid.parameters) + wave_modulus_bound(state.r, p.branch);
    }
    const V invalid = V(a.which == LawScalar::energy ? INFINITY : 0.0);
    at.store(a.value.pointer, a.value.stride[0], select(state.valid & (value - value == V(0)), value, invalid));
  }

  template <class At, class T, int D>
  MPM_HD static void energy_backward(const LawEnergyBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const Parts<V, D> p = load(at, a.law);
    const State<V, D> state = respond_to(p);
    const V grad = at.load(a.grad_energy.pointer, a.grad_energy.stride[0]);
    const auto solid = or_zero(state.valid, energy_adjoint(p.solid, grad, needs(a.parameters)));
    store_state(at, solid, {}, {}, a.parameters);
    const Matrix<V, D> by_elastic = energy_adjoint<MaxwellBranch>(
        state.s, p.branch, grad, a.parameters.pointer != nullptr, false,
        [&](int k, const V& value) { store_entry(at, a.parameters, 2 + k, select(state.valid, value, V(0))); },
        [](int, const V&) {});
    const Matrix<V, D> zero = zero_matrix<V, D>();
    if (a.state.pointer)
      store_matrix<D>(at, a.state, select(state.valid, solid.F + by_elastic * transpose(p.inverse_flow), zero));
    if (a.history.pointer) store_entries(at, a.history, select(state.valid, transpose(p.solid.F) * by_elastic, zero));
  }
};

MPM_REGISTER_LAW(Viscoelastic)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
