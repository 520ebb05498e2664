#pragma once

#include "materials/arguments.h"
#include "materials/lanes.h"
#include "materials/quartic_return_map.h"
#include "math/svd.h"

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

// F = U diag(exp h) Vᵀ with B = Fᵀ U = V diag(exp h) up to a power of two: no V and no order of the strains is needed.
template <class T, int D>
struct HenckyStrain {
  Matrix<T, D> U, B;
  Vector<T, D> h, square;  // squared lengths of the columns of B
  T scale;                 // of B
  MaskOf<T> meaningful;    // det F > 0, everything finite
};

template <class T, int D>
MPM_HD HenckyStrain<T, D> hencky_strain(const Matrix<T, D>& F) {
  HenckyStrain<T, D> s;
  // Only extreme entries are scaled: the logarithm of a stretch near one keeps its digits.
  T largest = T(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = 0; j < D; j++) largest = max(largest, abs(F[i][j]));
  const auto moderate = (largest > T(1e-6)) & (largest < T(1e6));
  s.scale = select(moderate, T(1), inverse_power_of_two(largest));
  s.B = s.scale * transpose(F);
  orthogonalize_columns(s.B, s.U);
  const T shift = log_1p(s.scale, s.scale - T(1));
  T finite = poison(F);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    T minus_1 = s.B[0][i] * s.B[0][i] - T(1);
    s.square[i] = s.B[0][i] * s.B[0][i];
    MPM_UNROLL
    for (int k = 1; k < D; k++) {
      minus_1 = minus_1 + s.B[k][i] * s.B[k][i];
      s.square[i] = s.square[i] + s.B[k][i] * s.B[k][i];
    }
    s.h[i] = T(0.5) * log_1p(s.square[i], minus_1) - shift;
    finite = finite + (s.h[i] - s.h[i]);
  }
  s.meaningful = (determinant(s.B) > T(0)) & (finite == T(0));
  return s;
}

// A diag(d) Bᵀ.
template <class T, int D>
MPM_HD Matrix<T, D> compose(const Matrix<T, D>& A, const Vector<T, D>& d, const Matrix<T, D>& B) {
  Matrix<T, D> scaled;
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = 0; j < D; j++) scaled[i][j] = A[i][j] * d[j];
  return scaled * transpose(B);
}

template <class T>
struct SandParameters {
  T mu, lam, alpha;
  Cone<T> cone;
  MaskOf<T> shear;  // μ > 0
};

template <class At, class T, int D>
MPM_HD typename At::Value load_parameter(const At& at, const SandArguments<T, D>& a, const Parameter<T>& parameter) {
  if (parameter.scenes) {
    return at.each([&](int64_t p) {
      const int scene = a.scene[p * a.scene_stride];
      return parameter.pointer[(scene >= 0 && scene < parameter.scenes ? scene : 0) * parameter.stride];
    });
  }
  return at.load(parameter.pointer, parameter.stride);
}

template <class At, class T, int D>
MPM_HD SandParameters<typename At::Value> load_parameters(const At& at, const SandArguments<T, D>& a) {
  using V = typename At::Value;
  SandParameters<V> r;
  r.mu = load_parameter(at, a, a.mu);
  r.lam = load_parameter(at, a, a.lam);
  r.alpha = load_parameter(at, a, a.alpha);
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

// sinh(x)/x.
template <class T>
MPM_HD T sinhc(const T& x) {
  const T square = x * x;
  T series = T(1);
  MPM_UNROLL
  for (int k = 7; k > 0; k--) series = T(1) + series * square * T(1.0 / (2 * k * (2 * k + 1)));
  const auto small = square < T(0.25);
  const T e = exponential(abs(x));
  return select(small, series, T(0.5) * (e - T(1) / e) / select(small, T(1), abs(x)));
}

template <class T>
MPM_HD T cosh(const T& x) {
  const T e = exponential(abs(x));
  return T(0.5) * (e + T(1) / e);
}

// Adjoint of F in principal axes. M = Uᵀ F̄ V and N = Uᵀ τ̄ U are the adjoints of the results in the same axes. Divided
// differences of exp H and τ by exp h are written with sinh x/x, so that they hold at equal strains.
template <class Energy, class T, int D>
MPM_HD Matrix<T, D> principal_adjoint(const HenckyStrain<T, D>& s, const MappedStrain<T, D>& m,
                                      const Vector<T, D>& diagonal, const Matrix<T, D>& M, const Matrix<T, D>& N,
                                      const T& mu) {
  Vector<T, D> inverse;  // of the stretches
  Matrix<T, D> r;
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    inverse[i] = s.scale * rsqrt(s.square[i]);
    r[i][i] = diagonal[i] * inverse[i];
  }
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = i + 1; j < D; j++) {
    const T trial = s.h[i] - s.h[j], mapped = m.h[i] - m.h[j];
    // κ on the cone; at the apex 1 between strains that are kept, 0 between those that are not.
    const auto equal = trial == T(0);
      const auto both = (m.h[i] > T(0)) & (m.h[j] > T(0));
    const T at_apex = select(both, T(1), select(equal, T(0), mapped / select(equal, T(1), trial)));
    const T quotient = select(m.apex, at_apex, m.kappa);
    const T half = exponential(T(0.5) * (m.h[i] + m.h[j] - s.h[i] - s.h[j]));
    const T symmetric = half * quotient * sinhc(T(0.5) * mapped) / sinhc(T(0.5) * trial);
    const T skew = half * cosh(T(0.5) * mapped) / cosh(T(0.5) * trial);
    const T even = T(0.5) * symmetric * (M[i][j] + M[j][i]), odd = T(0.5) * skew * (M[i][j] - M[j][i]);
    const T stress = (N[i][j] + N[j][i]) * stress_quotient<Energy>(m.h[i], m.h[j], mu) * quotient /
                     (T(2) * sinhc(trial));
    r[i][j] = even + odd + stress * inverse[i];
    r[j][i] = even - odd + stress * inverse[j];
  }
  return r;
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

  Matrix<V, D> V_;
  MPM_UNROLL
  for (int j = 0; j < D; j++) {
    const V inverse = rsqrt(s.square[j]);
    MPM_UNROLL
    for (int i = 0; i < D; i++) V_[i][j] = s.B[i][j] * inverse;
  }
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
    const Matrix<V, D> g = s.U * principal_adjoint<Energy>(s, m, adjoint.h, M, N, p.mu) * transpose(V_);
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
