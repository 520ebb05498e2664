#pragma once

#include "laws/principal_law.h"
#include "laws/quartic_return_map.h"

// Sand as a law: one decomposition, the return map of the principal strains, and its adjoint.
//
// With a volume correction (Tampubolon et al. 2017) sand at the apex is torn: it loses all strain, cohesion included,
// and stores the logarithm v_c of the volume. Until compression has closed that gap it has no stress and no cohesion:
// the map uses the trial strain h + v_c/D, and sand is at the apex while tr h + v_c ≥ 0.
//
// With hardening (Klár et al. 2016, equations 29 and 30) the friction angle is φ + (h1 q − h3) exp(−h2 q), where φ is
// the angle of the given slope and q the sum of the plastic multipliers of all steps before.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class Law>
struct SandKernels;

enum SandOption : int { kKeepApex = 1, kElasticOnly = 2, kHardens = 4 };

// A law of sand with an energy of laws/quartic_energy.h, or ExactFlow of one.
template <class Energy_>
struct Sand : PrincipalLaw {
  using Energy = Energy_;
  static constexpr std::array parameters = {not_negative("mu", "Pa"),
                                            real("lam", "Pa"),
                                            not_negative("friction_slope", ""),
                                            not_negative("cohesion", ""),
                                            not_negative("smallest_strain", ""),
                                            not_negative("h1", ""),
                                            not_negative("h2", ""),
                                            real("h3", "")};
  static constexpr std::array history = {with_option("hardens", not_negative("hardening", "")),
                                         real("volume_correction", "")};
  static constexpr bool plastic = true, optional_history = true, in_2d = !Energy::exact_flow;
  static constexpr bool twice_differentiable_energy = true;
  // keep_apex: see return_map; elastic: F is unchanged; hardens: h1 to h3 and the first history variable are read.
  static constexpr std::array options = {"keep_apex", "elastic", "hardens"};
  // Those of the update affect only the exact flow, whose rare roots in float64 would need as many registers; the
  // backward would lose a third of its time with 190.
  static constexpr int gpu_update_blocks = 5, gpu_backward_blocks = 4;
  template <class Law>
  using Kernels = SandKernels<Law>;

  template <class T, int D>
  MPM_HD static T energy(const Vector<T, D>& h, const T p[], const T[]) {
    return sand_energy<Energy>(h, p[0], p[1]);
  }

  template <class T, int D>
  MPM_HD static Vector<T, D> stress(const Vector<T, D>& h, const T p[], const T[]) {
    return sand_stress<Energy>(h, p[0], p[1]);
  }

  template <class T>
  MPM_HD static T stress_quotient(const T& a, const T& b, const T p[], const T[]) {
    return mpm::stress_quotient<Energy>(a, b, p[0]);
  }
};

constexpr double kRootOfTwoThirds = 0.81649658092772603;

// Slope of a cone by the sine of its friction angle (`friction_alpha` of torch_mpm/ops/sand.py), and the inverse.
template <int D, class T>
MPM_HD T slope_of_sine(const T& sine) {
  return D == 2 ? T(M_SQRT1_2) * sine : T(2 * kRootOfTwoThirds) * sine / (T(3) - sine);
}
template <int D, class T>
MPM_HD T sine_of_slope(const T& slope) {
  return D == 2 ? T(M_SQRT2) * slope : T(3) * slope / (T(2 * kRootOfTwoThirds) + slope);
}

// Parameters of the slope of a cone.
enum SlopeParameter : int { kSlope, kH1, kH2, kH3, kHardening, kSlopeParameters };

// The slope after hardening.
template <int D, class T>
MPM_HD T hardened_slope(const T (&p)[kSlopeParameters]) {
  const T sine = sine_of_slope<D>(p[kSlope]), rest = T(1) - sine * sine;
  const T cosine = sqrt(select(rest > T(0), rest, T(0)));
  const T change = (p[kH1] * p[kHardening] - p[kH3]) * exponential(T(0) - p[kH2] * p[kHardening]);
  return slope_of_sine<D>(sine * cos(change) + cosine * sin(change));
}

template <class T>
struct SandParameters {
  T mu, lam;
  T slope[kSlopeParameters];  // of the cone, before hardening
  T cohesion, volume;         // the cohesion of torn sand is 0
  Cone<T> cone;
  MaskOf<T> shear, torn;  // μ > 0; v_c > 0 where the apex loses volume
};

// Whether the apex preserves the volume: nothing tears.
template <class Energy, class T, int D>
MPM_HD bool keeps_volume(const LawArguments<T, D>& a) {
  return Energy::unilateral_yield && (a.options & kKeepApex);
}

// The volume correction, and its place in the history.
template <class T, int D>
MPM_HD Field<const T> volume_correction(const LawArguments<T, D>& a) {
  return a.options & kHardens ? a.history[1] : a.history[0];
}
template <class T, int D>
MPM_HD int volume_place(const LawArguments<T, D>& a) {
  return a.options & kHardens ? 1 : 0;
}

// Entry k of a field [P, n] as a scalar field.
template <class T>
MPM_HD Field<T> entry_of(Field<T> f, int k) {
  if (f.pointer) f.pointer += k * f.stride[1];
  return f;
}

template <class Energy, class V, class At, class T, int D>
MPM_HD SandParameters<V> load_parameters(const At& at, const LawArguments<T, D>& a) {
  const auto load = [&](int k) { return convert<V>(load_parameter(at, a, k)); };
  SandParameters<V> r;
  r.mu = load(0);
  r.lam = load(1);
  r.slope[kSlope] = load(2);
  V alpha = r.slope[kSlope];
  if (a.options & kHardens) {
    r.slope[kH1] = load(5), r.slope[kH2] = load(6), r.slope[kH3] = load(7);
    r.slope[kHardening] = convert<V>(load_scalar_or_zero(at, a.history[0]));
    alpha = hardened_slope<D>(r.slope);
  }
  r.volume = convert<V>(load_scalar_or_zero(at, volume_correction(a)));
  r.torn = (keeps_volume<Energy>(a) ? V(0) : r.volume) > V(0);
  r.cohesion = select(r.torn, V(0), load(3));
  r.shear = r.mu > V(0);
  r.cone = {alpha, select(r.shear, r.lam / select(r.shear, r.mu, V(1)), V(0))};
  return r;
}

template <class T, int D>
MPM_HD Vector<T, D> shifted(const Vector<T, D>& h, const T& shift) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = h[i] + shift;
  return r;
}

template <class T, int D>
MPM_HD MappedStrain<T, D> unmapped(const Vector<T, D>& h) {
  const auto none = T(0) < T(0);
  const Vector<T, D> zero = zero_vector<T, D>();
  return {h, zero, T(0), T(0), T(1), T(0), T(0), T(0), none, none, T(0) == T(0)};
}

// Result at a particle, in principal axes.
template <class T, int D>
struct SandState {
  MappedStrain<T, D> m;    // relative to the apex of the cone
  Vector<T, D> h, stress;  // principal strains and stresses
  MaskOf<T> valid, moved, tears;
};

// The cone has its apex at the strain of the cohesion on every axis.
template <class Energy, class Rough, class V, class T, int D>
MPM_HD_LARGE SandState<V, D> sand_state(const HenckyStrain<V, D>& s, const SandParameters<V>& p,
                                        const LawArguments<T, D>& a) {
  const auto never = V(0) < V(0);
  const bool keeps = keeps_volume<Energy>(a);
  const Vector<V, D> trial = shifted(s.h, V(1.0 / D) * p.volume - p.cohesion);
  SandState<V, D> r;
  r.m =
      !(a.options & kElasticOnly) ? return_map<Energy, Rough>(trial, p.cone, p.shear, p.torn, keeps) : unmapped(trial);
  r.tears = volume_correction(a).pointer && !keeps ? r.m.apex : never;
  r.h = shifted(r.m.h, select(r.tears, V(0), p.cohesion));
  r.stress = sand_stress<Energy>(r.h, p.mu, p.lam);
  V finite = V(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    finite = finite + (r.stress[i] - r.stress[i]);
  r.valid = s.valid & (finite == V(0));
  r.moved = r.valid & (r.m.cone | r.m.apex | (p.volume > V(0)) | (p.volume < V(0)));
  return r;
}

// Energy that turns into heat, ψ(x) − ψ(H) + τ(x) · (h − x): plastic flow from the trial strain h under the stress at
// the strain x where it yields (backward Euler; Simo and Hughes 1998), and the energy stored there and not in the
// mapped strain H. x is H except for two jumps: sand tears at the cohesion, and the compressed axes of a unilateral
// energy lose their energy at the apex, which a steep cone reaches at any strain. Never negative, and zero without
// stress.
template <class T, int D>
struct Dissipation {
  Vector<T, D> at, flow;  // x, h − x
};

template <class Energy, class T, int D>
MPM_HD Dissipation<T, D> dissipation(const HenckyStrain<T, D>& s, const SandState<T, D>& state,
                                     const SandParameters<T>& p) {
  Dissipation<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T jump = Energy::unilateral_yield ? select(state.m.apex, s.h[i], state.h[i])
                                            : select(state.tears, p.cohesion, state.h[i]);
    r.at[i] = select(p.torn, state.h[i], jump);
    r.flow[i] = s.h[i] - r.at[i];
  }
  return r;
}

template <class Energy, class T, int D>
MPM_HD T dissipated_energy(const Dissipation<T, D>& d, const Vector<T, D>& mapped, const T& mu, const T& lam) {
  return sand_energy<Energy>(d.at, mu, lam) - sand_energy<Energy>(mapped, mu, lam) +
         dot(sand_stress<Energy>(d.at, mu, lam), d.flow);
}

// Value per particle where the mask is true, otherwise 0.
template <class V, class At, class T>
MPM_HD V load_where(const At& at, const Field<const T>& f, const MaskOf<V>& mask) {
  return select(mask, convert<V>(at.load(f.pointer, f.stride[0])), V(0));
}

// Adjoints in principal axes: of the mapped and the trial strains, and of the parameters.
template <class T, int D>
struct SandAdjoint {
  Vector<T, D> mapped, trial;
  T mu, lam, alpha, cohesion, volume;
};

// Adjoints of F and stress, by the diagonals M and N of their adjoints in principal axes. Exponentials have no small
// differences.
template <class Energy, class Narrow, class T, int D>
MPM_HD SandAdjoint<T, D> adjoint_of_tensors(const SandState<T, D>& state, const SandParameters<T>& p,
                                            const Vector<T, D>& M, const Vector<T, D>& N) {
  const StressTerms<T, D> terms = stress_terms<Energy>(state.h), tangent = stress_tangent<Energy>(state.h, p.mu, p.lam);
  const T trace_N = sum(N);
  SandAdjoint<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r.mapped[i] = M[i] * convert<T>(exponential(convert<Narrow>(state.h[i]))) + tangent.shear[i] * N[i] +
                  tangent.dilation * trace_N;
  r.mu = dot(terms.shear, N);
  r.lam = terms.dilation * trace_N;
  r.trial = zero_vector<T, D>();
  r.alpha = r.cohesion = r.volume = T(0);
  return r;
}

// Of the dissipated energy.
template <class Energy, class T, int D>
MPM_HD void add_adjoint_of_dissipation(SandAdjoint<T, D>& r, const T& g, const HenckyStrain<T, D>& s,
                                       const SandState<T, D>& state, const SandParameters<T>& p) {
  const Dissipation<T, D> d = dissipation<Energy>(s, state, p);
  const StressTerms<T, D> terms = stress_terms<Energy>(d.at), tangent = stress_tangent<Energy>(d.at, p.mu, p.lam);
  const T trace = sum(d.flow);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T by_yield_strain = g * (tangent.shear[i] * d.flow[i] + tangent.dilation * trace);
    r.trial[i] = r.trial[i] + g * (p.mu * terms.shear[i] + p.lam * terms.dilation);
    r.mapped[i] = r.mapped[i] - g * state.stress[i] + select(state.tears, T(0), by_yield_strain);
    r.cohesion = r.cohesion + select(state.tears, by_yield_strain, T(0));
  }
  r.mu = r.mu + g * dissipated_energy<Energy>(d, state.h, T(1), T(0));
  r.lam = r.lam + g * dissipated_energy<Energy>(d, state.h, T(0), T(1));
}

// Adjoints of the requested scalar results. The multiplier is added to the hardening.
template <class Energy, class At, class T, class V, int D>
MPM_HD void add_adjoint_of_scalars(SandAdjoint<V, D>& r, const LawBackwardArguments<T, D>& a, const At& at,
                                   const HenckyStrain<V, D>& s, const SandState<V, D>& state,
                                   const SandParameters<V>& p) {
  const bool hardens = a.law.options & kHardens && a.grad_history.pointer;
  if (a.grad_multiplier.pointer || hardens) {
    V g = hardens ? load_where<V>(at, a.grad_history, state.moved) : V(0);
    if (a.grad_multiplier.pointer) g = g + load_where<V>(at, a.grad_multiplier, state.moved);
    const Vector<V, D> along = g * plastic_increment(s.h, state.h).direction;
    r.trial = r.trial + along;
    r.mapped = r.mapped + V(-1) * along;
  }
  if (a.grad_dissipated.pointer)
    add_adjoint_of_dissipation<Energy>(r, load_where<V>(at, a.grad_dissipated, state.moved), s, state, p);
  if (a.grad_history.pointer && volume_correction(a.law).pointer) {
    r.volume = load_where<V>(at, entry_of(a.grad_history, volume_place(a.law)), state.valid & state.tears);
    r.trial = shifted(r.trial, r.volume);
  }
}

// Through the return map.
template <class Energy, class T, int D>
MPM_HD void pull_back(SandAdjoint<T, D>& r, const SandState<T, D>& state, const SandParameters<T>& p, bool keep) {
  const MapAdjoint<T, D> map = return_map_adjoint<Energy>(state.m, r.mapped, p.cone, keep);
  const T ratio = select(p.shear, quotient(map.ratio, select(p.shear, p.mu, T(1))), T(0)), through = sum(map.h);
  r.trial = r.trial + map.h;
  r.mu = r.mu - ratio * p.cone.ratio;
  r.lam = r.lam + ratio;
  r.alpha = map.alpha;
  r.volume = r.volume + T(1.0 / D) * through;
  r.cohesion = r.cohesion + select(state.tears, T(0), sum(r.mapped)) - through;
  r.cohesion = select(p.torn, T(0), r.cohesion);
}

// Through the slope after hardening: from its adjoint, the first entry, to those of its parameters.
template <int D, class T>
MPM_HD void add_adjoint_of_slope(const T (&p)[kSlopeParameters], T (&adjoint)[kSlopeParameters]) {
  const T given = adjoint[kSlope];
  for (int k = 0; k < kSlopeParameters; k++) {
    Dual<T> along[kSlopeParameters];
    for (int i = 0; i < kSlopeParameters; i++) along[i] = {p[i], T(i == k)};
    adjoint[k] = given * hardened_slope<D>(along).derivative;
  }
}

template <class V, class At, class T, int D>
MPM_HD void store_adjoint_of_history(const LawBackwardArguments<T, D>& a, const At& at, const MaskOf<V>& valid,
                                     const V& by_hardening, const V& by_volume) {
  if (a.law.options & kHardens) {
    const V same = load_scalar_or_zero(at, a.grad_history);
    store_entry(at, a.history, 0, same + select(valid, by_hardening, V(0)));
  }
  if (!volume_correction(a.law).pointer) return;
  const int place = volume_place(a.law);
  const V same = load_scalar_or_zero(at, entry_of(a.grad_history, place));
  store_entry(at, a.history, place, select(valid, by_volume, same));
}

template <class T, int D>
MPM_HD Vector<T, D> diagonal(const Matrix<T, D>& a) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = a[i][i];
  return r;
}

// Bodies of the kernels that differ from those of other laws in principal strains.
template <class Law>
struct SandKernels : PrincipalKernels<Law> {
  using Energy = typename Law::Energy;

  template <class At, class T, int D>
  MPM_HD static void update(const LawUpdateArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const Matrix<V, D> F = load_matrix<D>(at, a.law.state);
    const HenckyStrain<V, D> s = hencky_strain(F);
    const SandParameters<V> p = load_parameters<Energy, V>(at, a.law);
    const SandState<V, D> state = sand_state<Energy, V>(s, p, a.law);

    // Scalars are stored first, so that strains need no registers during the products of matrices.
    if (a.branch) {
      const V branch = select(state.m.cone, V(kCone), select(state.m.apex, V(kApex), V(kElastic))) +
                       select(state.m.converged, V(0), V(kNotConverged));
      at.store_integer(a.branch, select(state.valid, branch, V(kInvalid)));
    }
    const bool hardens = a.law.options & kHardens && a.history.pointer;
    if (a.multiplier.pointer || hardens) {
      const V multiplier = select(state.moved, plastic_increment(s.h, state.h).norm, V(0));
      if (a.multiplier.pointer) at.store(a.multiplier.pointer, a.multiplier.stride[0], multiplier);
      if (hardens) store_entry(at, a.history, 0, convert<V>(load_scalar_or_zero(at, a.law.history[0])) + multiplier);
    }
    if (a.dissipated.pointer) {
      const V lost = dissipated_energy<Energy>(dissipation<Energy>(s, state, p), state.h, p.mu, p.lam);
      at.store(a.dissipated.pointer, a.dissipated.stride[0], select(state.moved, lost, V(0)));
    }
    // Loss of the trace: on the cone and where the volume is preserved, none.
    if (a.history.pointer && volume_correction(a.law).pointer)
      store_entry(at, a.history, volume_place(a.law),
                  select(state.valid, select(state.tears, p.volume + sum(s.h), V(0)), p.volume));

    Vector<V, D> factor;
    MPM_UNROLL for (int i = 0; i < D; i++)
      factor[i] = exponential(state.h[i] - s.h[i]) / s.scale;
    store_matrix<D>(at, a.state, select(state.moved, compose(s.U, factor, s.B), F));
    store_matrix<D>(at, a.stress, select(state.valid, compose(s.U, state.stress, s.U), zero_matrix<V, D>()));
  }

  // The strains, their map and its adjoint in W, the axes in V: for float32 arguments in float64 and float32, because a
  // relative error of the mean strain grows with the ratio of the strains to their mean, but that of the axes does not.
  template <class At, class T, int D>
  MPM_HD static void update_backward(const LawBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    using W = Wide<V>;
    const Matrix<V, D> F = load_matrix<D>(at, a.law.state);
    const Matrix<V, D> grad_F = load_matrix_or_zero<D>(at, a.grad_state),
                       grad_stress = load_matrix_or_zero<D>(at, a.grad_stress);
    const HenckyStrain<W, D> wide = wide_hencky_strain(F);
    const Matrix<W, D> wide_right = right_axes(wide), M = transpose(wide.U) * (convert<W>(grad_F) * wide_right),
                       N = transpose(wide.U) * (symmetric_part(convert<W>(grad_stress)) * wide.U);
    // Before the map, so that these registers are free in it.
    const HenckyStrain<V, D> s = convert<V>(wide);
    const Matrix<V, D> right = convert<V>(wide_right), even = convert<V>(symmetric_part(M)),
                       odd = convert<V>(skew_part(M)), narrow_N = convert<V>(N);

    const SandParameters<W> p = load_parameters<Energy, W>(at, a.law);
    const SandState<W, D> state = sand_state<Energy, V>(wide, p, a.law);
    SandAdjoint<W, D> g = adjoint_of_tensors<Energy, V>(state, p, diagonal(M), diagonal(N));
    add_adjoint_of_scalars<Energy>(g, a, at, wide, state, p);
    pull_back<Energy>(g, state, p, a.law.options & kKeepApex);

    const auto valid = convert<MaskOf<V>>(state.valid);
    if (a.state.pointer) {
      const Vector<V, D> h = convert<V>(state.h);
      const Matrix<V, D> principal =
          principal_adjoint(s, h, convert<V>(g.trial), even, odd, narrow_N, [&](int i, int j) -> Quotients<V> {
            return {strain_quotient<Energy, V>(state.m, i, j, wide.h[i] - wide.h[j]),
                    stress_quotient<Energy>(h[i], h[j], convert<V>(p.mu))};
          });
      const Matrix<V, D> grad = s.U * principal * transpose(right);
      store_matrix<D>(at, a.state, select(valid, grad, grad_F));
    }
    W slope[kSlopeParameters] = {g.alpha, W(0), W(0), W(0), W(0)};
    if (a.law.options & kHardens) add_adjoint_of_slope<D>(p.slope, slope);
    if (a.parameters.pointer) {
      const W values[] = {g.mu, g.lam, slope[kSlope], g.cohesion, W(0), slope[kH1], slope[kH2], slope[kH3]};
      MPM_UNROLL for (int k = 0; k < kParameters<Law>; k++)
        store_entry(at, a.parameters, k, select(valid, convert<V>(values[k]), V(0)));
    }
    if (a.history.pointer) store_adjoint_of_history(a, at, valid, convert<V>(slope[kHardening]), convert<V>(g.volume));
  }

  template <class At, class T, int D>
  MPM_HD static void scalar(const LawScalarArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    const V mu = load_parameter(at, a.law, 0), lam = load_parameter(at, a.law, 1);
    const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.law.state));
    const bool energy = a.which == LawScalar::energy;
    const V value =
        energy ? sand_energy<Energy>(s.h, mu, lam) : sand_stiffness<Energy>(s.h, mu, lam, load_parameter(at, a.law, 4));
    at.store(a.value.pointer, a.value.stride[0],
             select(s.valid & (value - value == V(0)), value, V(energy ? INFINITY : 0.0)));
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
