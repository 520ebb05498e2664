#pragma once

#include <string_view>
#include <type_traits>

#include "materials/arguments.h"
#include "materials/lanes.h"
#include "materials/quartic_return_map.h"

// Arguments and bodies of the sand kernels: one decomposition, the return map of the principal strains, its adjoint.
//
// A deformation that is not finite or not of positive determinant has no meaning: it is returned as it is, its stress
// and moduli are zero, its energy is infinite, and no derivative passes but that of F with respect to itself.
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
  T cohesion, volume;
  Cone<T> cone;
  MaskOf<T> shear;  // μ > 0
};

template <class V, class At, class T, int D>
MPM_HD SandParameters<V> load_parameters(const At& at, const SandArguments<T, D>& a) {
  // 0 where it is absent.
  const auto load = [&](const Parameter<T>& parameter) {
    return parameter.pointer ? convert<V>(load_parameter(at, parameter, a.scene, a.scene_stride)) : V(0);
  };
  SandParameters<V> r;
  r.mu = load(a.mu);
  r.lam = load(a.lam);
  r.alpha = load(a.alpha);
  r.cohesion = load(a.cohesion);
  r.volume = a.volume.pointer ? convert<V>(at.load(a.volume.pointer, a.volume.stride[0])) : V(0);
  r.shear = r.mu > V(0);
  r.cone = {r.alpha, select(r.shear, r.lam / select(r.shear, r.mu, V(1)), V(0))};
  return r;
}

template <class T, int D>
MPM_HD Vector<T, D> shifted(const Vector<T, D>& h, const T& shift) {
  Vector<T, D> r;
  MPM_UNROLL
  for (int i = 0; i < D; i++) r[i] = h[i] + shift;
  return r;
}

// The trial strain as the cone with its apex at the origin sees it: with the volume v_c that was lost before (Tampubolon
// et al. 2017), and relative to the strain of the apex, which is the cohesion on every axis.
template <class T, int D>
MPM_HD Vector<T, D> relative_to_apex(const HenckyStrain<T, D>& s, const SandParameters<T>& p) {
  return shifted(s.h, T(1.0 / D) * p.volume - p.cohesion);
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
  Vector<T, D> trial;     // strain relative to the apex
  MappedStrain<T, D> m;   // likewise
  Vector<T, D> h, stress; // principal strains and stresses
  MaskOf<T> meaningful, moved, yielded;
};

template <class Energy, class Rough, class T, int D>
MPM_HD_LARGE SandState<T, D> sand_state(const HenckyStrain<T, D>& s, const SandParameters<T>& p, bool plastic, bool keep) {
  SandState<T, D> r;
  r.trial = relative_to_apex(s, p);
  r.m = plastic ? return_map<Energy, Rough>(r.trial, p.cone, p.shear, keep) : unmapped(r.trial);
  r.h = shifted(r.m.h, p.cohesion);
  r.stress = sand_stress<Energy>(r.h, p.mu, p.lam);
  T finite = T(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++) finite = finite + (r.stress[i] - r.stress[i]);
  r.meaningful = s.meaningful & (finite == T(0));
  r.yielded = r.meaningful & (r.m.cone | r.m.apex);
  r.moved = r.yielded | (r.meaningful & ((p.volume > T(0)) | (p.volume < T(0))));
  return r;
}

// Length and direction of the plastic part of the trial strain.
template <class T, int D>
struct PlasticIncrement {
  T norm;
  Vector<T, D> direction;
};

template <class T, int D>
MPM_HD PlasticIncrement<T, D> plastic_increment(const SandState<T, D>& state) {
  Vector<T, D> lost;
  MPM_UNROLL
  for (int i = 0; i < D; i++) lost[i] = state.trial[i] - state.m.h[i];
  const T norm = sqrt(dot(lost, lost));
  return {norm, (T(1) / select(norm > T(0), norm, T(1))) * lost};
}

template <class Energy, class T, int D>
MPM_HD MaskOf<T> loses_volume(const SandState<T, D>& state, bool keep) {
  return Energy::unilateral_yield && keep ? T(0) < T(0) : state.yielded & state.m.apex;
}

template <class Energy, class At, class T, int D>
MPM_HD void return_map_at(const ReturnMapArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  const Matrix<V, D> F = load_matrix<D>(at, a.sand.F);
  const HenckyStrain<V, D> s = hencky_strain(F);
  const SandParameters<V> p = load_parameters<V>(at, a.sand);
  const SandState<V, D> state = sand_state<Energy, V>(s, p, a.sand.plastic, a.sand.keep_apex);

  Matrix<V, D> tau = compose(s.U, state.stress, s.U);
  Vector<V, D> factor;
  MPM_UNROLL
  for (int i = 0; i < D; i++) factor[i] = exponential(state.h[i] - s.h[i]) / s.scale;
  Matrix<V, D> mapped = compose(s.U, factor, s.B);
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = 0; j < D; j++) {
    tau[i][j] = select(state.meaningful, tau[i][j], V(0));
    mapped[i][j] = select(state.moved, mapped[i][j], F[i][j]);
  }
  store_matrix<D>(at, a.F, mapped);
  store_matrix<D>(at, a.stress, tau);

  const V branch =
      select(state.m.cone, V(kCone), select(state.m.apex, V(kApex), V(kElastic))) + select(state.m.converged, V(0), V(4));
  at.store_integer(a.branch, select(state.meaningful, branch, V(kInvalid)));
  if (a.multiplier.pointer)
    at.store(a.multiplier.pointer, a.multiplier.stride[0], select(state.yielded, plastic_increment(state).norm, V(0)));
  if (a.dissipated.pointer) {
    const V lost = sand_energy<Energy>(shifted(state.trial, p.cohesion), p.mu, p.lam) -
                   sand_energy<Energy>(state.h, p.mu, p.lam);
    at.store(a.dissipated.pointer, a.dissipated.stride[0], select(state.yielded, lost, V(0)));
  }
  // What the trace loses: on the cone and where the volume is kept, nothing.
  if (a.volume.pointer) {
    const V left = p.volume + (sum(s.h) - V(D) * p.cohesion);
    const auto lost = loses_volume<Energy>(state, a.sand.keep_apex);
    at.store(a.volume.pointer, a.volume.stride[0],
             select(state.meaningful, select(lost, left, V(0)), p.volume));
  }
}

// A value per particle where the mask is true, else 0.
template <class V, class At, class T>
MPM_HD V load_scalar(const At& at, const Field<const T>& f, const MaskOf<V>& mask) {
  return select(mask, convert<V>(at.load(f.pointer, f.stride[0])), V(0));
}

// Adjoints in principal axes: of the mapped and, directly, the trial strains, and of the parameters.
template <class T, int D>
struct SandAdjoint {
  Vector<T, D> mapped, trial;
  T mu, lam, alpha, cohesion, volume;
};

// Of F and stress, by the diagonals M and N of their adjoints in principal axes. Exponentials have no small differences.
template <class Energy, class Narrow, class T, int D>
MPM_HD SandAdjoint<T, D> adjoint_of_tensors(const SandState<T, D>& state, const SandParameters<T>& p,
                                            const Vector<T, D>& M, const Vector<T, D>& N) {
  const StressTerms<T, D> terms = stress_terms<Energy>(state.h), tangent = stress_tangent<Energy>(state.h, p.mu, p.lam);
  const T trace_N = sum(N);
  SandAdjoint<T, D> r;
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    r.mapped[i] = M[i] * convert<T>(exponential(convert<Narrow>(state.h[i]))) + tangent.shear[i] * N[i] +
                  tangent.dilation * trace_N;
  r.mu = dot(terms.shear, N);
  r.lam = terms.dilation * trace_N;
  r.trial = zero_vector<T, D>();
  r.alpha = r.cohesion = r.volume = T(0);
  return r;
}

// Of the scalar results that are asked for.
template <class Energy, class At, class T, class V, int D>
MPM_HD void add_adjoint_of_scalars(SandAdjoint<V, D>& r, const ReturnMapBackwardArguments<T, D>& a, const At& at,
                                   const SandState<V, D>& state, const SandParameters<V>& p) {
  if (a.grad_multiplier.pointer) {
    const V g = load_scalar<V>(at, a.grad_multiplier, state.yielded);
    const Vector<V, D> along = g * plastic_increment(state).direction;
    r.trial = r.trial + along;
    r.mapped = r.mapped + V(-1) * along;
    r.cohesion = r.cohesion + sum(along);  // the increment does not see the cohesion, which the mapped strain has in it
  }
  if (a.grad_dissipated.pointer) {
    const V g = load_scalar<V>(at, a.grad_dissipated, state.yielded);
    const Vector<V, D> before = shifted(state.trial, p.cohesion), stress = sand_stress<Energy>(before, p.mu, p.lam);
    r.trial = r.trial + g * stress;
    r.mapped = r.mapped + (V(0) - g) * state.stress;
    r.cohesion = r.cohesion + g * sum(stress);
    r.mu = r.mu + g * (sand_energy<Energy>(before, V(1), V(0)) - sand_energy<Energy>(state.h, V(1), V(0)));
    r.lam = r.lam + g * (sand_energy<Energy>(before, V(0), V(1)) - sand_energy<Energy>(state.h, V(0), V(1)));
  }
  if (a.grad_volume.pointer) {
    r.volume = load_scalar<V>(at, a.grad_volume, loses_volume<Energy>(state, a.sand.keep_apex));
    r.cohesion = r.cohesion - V(D) * r.volume;
  }
}

// Through the return map.
template <class Energy, class T, int D>
MPM_HD void pull_back(SandAdjoint<T, D>& r, const SandState<T, D>& state, const SandParameters<T>& p, bool keep) {
  const MapAdjoint<T, D> map = return_map_adjoint<Energy>(state.m, r.mapped, p.cone, keep);
  const T ratio = select(p.shear, quotient(map.ratio, select(p.shear, p.mu, T(1))), T(0));
  r.trial = r.trial + map.h;
  r.mu = r.mu - ratio * p.cone.ratio;
  r.lam = r.lam + ratio;
  r.alpha = map.alpha;
  r.cohesion = r.cohesion + sum(r.mapped) - sum(r.trial);
}

template <class T, int D>
MPM_HD Vector<T, D> diagonal(const Matrix<T, D>& a) {
  Vector<T, D> r;
  MPM_UNROLL
  for (int i = 0; i < D; i++) r[i] = a[i][i];
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

  const SandParameters<W> p = load_parameters<W>(at, a.sand);
  const SandState<W, D> state = sand_state<Energy, V>(wide, p, a.sand.plastic, a.sand.keep_apex);
  SandAdjoint<W, D> g = adjoint_of_tensors<Energy, V>(state, p, diagonal(M), diagonal(N));
  add_adjoint_of_scalars<Energy>(g, a, at, state, p);
  pull_back<Energy>(g, state, p, a.sand.keep_apex);

  const auto meaningful = convert<MaskOf<V>>(state.meaningful);
  if (a.F.pointer) {
    const Vector<V, D> h = convert<V>(state.h);
    const Matrix<V, D> principal = principal_adjoint(
        s, h, convert<V>(shifted(g.trial, g.volume)), even, odd, narrow_N, [&](int i, int j) -> Quotients<V> {
          return {strain_quotient<Energy, V>(state.m, i, j, wide.h[i] - wide.h[j]),
                  stress_quotient<Energy>(h[i], h[j], convert<V>(p.mu))};
        });
    const Matrix<V, D> grad = s.U * principal * transpose(right);
    Matrix<V, D> kept;
    MPM_UNROLL
    for (int i = 0; i < D; i++)
      MPM_UNROLL
    for (int j = 0; j < D; j++) kept[i][j] = select(meaningful, grad[i][j], grad_F[i][j]);
    store_matrix<D>(at, a.F, kept);
  }
  if (a.parameters.pointer) {
    const W values[4] = {g.mu, g.lam, g.alpha, g.cohesion};
    MPM_UNROLL
    for (int k = 0; k < 4; k++)
      at.store(a.parameters.pointer + k * a.parameters.stride[1], a.parameters.stride[0],
               select(meaningful, convert<V>(values[k]), V(0)));
  }
  if (a.volume.pointer) {
    const V kept = a.grad_volume.pointer ? at.load(a.grad_volume.pointer, a.grad_volume.stride[0]) : V(0);
    at.store(a.volume.pointer, a.volume.stride[0],
             select(meaningful, convert<V>(g.volume + W(1.0 / D) * sum(g.trial)), kept));
  }
}

template <class Energy, class At, class T, int D>
MPM_HD void sand_scalar_at(const SandScalarArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  const SandParameters<V> p = load_parameters<V>(at, a.sand);
  const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.sand.F));
  const V value = a.stiffness ? sand_stiffness<Energy>(s.h, p.mu, p.lam, V(a.floor))
                              : sand_energy<Energy>(s.h, p.mu, p.lam);
  at.store(a.value.pointer, a.value.stride[0],
           select(s.meaningful & (value - value == V(0)), value, V(a.stiffness ? 0.0 : INFINITY)));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
