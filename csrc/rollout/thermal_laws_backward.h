#pragma once

#include "common/dual.h"
#include "rollout/thermal_laws.h"

// Adjoint of laws of temperature in many substeps, at one particle: `end_laws_backward` between those of P2G and of the
// laws of a material, `begin_laws_backward` after the latter. Kernels of the CPU and CUDA loop over the particles.
namespace mpm {

// A material. Its laws read what `begin_laws_of` computes once more; F and J after the laws are known.
template <class T, int D>
struct ThermalLawsBackwardArguments {
  ThermalLawsArguments<T, D> forward;
  // Adjoints of the parameters of all laws [P, n]. Columns of parameters by tables become zero.
  Field<T> parameters;
  int column[2 * kMostParameters] = {};
  Field<T> values;           // adjoints of the values of all tables [P, m], added; absent where not wanted
  Field<T> theta, fraction;  // [P], added
  // Adjoints of F and J of the material, those after the laws and then those before them; and of what its laws read,
  // those of their results and then those of their arguments.
  Field<T> F, J, elastic_F, elastic_J;
  // Adjoints of the stress, that of the material and then that of the solid, and of the stress of the liquid; of the
  // energy that the solid dissipates, absent where none becomes heat.
  Field<T> stress, liquid_stress, dissipated;
  Field<const T> difference;  // see ThermalLawsArguments
};

inline namespace TORCH_MPM_ISA {

// Adds the adjoint of a number by a table to those of the temperature and of the values of the table.
template <class T, int D>
MPM_HD void table_backward(const ThermalLawsBackwardArguments<T, D>& a, const One<T>& at,
                           const TemperatureTable<T>& table, const T& adjoint) {
  const T theta = load_scalar(at, a.forward.theta);
  const T slope = value_at(table, Dual<T>(theta, T(1))).derivative;
  store_scalar(at, a.theta, load_scalar(at, constant(a.theta)) + slope * adjoint);
  if (!a.values.pointer) return;
  const TablePlace<T> place = table.knots > 1 ? place_in(table, theta) : TablePlace<T>{0, T(0)};
  const auto add = [&](int knot, const T& share) {
    const int k = table.first + place.knot + knot;
    store_entry(at, a.values, k, load_entry(at, constant(a.values), k) + share * adjoint);
  };
  add(0, T(1) - place.share);
  if (table.knots > 1) add(1, place.share);
}

// Adds the adjoint of the stretch by an expansion to those of the temperature and of the table of the expansion.
template <class T, int D>
MPM_HD void stretch_backward(const ThermalLawsBackwardArguments<T, D>& a, const One<T>& at, const T& adjoint) {
  const TemperatureTable<T>& table = a.forward.expansion;
  if (table.knots == 0) return;
  const T theta = load_scalar(at, a.forward.theta), coefficient = value_at(table, theta);
  const T by_theta = thermal_stretch(Dual<T>(coefficient, T(0)), Dual<T>(theta, T(1))).derivative;
  const T by_coefficient = thermal_stretch(Dual<T>(coefficient, T(1)), Dual<T>(theta, T(0))).derivative;
  store_scalar(at, a.theta, load_scalar(at, constant(a.theta)) + by_theta * adjoint);
  table_backward(a, at, table, by_coefficient * adjoint);
}

// Adjoints of J and F of both phases become those of J and F before; `before` are these.
template <class T, int D>
MPM_HD Phases<T, D> phases_backward(const Phases<T, D>& before, bool flows, const Phases<T, D>& adjoint) {
  if (!flows) return {T(0), adjoint.F + adjoint.J * cofactor(before.F)};
  const bool is_root = before.J > T(0);  // elsewhere F is that of J = 1
  const T slope = is_root ? root_of_volume<D>(Dual<T>(before.J, T(1))).derivative : T(0);
  return {adjoint.J + slope * trace(adjoint.F), zero_matrix<T, D>()};
}

// Adjoint of the stress of a material, by the stresses of its phases and by the liquid fraction.
template <class T, int D>
MPM_HD void stress_backward(const ThermalLawsBackwardArguments<T, D>& a, const One<T>& at) {
  const T fraction = load_scalar(at, a.forward.fraction), coherency = a.forward.coherency.value[0];
  const auto derivative = [&](const Dual<T>& solid, const Dual<T>& liquid, const T& of_fraction) {
    return stress_of_phases(solid, liquid, Dual<T>(fraction, of_fraction), Dual<T>(coherency, T(0))).derivative;
  };
  const Dual<T> none(T(0), T(0)), one(T(0), T(1));
  const Matrix<T, D> adjoint = load_matrix<D>(at, constant(a.stress)), difference = load_matrix<D>(at, a.difference);
  T sum = load_scalar(at, constant(a.fraction));
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) sum += adjoint[i][j] * derivative(none, Dual<T>(difference[i][j], T(0)), T(1));
  store_scalar(at, a.fraction, sum);
  store_matrix<D>(at, a.stress, derivative(one, none, T(0)) * adjoint);
  store_matrix<D>(at, a.liquid_stress, derivative(none, one, T(0)) * adjoint);
  if (a.dissipated.pointer && has_collapsed(a.forward, at)) store_scalar(at, a.dissipated, T(0));
}

// Adjoint of `end_laws_of`.
template <class T, int D>
MPM_HD void end_laws_backward(const ThermalLawsBackwardArguments<T, D>& a, int64_t p) {
  const ThermalLawsArguments<T, D>& forward = a.forward;
  if (!forward.members.has(p)) return;
  const One<T> at{p};
  const Dual<T> factor(stretch_of(forward, at), T(1));
  T by_factor = T(0);
  if (a.elastic_F.pointer) {
    Matrix<T, D> adjoint = zero_matrix<T, D>();
    if (changes_F(forward, at)) {
      adjoint = load_matrix<D>(at, constant(a.F));
      by_factor += contract(adjoint, load_matrix<D>(at, constant(forward.next_F))) / factor.value;
    }
    store_matrix<D>(at, a.elastic_F, factor.value * adjoint);
  }
  if (a.elastic_J.pointer) {
    const Dual<T> volume = volume_of_stretch<D>(factor);
    const T adjoint = forward.next_J.pointer ? load_scalar(at, constant(a.J)) : T(0);
    by_factor += volume.derivative * adjoint * load_scalar(at, constant(forward.elastic_J));
    store_scalar(at, a.elastic_J, volume.value * adjoint);
  }
  stretch_backward(a, at, by_factor);
  if (forward.melts()) stress_backward(a, at);
}

// Adjoint of F and J that laws read.
template <class T, int D>
MPM_HD void elastic_backward(const ThermalLawsBackwardArguments<T, D>& a, const One<T>& at) {
  const ThermalLawsArguments<T, D>& forward = a.forward;
  const Dual<T> factor = Dual<T>(1.0) / Dual<T>(stretch_of(forward, at), T(1)), volume = volume_of_stretch<D>(factor);
  Phases<T, D> given{T(1), zero_matrix<T, D>()}, adjoint{T(0), zero_matrix<T, D>()};
  if (a.elastic_F.pointer)
    given.F = load_matrix<D>(at, forward.F), adjoint.F = load_matrix<D>(at, constant(a.elastic_F));
  if (a.elastic_J.pointer) given.J = load_scalar(at, forward.J), adjoint.J = load_scalar(at, constant(a.elastic_J));
  if (forward.melts())
    adjoint =
        phases_backward<T, D>({volume.value * given.J, factor.value * given.F}, has_collapsed(forward, at), adjoint);
  T by_factor = T(0);
  if (a.elastic_F.pointer) {
    by_factor += factor.derivative * contract(adjoint.F, given.F);
    const Matrix<T, D> rest = changes_F(forward, at) ? zero_matrix<T, D>() : load_matrix<D>(at, constant(a.F));
    store_matrix<D>(at, a.F, rest + factor.value * adjoint.F);
  }
  if (a.elastic_J.pointer) {
    by_factor += volume.derivative * adjoint.J * given.J;
    const T rest = forward.next_J.pointer ? T(0) : load_scalar(at, constant(a.J));
    store_scalar(at, a.J, rest + volume.value * adjoint.J);
  }
  stretch_backward(a, at, by_factor);
}

// Adjoint of `begin_laws_of`.
template <class T, int D>
MPM_HD void begin_laws_backward(const ThermalLawsBackwardArguments<T, D>& a, int64_t p) {
  if (!a.forward.members.has(p)) return;
  const One<T> at{p};
  for (int k = 0; k < a.forward.parameter_count; k++) {
    const T adjoint = load_entry(at, constant(a.parameters), a.column[k]);
    store_entry(at, a.parameters, a.column[k], T(0));
    table_backward(a, at, a.forward.parameters[k].table, adjoint);
  }
  if (a.forward.has_elastic()) elastic_backward(a, at);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
