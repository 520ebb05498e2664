#pragma once

#include "laws/cam_clay.h"
#include "laws/fixed_corotated.h"
#include "laws/hencky.h"
#include "laws/herschel_bulkley.h"
#include "laws/snow.h"
#include "laws/von_mises.h"

// Arguments and bodies of the kernels of laws in principal strains: one decomposition, the map of the principal
// strains, stress; and the adjoint, with the derivatives of the law by dual numbers.
//
// A deformation that is not finite or not of positive determinant, or whose stress overflows, has no meaning: it is
// returned as it is and so is its history, its stress and moduli are zero, its energy is infinite, and no derivative
// passes but those of F and history with respect to themselves.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class... Laws>
struct PrincipalLawList : LawList<Laws...> {
  static constexpr int most_history = [] {
    int n = 0;
    ((n = Laws::history > n ? Laws::history : n), ...);
    return n;
  }();
};

// The laws that are compiled. A new law is one header and one name here.
using PrincipalLaws = PrincipalLawList<FixedCorotated, HenckyElastic, VonMises, HerschelBulkley, Snow, CamClay>;

}  // namespace TORCH_MPM_ISA

template <class T, int D>
struct PrincipalArguments {
  int law = 0;  // index in PrincipalLaws
  int64_t particles = 0;
  Field<const T> F;            // trial deformation gradient [P, D, D]
  const int* scene = nullptr;  // int32 [P], where a parameter is per scene
  int64_t scene_stride = 0;
  Parameter<T> parameters[PrincipalLaws::most_parameters];
  Field<const T> history[PrincipalLaws::most_history];  // [P]
};

enum FlowBranch : int { kElasticFlow = 0, kPlasticFlow = 1, kInvalidFlow = 3 };

template <class T, int D>
struct PrincipalUpdateArguments {
  PrincipalArguments<T, D> law;
  Field<T> F, stress;     // [P, D, D]; F absent for laws that do not change it
  Field<T> history;       // [P, n], absent without history
  Field<T> dissipated;    // [P], absent where not wanted
  int* branch = nullptr;  // [P] FlowBranch, plus 4 where a root was not found; absent where not wanted
};

template <class T, int D>
struct PrincipalBackwardArguments {
  PrincipalArguments<T, D> law;
  Field<const T> grad_F, grad_stress, grad_history, grad_dissipated;  // each may be absent
  Field<T> F, parameters, history;  // adjoints per particle [P, D, D], [P, n] and [P, m]; absent where not needed
};

enum class PrincipalScalar : int { energy = 0, stiffness = 1, wave_modulus = 2 };

template <class T, int D>
struct PrincipalScalarArguments {
  PrincipalArguments<T, D> law;
  PrincipalScalar which = PrincipalScalar::energy;
  Field<T> value;  // [P]
};

template <class T, int D>
struct PrincipalEnergyBackwardArguments {
  PrincipalArguments<T, D> law;
  Field<const T> grad_energy;       // [P]
  Field<T> F, parameters, history;  // as above
};

inline namespace TORCH_MPM_ISA {

template <class Law>
constexpr int kHistory = Law::history > 0 ? Law::history : 1;  // length of arrays of it

// Parameters and history of a particle.
template <class Law, class T>
struct PrincipalData {
  T parameters[Law::parameters];
  T history[kHistory<Law>];
};

template <class Law, class At, class T, int D>
MPM_HD PrincipalData<Law, typename At::Value> load_data(const At& at, const PrincipalArguments<T, D>& a) {
  PrincipalData<Law, typename At::Value> r;
  MPM_UNROLL for (int k = 0; k < Law::parameters; k++)
    r.parameters[k] = load_parameter(at, a.parameters[k], a.scene, a.scene_stride);
  MPM_UNROLL for (int k = 0; k < Law::history; k++)
    r.history[k] = at.load(a.history[k].pointer, a.history[k].stride[0]);
  return r;
}

template <class Mask, class T, int D>
MPM_HD Matrix<T, D> select(const Mask& mask, const Matrix<T, D>& a, const Matrix<T, D>& b) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = select(mask, a[i][j], b[i][j]);
  return r;
}

// What a law makes of a trial strain.
template <class Law, class T, int D>
struct Response {
  Vector<T, D> h, tau;
  T history[kHistory<Law>];
  T dissipated;
  Flow<T> flow;
};

template <class Law, class T, int D>
MPM_HD Response<Law, T, D> respond(const Vector<T, D>& h, const PrincipalData<Law, T>& data) {
  Response<Law, T, D> r;
  r.h = h;
  MPM_UNROLL for (int k = 0; k < Law::history; k++)
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
  MPM_UNROLL for (int k = 0; k < Law::history; k++)
    nan = nan + (r.history[k] - r.history[k]);
  return nan;
}

// The bodies choose the law after the decomposition: `choose(f)` calls f.operator()<Law>().
template <class Law>
struct Only {
  template <class F>
  MPM_HD void operator()(const F& f) const {
    f.template operator()<Law>();
  }
};

template <class At, class T, int D, class Choose>
MPM_HD void principal_update_at(const PrincipalUpdateArguments<T, D>& a, const At& at, const Choose& choose) {
  using V = typename At::Value;
  const Matrix<V, D> F = load_matrix<D>(at, a.law.F);
  const HenckyStrain<V, D> s = hencky_strain(F);
  Vector<V, D> h, principal;
  auto meaningful = s.meaningful, moved = s.meaningful;
  choose([&]<class Law>() {
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    const Response<Law, V, D> r = respond<Law>(s.h, data);
    h = r.h;
    principal = r.tau;
    meaningful = s.meaningful & (poison(r) == V(0));
    moved = meaningful & r.flow.plastic;
    MPM_UNROLL for (int k = 0; k < Law::history; k++)
      at.store(a.history.pointer + k * a.history.stride[1], a.history.stride[0],
               select(moved, r.history[k], data.history[k]));
    if (a.dissipated.pointer) at.store(a.dissipated.pointer, a.dissipated.stride[0], select(moved, r.dissipated, V(0)));
    if (a.branch) {
      const V branch = select(r.flow.plastic, V(kPlasticFlow), V(kElasticFlow)) + select(r.flow.converged, V(0), V(4));
      at.store_integer(a.branch, select(meaningful, branch, V(kInvalidFlow)));
    }
  });

  store_matrix<D>(at, a.stress, select(meaningful, compose(s.U, principal, s.U), zero_matrix<V, D>()));
  if (!a.F.pointer) return;
  MPM_UNROLL for (int i = 0; i < D; i++)
    h[i] = exponential(h[i] - s.h[i]) / s.scale;
  store_matrix<D>(at, a.F, select(moved, compose(s.U, h, s.B), F));
}

// Adjoints of what a law takes, from forward derivatives: `derivative(h, data)` gives the sum of the adjoints of the
// results times their derivatives in the direction that its arguments carry. It is asked once per strain, parameter and
// history variable; parameters and history go to memory at once, those of the strains are returned. Particles without
// meaning have the adjoints 0 of the parameters and `otherwise` of the history.
template <class Law, class At, class T, int D, class Mask, class F>
MPM_HD Vector<typename At::Value, D> differentiate(const At& at, const Vector<typename At::Value, D>& h,
                                                   const PrincipalData<Law, typename At::Value>& data,
                                                   const Field<T>& parameters, const Field<T>& history,
                                                   const Mask& meaningful, const typename At::Value otherwise[],
                                                   const F& derivative) {
  using V = typename At::Value;
  Vector<V, D> r = zero_vector<V, D>();
  const int count = D + (parameters.pointer ? Law::parameters : 0) + (history.pointer ? Law::history : 0);
  const int first_history = D + (parameters.pointer ? Law::parameters : 0);
#ifdef __CUDACC__
#pragma unroll 1
#endif
  for (int direction = 0; direction < count; direction++) {
    const auto seed = [&](const V& value, int index) { return Dual<V>(value, V(index == direction ? 1.0 : 0.0)); };
    Vector<Dual<V>, D> strain;
    PrincipalData<Law, Dual<V>> given;
    MPM_UNROLL for (int i = 0; i < D; i++)
      strain[i] = seed(h[i], i);
    MPM_UNROLL for (int k = 0; k < Law::parameters; k++)
      given.parameters[k] = seed(data.parameters[k], parameters.pointer ? D + k : -1);
    MPM_UNROLL for (int k = 0; k < Law::history; k++)
      given.history[k] = seed(data.history[k], first_history + k);
    const V value = derivative(strain, given);
    MPM_UNROLL for (int i = 0; i < D; i++)
      r[i] = i == direction ? value : r[i];
    MPM_UNROLL for (int k = 0; k < Law::history; k++)
      if (direction == first_history + k)
        at.store(history.pointer + k * history.stride[1], history.stride[0], select(meaningful, value, otherwise[k]));
    if (direction >= D && direction < first_history)
      at.store(parameters.pointer + (direction - D) * parameters.stride[1], parameters.stride[0],
               select(meaningful, value, V(0)));
  }
  return r;
}

template <class At, class T, int D, class Choose>
MPM_HD void principal_backward_at(const PrincipalBackwardArguments<T, D>& a, const At& at, const Choose& choose) {
  using V = typename At::Value;
  const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.law.F));
  const Matrix<V, D> right = right_axes(s);
  const Matrix<V, D> grad_F = a.grad_F.pointer ? load_matrix<D>(at, a.grad_F) : zero_matrix<V, D>();
  const Matrix<V, D> grad_stress = a.grad_stress.pointer ? load_matrix<D>(at, a.grad_stress) : zero_matrix<V, D>();
  const Matrix<V, D> M = transpose(s.U) * grad_F * right, N = transpose(s.U) * symmetric_part(grad_stress) * s.U;
  const V grad_dissipated =
      a.grad_dissipated.pointer ? at.load(a.grad_dissipated.pointer, a.grad_dissipated.stride[0]) : V(0);

  Vector<V, D> mapped, diagonal;
  Quotients<V> quotients[D][D];
  auto meaningful = s.meaningful;
  choose([&]<class Law>() {
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    const Response<Law, V, D> r = respond<Law>(s.h, data);
    mapped = r.h;
    meaningful = s.meaningful & (poison(r) == V(0));
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = i + 1; j < D; j++) {
        quotients[i][j] = {V(1), Law::stress_quotient(r.h[i], r.h[j], data.parameters, r.history)};
        if constexpr (Law::plastic) quotients[i][j].map = Law::map_quotient(r.flow, s.h, r.h, i, j);
      }

    Vector<V, D> grad_h;
    MPM_UNROLL for (int i = 0; i < D; i++)
      grad_h[i] = M[i][i] * exponential(r.h[i]);
    V grad_history[kHistory<Law>];
    MPM_UNROLL for (int k = 0; k < Law::history; k++)
      grad_history[k] = a.grad_history.pointer
                            ? at.load(a.grad_history.pointer + k * a.grad_history.stride[1], a.grad_history.stride[0])
                            : V(0);
    diagonal = differentiate<Law>(at, s.h, data, a.parameters, a.history, meaningful, grad_history,
                                  [&](const Vector<Dual<V>, D>& h, const PrincipalData<Law, Dual<V>>& given) {
                                    const Response<Law, Dual<V>, D> moved = respond<Law>(h, given);
                                    V value = grad_dissipated * moved.dissipated.derivative;
                                    MPM_UNROLL for (int i = 0; i < D; i++)
                                      value =
                                          value + grad_h[i] * moved.h[i].derivative + N[i][i] * moved.tau[i].derivative;
                                    MPM_UNROLL for (int k = 0; k < Law::history; k++)
                                      value = value + grad_history[k] * moved.history[k].derivative;
                                    return value;
                                  });
  });
  if (!a.F.pointer) return;
  const Matrix<V, D> principal = principal_adjoint(s, mapped, diagonal, symmetric_part(M), skew_part(M), N,
                                                   [&](int i, int j) { return quotients[i][j]; });
  store_matrix<D>(at, a.F, select(meaningful, s.U * principal * transpose(right), grad_F));
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

template <class At, class T, int D, class Choose>
MPM_HD void principal_scalar_at(const PrincipalScalarArguments<T, D>& a, const At& at, const Choose& choose) {
  using V = typename At::Value;
  const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.law.F));
  V value = V(0);
  choose([&]<class Law>() {
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    if (a.which == PrincipalScalar::energy) {
      value = Law::energy(s.h, data.parameters, data.history);
      return;
    }
    const Response<Law, V, D> r = respond<Law>(s.h, data);
    value =
        (a.which == PrincipalScalar::stiffness ? stiffness_bound(r, data) : wave_modulus_bound(r, data)) + poison(r);
  });
  const V otherwise = V(a.which == PrincipalScalar::energy ? INFINITY : 0.0);
  at.store(a.value.pointer, a.value.stride[0], select(s.meaningful & (value - value == V(0)), value, otherwise));
}

template <class At, class T, int D, class Choose>
MPM_HD void principal_energy_backward_at(const PrincipalEnergyBackwardArguments<T, D>& a, const At& at,
                                         const Choose& choose) {
  using V = typename At::Value;
  const HenckyStrain<V, D> s = hencky_strain(load_matrix<D>(at, a.law.F));
  const V grad = at.load(a.grad_energy.pointer, a.grad_energy.stride[0]);
  Vector<V, D> diagonal;
  auto meaningful = s.meaningful;
  choose([&]<class Law>() {
    const PrincipalData<Law, V> data = load_data<Law>(at, a.law);
    const V energy = Law::energy(s.h, data.parameters, data.history);
    meaningful = s.meaningful & (energy - energy == V(0));
    V none[kHistory<Law>];
    MPM_UNROLL for (int k = 0; k < Law::history; k++)
      none[k] = V(0);
    diagonal = differentiate<Law>(at, s.h, data, a.parameters, a.history, meaningful, none,
                                  [&](const Vector<Dual<V>, D>& h, const PrincipalData<Law, Dual<V>>& given) {
                                    return grad * Law::energy(h, given.parameters, given.history).derivative;
                                  });
  });
  if (!a.F.pointer) return;
  MPM_UNROLL for (int i = 0; i < D; i++)
    diagonal[i] = diagonal[i] * s.scale * s.inverse[i];
  store_matrix<D>(at, a.F, select(meaningful, compose(s.U, diagonal, right_axes(s)), zero_matrix<V, D>()));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
