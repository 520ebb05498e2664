#pragma once

#include "common/lanes.h"
#include "laws/law.h"
#include "pointwise/thermal.h"

// Laws of temperature in many substeps, at one particle: before the laws of a material their parameters, F and J
// without expansion, and those of both phases; after them the stress, F and J of the material
// (torch_mpm/laws/thermal.py). Copies of chunks on the CPU and kernels on CUDA loop over the particles.
namespace mpm {

// Piecewise linear function of temperature, constant beyond its ends; of one knot: a number. None: absent.
template <class T>
struct TemperatureTable {
  int knots = 0;
  const T *temperature = nullptr, *value = nullptr;
};

// A parameter of a law by a table.
template <class T>
struct TableParameter {
  TemperatureTable<T> table;
  T* to = nullptr;  // [P]
};

// A material, whose only law is that of the solid where it does not melt.
template <class T, int D>
struct ThermalLawsArguments {
  int64_t particles = 0;
  Members members;
  Field<const T> theta, fraction;  // [P]; the liquid fraction where it melts
  int parameter_count = 0;
  TableParameter<T> parameters[2 * kMostParameters];  // of both laws
  TemperatureTable<T> expansion, coherency;           // the coherency, of one knot, where it melts
  // F and J of the material, and those that laws read; those are absent where laws read those of the material.
  Field<const T> F, J;
  Field<T> elastic_F, elastic_J;
  bool is_plastic = false;  // the law of the solid
  // F and J after the laws, in place of those before, absent where laws do not change them; stress of the material, and
  // of the liquid where it melts; energy that the solid dissipates, absent where it is not wanted.
  Field<T> next_F, next_J, stress, dissipated;
  Field<const T> liquid_stress;

  MPM_HD bool has_elastic() const { return elastic_F.pointer || elastic_J.pointer; }
  MPM_HD bool begins() const { return parameter_count > 0 || has_elastic(); }
  MPM_HD bool ends() const { return next_F.pointer || next_J.pointer || liquid_stress.pointer; }
};

// Adjoint of the parameters by tables: those of a material, whose columns of the adjoints of all parameters become
// zero.
template <class T, int D>
struct ThermalLawsBackwardArguments {
  ThermalLawsArguments<T, D> forward;
  int column[2 * kMostParameters] = {};  // of each parameter in those of all laws
  Field<T> parameters;                   // [P, n]
  Field<T> theta;                        // [P], added
};

inline namespace TORCH_MPM_ISA {

// At a temperature of any scalar.
template <class S, class T>
MPM_HD S value_at(const TemperatureTable<T>& table, const S& theta) {
  int left = 0;
  while (left + 2 < table.knots && theta > lift<S>(table.temperature[left + 1])) left++;
  if (table.knots == 1) return lift<S>(table.value[0]);
  const T* const knot = table.temperature + left;
  const S share = clamp_to_unit((theta - lift<S>(knot[0])) / lift<S>(knot[1] - knot[0]));
  return lift<S>(table.value[left]) + share * lift<S>(table.value[left + 1] - table.value[left]);
}

template <class T, int D>
MPM_HD void laws_of_backward(const ThermalLawsBackwardArguments<T, D>& a, int64_t p) {
  if (!a.forward.members.has(p)) return;
  const One<T> at{p};
  const Dual<T> theta(load_scalar(at, a.forward.theta), T(1));
  T sum = load_scalar(at, constant(a.theta));
  for (int k = 0; k < a.forward.parameter_count; k++) {
    T& adjoint = a.parameters.pointer[p * a.parameters.stride[0] + a.column[k] * a.parameters.stride[1]];
    sum += value_at(a.forward.parameters[k].table, theta).derivative * adjoint;
    adjoint = T(0);
  }
  store_scalar(at, a.theta, sum);
}

template <class T, int D>
MPM_HD T stretch_of(const ThermalLawsArguments<T, D>& a, const One<T>& at) {
  if (a.expansion.knots == 0) return T(1);
  const T theta = load_scalar(at, a.theta);
  return thermal_stretch(value_at(a.expansion, theta), theta);
}

template <class T, int D>
MPM_HD void begin_laws_of(const ThermalLawsArguments<T, D>& a, int64_t p) {
  if (!a.members.has(p)) return;
  const One<T> at{p};
  for (int k = 0; k < a.parameter_count; k++)
    a.parameters[k].to[p] = value_at(a.parameters[k].table, load_scalar(at, a.theta));
  if (!a.has_elastic()) return;
  const T factor = T(1) / stretch_of(a, at);
  Phases<T, D> phases{T(1), zero_matrix<T, D>()};
  if (a.elastic_F.pointer) phases.F = factor * load_matrix<D>(at, a.F);
  if (a.elastic_J.pointer) phases.J = volume_of_stretch<D>(factor) * load_scalar(at, a.J);
  if (a.coherency.knots > 0) phases = phases_of(phases.J, phases.F, load_scalar(at, a.fraction), a.coherency.value[0]);
  if (a.elastic_F.pointer) store_matrix<D>(at, a.elastic_F, phases.F);
  if (a.elastic_J.pointer) store_scalar(at, a.elastic_J, phases.J);
}

// F of a solid changes by plastic flow, and where it melts; the stress of a solid without liquid is its own.
template <class T, int D>
MPM_HD void end_laws_of(const ThermalLawsArguments<T, D>& a, int64_t p) {
  if (!a.members.has(p)) return;
  const One<T> at{p};
  const bool melts = a.coherency.knots > 0;
  const T factor = stretch_of(a, at), fraction = melts ? load_scalar(at, a.fraction) : T(0);
  const bool flows = melts && fraction >= a.coherency.value[0];
  if (a.next_F.pointer && (a.is_plastic || flows))
    store_matrix<D>(at, a.next_F, factor * load_matrix<D>(at, constant(a.elastic_F)));
  if (a.next_J.pointer)
    store_scalar(at, a.next_J, volume_of_stretch<D>(factor) * load_scalar(at, constant(a.elastic_J)));
  if (fraction == T(0) && !flows) return;
  const Matrix<T, D> solid = load_matrix<D>(at, constant(a.stress)), liquid = load_matrix<D>(at, a.liquid_stress);
  Matrix<T, D> stress;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++)
      stress[i][j] = stress_of_phases(solid[i][j], liquid[i][j], fraction, a.coherency.value[0]);
  store_matrix<D>(at, a.stress, stress);
  if (a.dissipated.pointer && flows) store_scalar(at, a.dissipated, T(0));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
