#pragma once

#include "laws/law.h"
#include "pointwise/thermal.h"
#include "transfer/advance.h"

// Laws of temperature in many substeps, at one particle: before the laws of a material their parameters, F and J
// without expansion, and those of both phases; after them the stress, F and J of the material
// (torch_mpm/laws/thermal.py). Copies of chunks on the CPU and kernels on CUDA loop over the particles; on CUDA P2G may
// evaluate them as it loads the particles.
namespace mpm {

// Piecewise linear function of temperature, constant beyond its ends; of one knot: a number. None: absent.
template <class T>
struct TemperatureTable {
  int knots = 0;
  const T *temperature = nullptr, *value = nullptr;
  int first = 0;  // number of its first value in those of all tables
};

// A parameter of a law by a table.
template <class T>
struct TableParameter {
  TemperatureTable<T> table;
  T* to = nullptr;  // [P]
};

// Update of F and J that G2P defers to the laws, which read and write them anyway.
template <class T, int D>
struct DeferredMotion {
  bool moves = false;              // whether a G2P has deferred one
  AdvanceArguments<T, D> advance;  // its results are F and J, possibly in place; absent where G2P updates them
  Field<const T> rest;             // volume
  Field<T> volume;                 // present volume after the update; absent where there was none
};

// What a material reads of the temperature beside the parameters of its laws.
template <class T>
struct ThermalMaterial {
  Field<const T> theta, fraction;            // [P]; the liquid fraction where it melts
  TemperatureTable<T> expansion, coherency;  // the coherency, of one knot, where it melts

  MPM_HD bool melts() const { return coherency.knots > 0; }
};

// A material, whose only law is that of the solid where it does not melt.
template <class T, int D>
struct ThermalLawsArguments : ThermalMaterial<T> {
  int64_t particles = 0;
  Members members;
  int parameter_count = 0;
  TableParameter<T> parameters[2 * kMostParameters];  // of both laws
  // F and J of the material, and those that laws read; those are absent where laws read those of the material.
  Field<const T> F, J;
  Field<T> elastic_F, elastic_J;
  DeferredMotion<T, D> deferred;
  bool is_plastic = false;  // the law of the solid
  // F and J after the laws, in place of those before, absent where laws do not change them; stress of the material, and
  // of the liquid where it melts; energy that the solid dissipates, absent where it is not wanted.
  Field<T> next_F, next_J, stress, dissipated;
  Field<const T> liquid_stress;
  Field<T> difference;  // stress of the liquid minus that of the solid, absent where not wanted

  MPM_HD bool has_elastic() const { return elastic_F.pointer || elastic_J.pointer; }
  MPM_HD bool begins() const { return parameter_count > 0 || has_elastic(); }
  MPM_HD bool ends() const { return next_F.pointer || next_J.pointer || liquid_stress.pointer; }
};

// Laws of temperature that P2G evaluates: of a material of all particles, whose law changes nothing and whose liquid is
// a viscous fluid, or a weakly compressible one.
template <class T, int D>
struct ThermalP2GArguments : ThermalMaterial<T> {
  bool given = false;
  TemperatureTable<T> solid[kMostParameters], liquid[kMostParameters];  // their parameters by tables
  // Where it melts.
  LawArguments<T, D> fluid;
  bool is_viscous = false;
  Field<const T> J;                 // of the material, before the update that G2P has deferred
  Field<T> J_next, present_volume;  // after the laws; after that update, absent where there was none
};

inline namespace TORCH_MPM_ISA {

// Interval of a table of several knots, and share of the way from its first knot to its second one.
template <class S>
struct TablePlace {
  int knot;
  S share;
};

template <class S, class T>
MPM_HD TablePlace<S> place_in(const TemperatureTable<T>& table, const S& theta) {
  int left = 0;
  while (left + 2 < table.knots && theta > lift<S>(table.temperature[left + 1])) left++;
  const T* const knot = table.temperature + left;
  return {left, clamp_to_unit((theta - lift<S>(knot[0])) / lift<S>(knot[1] - knot[0]))};
}

// At a temperature of any scalar.
template <class S, class T>
MPM_HD S value_at(const TemperatureTable<T>& table, const S& theta) {
  if (table.knots == 1) return lift<S>(table.value[0]);
  const TablePlace<S> at = place_in(table, theta);
  const T* const value = table.value + at.knot;
  return lift<S>(value[0]) + at.share * lift<S>(value[1] - value[0]);
}

template <class T>
MPM_HD T stretch_of(const ThermalMaterial<T>& a, const One<T>& at) {
  if (a.expansion.knots == 0) return T(1);
  const T theta = load_scalar(at, a.theta);
  return thermal_stretch(value_at(a.expansion, theta), theta);
}

// Whether the solid of a particle has lost its coherency.
template <class T>
MPM_HD bool has_collapsed(const ThermalMaterial<T>& a, const One<T>& at) {
  return a.melts() && load_scalar(at, a.fraction) >= a.coherency.value[0];
}

// F and J that laws read, those of both phases where the material melts, from those of the material.
template <class T, int D>
MPM_HD Phases<T, D> read_by_laws(const ThermalMaterial<T>& a, const One<T>& at, const Phases<T, D>& of_material) {
  const T factor = T(1) / stretch_of(a, at);
  const Phases<T, D> elastic{volume_of_stretch<D>(factor) * of_material.J, factor * of_material.F};
  if (!a.melts()) return elastic;
  return phases_of(elastic.J, elastic.F, load_scalar(at, a.fraction), a.coherency.value[0]);
}

// Stress of a material that melts.
template <class T, int D>
MPM_HD Matrix<T, D> stress_of_phases(const ThermalMaterial<T>& a, const One<T>& at, const Matrix<T, D>& solid,
                                     const Matrix<T, D>& liquid) {
  const T fraction = load_scalar(at, a.fraction);
  Matrix<T, D> stress;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++)
      stress[i][j] = stress_of_phases(solid[i][j], liquid[i][j], fraction, a.coherency.value[0]);
  return stress;
}

// Whether a particle has no liquid, so that its stress is that of the solid.
template <class T>
MPM_HD bool is_solid(const ThermalMaterial<T>& a, const One<T>& at) {
  return !a.melts() || (load_scalar(at, a.fraction) == T(0) && !has_collapsed(a, at));
}

// Whether F of the material is that of its laws. F of a solid changes by plastic flow, and where it melts.
template <class T, int D>
MPM_HD bool changes_F(const ThermalLawsArguments<T, D>& a, const One<T>& at) {
  return a.next_F.pointer && (a.is_plastic || has_collapsed(a, at));
}

// The affine field of the deferred motion times its time step. Particles without a finite position, or of no scene, are
// unchanged.
template <class T, int D>
MPM_HD Matrix<T, D> deferred_change(const DeferredMotion<T, D>& deferred, const One<T>& at) {
  const AdvanceArguments<T, D>& a = deferred.advance;
  const int64_t scene = a.scene ? a.scene[at.p * a.scene_stride] : 0;
  const bool moves = scene >= 0 && scene < a.scenes && is_finite<D>(load_vector<D>(at, a.x).e);
  if (!deferred.moves || !moves) return zero_matrix<T, D>();
  return particle_dt(a, at) * load_matrix<D>(at, a.affine);
}

// F and J of a particle after the update that G2P has deferred, which are stored.
template <class T, int D>
MPM_HD Phases<T, D> load_moved(const ThermalLawsArguments<T, D>& a, const One<T>& at) {
  Phases<T, D> moved{T(1), zero_matrix<T, D>()};
  if (a.elastic_F.pointer) moved.F = load_matrix<D>(at, a.F);
  if (a.elastic_J.pointer) moved.J = load_scalar(at, a.J);
  const Field<T>&F = a.deferred.advance.F_next, &J = a.deferred.advance.J_next, &volume = a.deferred.volume;
  if (!F.pointer && !J.pointer) return moved;
  const Matrix<T, D> change = deferred_change(a.deferred, at);
  if (F.pointer) store_matrix<D>(at, F, moved.F = advance_deformation(moved.F, change, T(1)));
  if (J.pointer) store_scalar(at, J, moved.J = advance_volume_ratio(moved.J, change, T(1)));
  if (volume.pointer)
    store_scalar(at, volume, load_scalar(at, a.deferred.rest) * (J.pointer ? moved.J : determinant(moved.F)));
  return moved;
}

template <class T, int D>
MPM_HD void begin_laws_of(const ThermalLawsArguments<T, D>& a, int64_t p) {
  if (!a.members.has(p)) return;
  const One<T> at{p};
  for (int k = 0; k < a.parameter_count; k++)
    a.parameters[k].to[p] = value_at(a.parameters[k].table, load_scalar(at, a.theta));
  if (!a.has_elastic()) return;
  const Phases<T, D> phases = read_by_laws(a, at, load_moved(a, at));
  if (a.elastic_F.pointer) store_matrix<D>(at, a.elastic_F, phases.F);
  if (a.elastic_J.pointer) store_scalar(at, a.elastic_J, phases.J);
}

// The stress of a solid without liquid is its own.
template <class T, int D>
MPM_HD void end_laws_of(const ThermalLawsArguments<T, D>& a, int64_t p) {
  if (!a.members.has(p)) return;
  const One<T> at{p};
  const T factor = stretch_of(a, at);
  if (changes_F(a, at)) store_matrix<D>(at, a.next_F, factor * load_matrix<D>(at, constant(a.elastic_F)));
  if (a.next_J.pointer)
    store_scalar(at, a.next_J, volume_of_stretch<D>(factor) * load_scalar(at, constant(a.elastic_J)));
  const bool solid_alone = is_solid(a, at);
  if (solid_alone && !a.difference.pointer) return;
  const Matrix<T, D> solid = load_matrix<D>(at, constant(a.stress)), liquid = load_matrix<D>(at, a.liquid_stress);
  if (a.difference.pointer) store_matrix<D>(at, a.difference, liquid - solid);
  if (solid_alone) return;
  store_matrix<D>(at, a.stress, stress_of_phases(a, at, solid, liquid));
  if (a.dissipated.pointer && has_collapsed(a, at)) store_scalar(at, a.dissipated, T(0));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
