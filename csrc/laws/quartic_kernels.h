#pragma once

#include <string_view>
#include <type_traits>

#include "common/lanes.h"
#include "laws/arguments.h"
#include "laws/quartic_return_map.h"

// Arguments and bodies of the sand kernels: one decomposition, the return map of the principal strains, its adjoint.
//
// A deformation that is not finite or not of positive determinant has no meaning: it is returned as it is, its stress
// and moduli are zero, its energy is infinite, and no derivative passes but that of F with respect to itself.
//
// With a volume correction (Tampubolon et al. 2017) what reaches the apex is torn: it loses all strain, cohesion
// included, and remembers the logarithm v_c of the volume. Until compression has closed that gap it has no stress and
// no cohesion: it sees its trial strain h as h + v_c/D, and is at the apex while tr h + v_c ≥ 0.
namespace mpm {

template <class T, int D>
struct SandArguments {
  int energy = 0;  // index in ReturnMaps, or in SandEnergies without plasticity
  int64_t particles = 0;
  Field<const T> F;            // trial deformation gradient [P, D, D]
  const int* scene = nullptr;  // int32 [P], where a parameter is per scene
  int64_t scene_stride = 0;
  Parameter<T> mu, lam, alpha, cohesion;  // the last may be absent, and so may
  Field<const T> volume;                  // volume correction [P]
  bool plastic = true;                    // otherwise F is kept
  bool keep_apex = false;                 // see return_map
};

template <class T, int D>
struct ReturnMapArguments {
  SandArguments<T, D> sand;
  Field<T> F, stress;                       // [P, D, D]
  int* branch = nullptr;                    // [P] SandBranch, plus 4 where the root was not found
  Field<T> multiplier, dissipated, volume;  // [P], absent where not wanted
};

template <class T, int D>
struct ReturnMapBackwardArguments {
  SandArguments<T, D> sand;
  Field<const T> grad_F, grad_stress, grad_multiplier, grad_dissipated, grad_volume;  // any may be absent
  Field<T> F, parameters, volume;  // adjoints per particle [P, D, D], [P, 4]: μ, λ, α, cohesion, [P]; or absent
};

template <class T, int D>
struct SandScalarArguments {
  SandArguments<T, D> sand;
  bool stiffness = false;  // otherwise energy
  T floor = 0;             // see sand_stiffness
  Field<T> value;          // [P]
};

inline namespace TORCH_MPM_ISA {

using SandEnergies = LawList<FullQuartic, UnilateralQuartic, Hencky, MixedQuartic>;
template <int D>
using ReturnMaps =
    std::conditional_t<D == 2, SandEnergies,
                       LawList<FullQuartic, UnilateralQuartic, Hencky, MixedQuartic, ExactFlow<FullQuartic>,
                               ExactFlow<UnilateralQuartic>, ExactFlow<MixedQuartic>>>;

// The index of an energy in such a list, −1 if it has none of this name; radial where there is no exact flow of it.
template <class Energies>
int find_energy(std::string_view name, bool exact_flow) {
  int index = -1;
  for (int i = 0; i < Energies::size; i++)
    Energies::visit(i, [&]<class Energy>() {
      if (name == Energy::name && (index < 0 || (Energy::exact_flow && exact_flow))) index = i;
    });
  return index;
}

template <class T>
struct SandParameters {
  T mu, lam, alpha;
  T cohesion, volume;  // the cohesion of what is torn is 0
  Cone<T> cone;
  MaskOf<T> shear, torn;  // μ > 0; v_c > 0 where the apex loses volume
};

// Whether the apex keeps the volume: nothing tears.
template <class Energy, class T, int D>
MPM_HD bool keeps_volume(const SandArguments<T, D>& a) {
  return Energy::unilateral_yield && a.keep_apex;
}

template <class Energy, class V, class At, class T, int D>
MPM_HD SandParameters<V> load_parameters(const At& at, const SandArguments<T, D>& a) {
  // 0 where it is absent.
  const auto load = [&](const Parameter<T>& parameter) {
    return parameter.pointer ? convert<V>(load_parameter(at, parameter, a.scene, a.scene_stride)) : V(0);
  };
  SandParameters<V> r;
  r.mu = load(a.mu);
  r.lam = load(a.lam);
  r.alpha = load(a.alpha);
  r.volume = a.volume.pointer ? convert<V>(at.load(a.volume.pointer, a.volume.stride[0])) : V(0);
  r.torn = (keeps_volume<Energy>(a) ? V(0) : r.volume) > V(0);
  r.cohesion = select(r.torn, V(0), load(a.cohesion));
  r.shear = r.mu > V(0);
  r.cone = {r.alpha, select(r.shear, r.lam / select(r.shear, r.mu, V(1)), V(0))};
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

// What a particle becomes, in principal axes.
template <class T, int D>
struct SandState {
  MappedStrain<T, D> m;    // relative to the apex of the cone
  Vector<T, D> h, stress;  // principal strains and stresses
  MaskOf<T> meaningful, moved, tears;
};

// The cone has its apex at the strain of the cohesion on every axis.
template <class Energy, class Rough, class V, class T, int D>
MPM_HD_LARGE SandState<V, D> sand_state(const HenckyStrain<V, D>& s, const SandParameters<V>& p,
                                        const SandArguments<T, D>& a) {
  const auto never = V(0) < V(0);
  const bool keeps = keeps_volume<Energy>(a);
  const Vector<V, D> trial = shifted(s.h, V(1.0 / D) * p.volume - p.cohesion);
  SandState<V, D> r;
  r.m = a.plastic ? return_map<Energy, Rough>(trial, p.cone, p.shear, p.torn, keeps) : unmapped(trial);
  r.tears = a.volume.pointer && !keeps ? r.m.apex : never;
  r.h = shifted(r.m.h, select(r.tears, V(0), p.cohesion));
  r.stress = sand_stress<Energy>(r.h, p.mu, p.lam);
  V finite = V(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    finite = finite + (r.stress[i] - r.stress[i]);
  r.meaningful = s.meaningful & (finite == V(0));
  r.moved = r.meaningful & (r.m.cone | r.m.apex | (p.volume > V(0)) | (p.volume < V(0)));
  return r;
}

// Length and direction of the plastic increment of the strain.
template <class T, int D>
struct PlasticIncrement {
  T norm;
  Vector<T, D> direction;
};

template <class T, int D>
MPM_HD PlasticIncrement<T, D> plastic_increment(const HenckyStrain<T, D>& s, const SandState<T, D>& state) {
  const Vector<T, D> lost = s.h + T(-1) * state.h;
  const T norm = sqrt(dot(lost, lost));
  return {norm, (T(1) / select(norm > T(0), norm, T(1))) * lost};
}

// The energy that turns into heat, ψ(x) − ψ(H) + τ(x) · (h − x): plastic flow from the trial strain h under the stress
// at the strain x where it yields (backward Euler; Simo and Hughes 1998), and what is stored there and not in the
// mapped strain H. x is H but for two jumps: what tears does so at the cohesion, and the compressed axes of a
// unilateral energy lose theirs at the apex, which a steep cone reaches at any strain. Never negative, and zero where
// no stress is.
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

template <class Energy, class At, class T, int D>
MPM_HD void return_map_at(const ReturnMapArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  const Matrix<V, D> F = load_matrix<D>(at, a.sand.F);
  const HenckyStrain<V, D> s = hencky_strain(F);
  const SandParameters<V> p = load_parameters<Energy, V>(at, a.sand);
  const SandState<V, D> state = sand_state<Energy, V>(s, p, a.sand);

  Matrix<V, D> tau = compose(s.U, state.stress, s.U);
  Vector<V, D> factor;
  MPM_UNROLL for (int i = 0; i < D; i++)
    factor[i] = exponential(state.h[i] - s.h[i]) / s.scale;
  Matrix<V, D> mapped = compose(s.U, factor, s.B);
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) {
      tau[i][j] = select(state.meaningful, tau[i][j], V(0));
      mapped[i][j] = select(state.moved, mapped[i][j], F[i][j]);
    }
  store_matrix<D>(at, a.F, mapped);
  store_matrix<D>(at, a.stress, tau);

  const V branch = select(state.m.cone, V(kCone), select(state.m.apex, V(kApex), V(kElastic))) +
                   select(state.m.converged, V(0), V(4));
  at.store_integer(a.branch, select(state.meaningful, branch, V(kInvalid)));
  if (a.multiplier.pointer)
    at.store(a.multiplier.pointer, a.multiplier.stride[0], select(state.moved, plastic_increment(s, state).norm, V(0)));
  if (a.dissipated.pointer) {
    const V lost = dissipated_energy<Energy>(dissipation<Energy>(s, state, p), state.h, p.mu, p.lam);
    at.store(a.dissipated.pointer, a.dissipated.stride[0], select(state.moved, lost, V(0)));
  }
  // What the trace loses: on the cone and where the volume is kept, nothing.
  if (a.volume.pointer)
    at.store(a.volume.pointer, a.volume.stride[0],
             select(state.meaningful, select(state.tears, p.volume + sum(s.h), V(0)), p.volume));
}

// A value per particle where the mask is true, else 0.
template <class V, class At, class T>
MPM_HD V load_scalar(const At& at, const Field<const T>& f, const MaskOf<V>& mask) {
  return select(mask, convert<V>(at.load(f.pointer, f.stride[0])), V(0));
}

// Adjoints in principal axes: of the mapped and the trial strains, and of the parameters.
template <class T, int D>
struct SandAdjoint {
  Vector<T, D> mapped, trial;
  T mu, lam, alpha, cohesion, volume;
};

// Of F and stress, by the diagonals M and N of their adjoints in principal axes. Exponentials have no small
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

// Of the scalar results that are asked for.
template <class Energy, class At, class T, class V, int D>
MPM_HD void add_adjoint_of_scalars(SandAdjoint<V, D>& r, const ReturnMapBackwardArguments<T, D>& a, const At& at,
                                   const HenckyStrain<V, D>& s, const SandState<V, D>& state,
                                   const SandParameters<V>& p) {
  if (a.grad_multiplier.pointer) {
    const V g = load_scalar<V>(at, a.grad_multiplier, state.moved);
    const Vector<V, D> along = g * plastic_increment(s, state).direction;
    r.trial = r.trial + along;
    r.mapped = r.mapped + V(-1) * along;
  }
  if (a.grad_dissipated.pointer)
    add_adjoint_of_dissipation<Energy>(r, load_scalar<V>(at, a.grad_dissipated, state.moved), s, state, p);
  if (a.grad_volume.pointer) {
    r.volume = load_scalar<V>(at, a.grad_volume, state.meaningful & state.tears);
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

template <class T, int D>
MPM_HD Vector<T, D> diagonal(const Matrix<T, D>& a) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = a[i][i];
  return r;
}

// The strains, their map and its adjoint in W, the axes in V: of float32 arguments in float64 and float32, because a
// relative error of the mean strain grows with the strains over their mean, but that of the axes does not.
template <class Energy, class At, class T, int D>
MPM_HD void return_map_backward_at(const ReturnMapBackwardArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  using W = Wide<V>;
  const Matrix<V, D> F = load_matrix<D>(at, a.sand.F);
  const Matrix<V, D> grad_F = a.grad_F.pointer ? load_matrix<D>(at, a.grad_F) : zero_matrix<V, D>();
  const Matrix<V, D> grad_stress = a.grad_stress.pointer ? load_matrix<D>(at, a.grad_stress) : zero_matrix<V, D>();
  const HenckyStrain<W, D> wide = wide_hencky_strain(F);
  const Matrix<W, D> wide_right = right_axes(wide), M = transpose(wide.U) * (convert<W>(grad_F) * wide_right),
                     N = transpose(wide.U) * (symmetric_part(convert<W>(grad_stress)) * wide.U);
  // Before the map, whose registers these take no longer.
  const HenckyStrain<V, D> s = convert<V>(wide);
  const Matrix<V, D> right = convert<V>(wide_right), even = convert<V>(symmetric_part(M)),
                     odd = convert<V>(skew_part(M)), narrow_N = convert<V>(N);

  const SandParameters<W> p = load_parameters<Energy, W>(at, a.sand);
  const SandState<W, D> state = sand_state<Energy, V>(wide, p, a.sand);
  SandAdjoint<W, D> g = adjoint_of_tensors<Energy, V>(state, p, diagonal(M), diagonal(N));
  add_adjoint_of_scalars<Energy>(g, a, at, wide, state, p);
  pull_back<Energy>(g, state, p, a.sand.keep_apex);

  const auto meaningful = convert<MaskOf<V>>(state.meaningful);
  if (a.F.pointer) {
    const Vector<V, D> h = convert<V>(state.h);
    const Matrix<V, D> principal =
        principal_adjoint(s, h, convert<V>(g.trial), even, odd, narrow_N, [&](int i, int j) -> Quotients<V> {
          return {strain_quotient<Energy, V>(state.m, i, j, wide.h[i] - wide.h[j]),
                  stress_quotient<Energy>(h[i], h[j], convert<V>(p.mu))};
        });
    const Matrix<V, D> grad = s.U * principal * transpose(right);
    Matrix<V, D> kept;
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) kept[i][j] = select(meaningful, grad[i][j], grad_F[i][j]);
    store_matrix<D>(at, a.F, kept);
  }
  if (a.parameters.pointer) {
    const W values[4] = {g.mu, g.lam, g.alpha, g.cohesion};
    MPM_UNROLL for (int k = 0; k < 4; k++)
      at.store(a.parameters.pointer + k * a.parameters.stride[1], a.parameters.stride[0],
               select(meaningful, convert<V>(values[k]), V(0)));
  }
  if (a.volume.pointer) {
    const V kept = a.grad_volume.pointer ? at.load(a.grad_volume.pointer, a.grad_volume.stride[0]) : V(0);
    at.store(a.volume.pointer, a.volume.stride[0], select(meaningful, convert<V>(g.volume), kept));
  }
}

template <class Energy, class At, class T, int D>
MPM_HD void sand_scalar_at(const SandScalarArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  const SandParameters<V> p = load_parameters<Energy, V>(at, a.sand);
  const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.sand.F));
  const V value =
      a.stiffness ? sand_stiffness<Energy>(s.h, p.mu, p.lam, V(a.floor)) : sand_energy<Energy>(s.h, p.mu, p.lam);
  at.store(a.value.pointer, a.value.stride[0],
           select(s.meaningful & (value - value == V(0)), value, V(a.stiffness ? 0.0 : INFINITY)));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
