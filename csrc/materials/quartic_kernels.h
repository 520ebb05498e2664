#pragma once

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
  int energy = 0;  // index in SandEnergies
  int64_t particles = 0;
  Field<const T> F;            // trial deformation gradient [P, D, D]
  const int* scene = nullptr;  // int32 [P], where a parameter is per scene
  int64_t scene_stride = 0;
  Parameter<T> mu, lam, alpha;
  bool plastic = true;     // otherwise F is kept
  bool keep_apex = false;  // see return_map
};

template <class T, int D>
struct ReturnMapArguments {
  SandArguments<T, D> sand;
  Field<T> F, stress;               // [P, D, D]
  int* branch = nullptr;            // [P] SandBranch, plus 4 where the root was not found
  Field<T> multiplier, dissipated;  // [P], absent where not wanted
};

template <class T, int D>
struct ReturnMapBackwardArguments {
  SandArguments<T, D> sand;
  Field<const T> grad_F, grad_stress;  // either may be absent
  Field<T> F, parameters;              // adjoints per particle [P, D, D] and [P, 3]: μ, λ, α; absent where not needed
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

template <class T>
struct SandParameters {
  T mu, lam, alpha;
  Cone<T> cone;
  MaskOf<T> shear;  // μ > 0
};

template <class At, class T, int D>
MPM_HD SandParameters<typename At::Value> load_parameters(const At& at, const SandArguments<T, D>& a) {
  using V = typename At::Value;
  SandParameters<V> r;
  r.mu = load_parameter(at, a.mu, a.scene, a.scene_stride);
  r.lam = load_parameter(at, a.lam, a.scene, a.scene_stride);
  r.alpha = load_parameter(at, a.alpha, a.scene, a.scene_stride);
  r.shear = r.mu > V(0);
  r.cone = {r.alpha, select(r.shear, r.lam / select(r.shear, r.mu, V(1)), V(0))};
  return r;
}

template <class T, int D>
MPM_HD MappedStrain<T, D> unmapped(const Vector<T, D>& h) {
  const auto none = T(0) < T(0);
  return {h, zero_vector<T, D>(), T(0), T(0), T(1), none, none, T(0) == T(0)};
}

template <class Energy, class T, int D>
MPM_HD MappedStrain<T, D> map_strain(const HenckyStrain<T, D>& s, const SandParameters<T>& p, bool plastic, bool keep) {
  return plastic ? return_map<Energy>(s.h, p.cone, p.shear, keep) : unmapped(s.h);
}

template <class Energy, class At, class T, int D>
MPM_HD void return_map_at(const ReturnMapArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  const Matrix<V, D> F = load_matrix<D>(at, a.sand.F);
  const SandParameters<V> p = load_parameters(at, a.sand);
  const HenckyStrain<V, D> s = hencky_strain(F);
  const MappedStrain<V, D> m = map_strain<Energy>(s, p, a.sand.plastic, a.sand.keep_apex);

  const Vector<V, D> principal = sand_stress<Energy>(m.h, p.mu, p.lam);
  Matrix<V, D> tau = compose(s.U, principal, s.U);
  V finite = V(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++) finite = finite + (principal[i] - principal[i]);
  const auto meaningful = s.meaningful & (finite == V(0));

  const auto moved = meaningful & (m.cone | m.apex);
  Vector<V, D> factor;
  MPM_UNROLL
  for (int i = 0; i < D; i++) factor[i] = exponential(m.h[i] - s.h[i]) / s.scale;
  Matrix<V, D> mapped = compose(s.U, factor, s.B);
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = 0; j < D; j++) {
    tau[i][j] = select(meaningful, tau[i][j], V(0));
    mapped[i][j] = select(moved, mapped[i][j], F[i][j]);
  }
  store_matrix<D>(at, a.F, mapped);
  store_matrix<D>(at, a.stress, tau);

  const V branch = select(m.cone, V(kCone), select(m.apex, V(kApex), V(kElastic))) + select(m.converged, V(0), V(4));
  at.store_integer(a.branch, select(meaningful, branch, V(kInvalid)));
  if (a.multiplier.pointer) {
    V square = V(0);
    MPM_UNROLL
    for (int i = 0; i < D; i++) square = square + (s.h[i] - m.h[i]) * (s.h[i] - m.h[i]);
    at.store(a.multiplier.pointer, a.multiplier.stride[0], select(moved, sqrt(square), V(0)));
  }
  if (a.dissipated.pointer) {
    const V lost = sand_energy<Energy>(s.h, p.mu, p.lam) - sand_energy<Energy>(m.h, p.mu, p.lam);
    at.store(a.dissipated.pointer, a.dissipated.stride[0], select(moved, lost, V(0)));
  }
}

// Adjoint of F in principal axes; see principal_adjoint.
template <class Energy, class T, int D>
MPM_HD Matrix<T, D> sand_adjoint(const HenckyStrain<T, D>& s, const MappedStrain<T, D>& m,
                                 const Vector<T, D>& diagonal, const Matrix<T, D>& M, const Matrix<T, D>& N,
                                 const T& mu) {
  return principal_adjoint(s, m.h, diagonal, M, N, [&](int i, int j) -> Quotients<T> {
    const T trial = s.h[i] - s.h[j], mapped = m.h[i] - m.h[j];
    // κ on the cone; at the apex 1 between strains that are kept, 0 between those that are not.
    const auto equal = trial == T(0);
    const auto both = (m.h[i] > T(0)) & (m.h[j] > T(0));
    const T at_apex = select(both, T(1), select(equal, T(0), mapped / select(equal, T(1), trial)));
    return {select(m.apex, at_apex, m.kappa), stress_quotient<Energy>(m.h[i], m.h[j], mu)};
  });
}

template <class Energy, class At, class T, int D>
MPM_HD void return_map_backward_at(const ReturnMapBackwardArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  const Matrix<V, D> F = load_matrix<D>(at, a.sand.F);
  const SandParameters<V> p = load_parameters(at, a.sand);
  const HenckyStrain<V, D> s = hencky_strain(F);
  const MappedStrain<V, D> m = map_strain<Energy>(s, p, a.sand.plastic, a.sand.keep_apex);
  const Vector<V, D> principal = sand_stress<Energy>(m.h, p.mu, p.lam);
  V finite = V(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++) finite = finite + (principal[i] - principal[i]);
  const auto meaningful = s.meaningful & (finite == V(0));

  const Matrix<V, D> V_ = right_axes(s);
  const Matrix<V, D> grad_F = a.grad_F.pointer ? load_matrix<D>(at, a.grad_F) : zero_matrix<V, D>();
  const Matrix<V, D> grad_stress = a.grad_stress.pointer ? load_matrix<D>(at, a.grad_stress) : zero_matrix<V, D>();
  const Matrix<V, D> M = transpose(s.U) * grad_F * V_, N = transpose(s.U) * grad_stress * s.U;

  const StressTerms<V, D> terms = stress_terms<Energy>(m.h), tangent = stress_tangent<Energy>(m.h, p.mu, p.lam);
  Vector<V, D> grad_h;
  V grad_mu = V(0);
  const V trace_N = trace(N);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    grad_h[i] = M[i][i] * exponential(m.h[i]) + tangent.shear[i] * N[i][i] + tangent.dilation * trace_N;
    grad_mu = grad_mu + terms.shear[i] * N[i][i];
  }
  const MapAdjoint<V, D> adjoint = return_map_adjoint<Energy>(m, grad_h, p.cone, a.sand.keep_apex);

  if (a.F.pointer) {
    const Matrix<V, D> g = s.U * sand_adjoint<Energy>(s, m, adjoint.h, M, N, p.mu) * transpose(V_);
    Matrix<V, D> kept;
    MPM_UNROLL
    for (int i = 0; i < D; i++)
      MPM_UNROLL
    for (int j = 0; j < D; j++) kept[i][j] = select(meaningful, g[i][j], grad_F[i][j]);
    store_matrix<D>(at, a.F, kept);
  }
  if (a.parameters.pointer) {
    const V ratio = select(p.shear, adjoint.ratio / select(p.shear, p.mu, V(1)), V(0));
    const V values[3] = {grad_mu - ratio * p.cone.ratio, terms.dilation * trace_N + ratio, adjoint.alpha};
    MPM_UNROLL
    for (int k = 0; k < 3; k++)
      at.store(a.parameters.pointer + k * a.parameters.stride[1], a.parameters.stride[0],
               select(meaningful, values[k], V(0)));
  }
}

template <class Energy, class At, class T, int D>
MPM_HD void sand_scalar_at(const SandScalarArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  const SandParameters<V> p = load_parameters(at, a.sand);
  const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.sand.F));
  const V value = a.stiffness ? sand_stiffness<Energy>(s.h, p.mu, p.lam, V(a.floor))
                              : sand_energy<Energy>(s.h, p.mu, p.lam);
  at.store(a.value.pointer, a.value.stride[0],
           select(s.meaningful & (value - value == V(0)), value, V(a.stiffness ? 0.0 : INFINITY)));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
