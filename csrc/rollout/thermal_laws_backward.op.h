#pragma once

#include "rollout/recorded.h"

// Adjoint of the laws of temperature in the steps of a record, the last step first.
namespace mpm {

// Adjoints of the particles, which those of their laws read and write; absent ones are undefined.
struct ThermalAdjoints {
  Tensor F, J, heat;          // heat in the order of the record
  Tensor stress, dissipated;  // of the material, and then of its solid
  Tensor parameters, values;  // [P, n] of all laws, [P, m] of all tables
};

template <class T, int D>
class ThermalLawsBackward {
 public:
  ThermalLawsBackward(Recorded<T, D>& record, const SubstepsInputs& in, backend::Stream stream)
      : record_(record), stream_(stream) {
    const int64_t P = in.x.size(0);
    bool F = false, J = false, overwritten = false;
    for (size_t k = 0; k < laws().count(); k++) {
      F |= laws().material(k).elastic_F.pointer != nullptr;
      J |= laws().material(k).elastic_J.pointer != nullptr;
      overwritten |= laws().material(k).elastic_F.pointer && overwrites(k);
    }
    elastic_F = result(in.x, F, {P, D, D});
    F_term = result(in.x, overwritten, {P, D, D});
    if (overwritten) torch::stable::zero_(F_term);  // for the particles of other laws
    elastic_J_ = result(in.x, J, {P});
    liquid_stress_ = result(in.x, record.steps.melts, {P, D, D});
  }

  // Before the adjoints of the laws of step i, to which the record has returned: computes what laws read, and the
  // adjoints of what they write.
  void before_laws(int64_t i, const ThermalAdjoints& adjoints) {
    record_.use_thermal_laws(i);
    laws().begin(stream_);
    for (size_t k = 0; k < laws().count(); k++)
      if (laws().material(k).has_elastic()) backend::end_thermal_laws_backward(arguments(k, i, adjoints), stream_);
  }

  // Sets what the adjoint of law k reads and writes in place of the adjoints of the material. Plastic laws read what
  // `before_laws` has written, and laws without history add to it. Other laws would overwrite it, and write a term.
  void set(size_t k, LawBackwardArguments<T, D>& a) const {
    const size_t first = laws().first_of(k);
    if (!laws().material(first).has_elastic()) return;
    const LawInfo& info = record_.steps.calls[k].law->info;
    a.state = field<T>(info.field == Deformation::volume_ratio ? elastic_J_ : overwrites(k) ? F_term : elastic_F);
    if (info.plastic) a.grad_state = constant(a.state);
    if (first != k) a.grad_stress = field<const T>(liquid_stress_);
  }

  // After the adjoints of the laws: the adjoints become those before the laws.
  void after_laws(int64_t i, const ThermalAdjoints& adjoints) {
    for (size_t k = 0; k < laws().count(); k++)
      if (laws().material(k).begins()) backend::begin_thermal_laws_backward(arguments(k, i, adjoints), stream_);
  }

  // Adjoint of F that laws read, shared by the materials; and a term of it, which is to be added after the adjoints of
  // the laws. Undefined where no law writes them.
  Tensor elastic_F, F_term;

 private:
  // Whether the adjoint of law k overwrites that of F, and does not read it.
  bool overwrites(size_t k) const {
    const LawInfo& info = record_.steps.calls[k].law->info;
    return info.changes() && !info.plastic;
  }

  const ThermalLaws<T, D>& laws() const { return *record_.thermal; }

  ThermalLawsBackwardArguments<T, D> arguments(size_t k, int64_t i, const ThermalAdjoints& adjoints) const {
    const HeatSteps<T, D>& heat = *record_.heat;
    ThermalLawsBackwardArguments<T, D> a;
    a.forward = laws().material(k);
    std::copy(laws().columns(k).begin(), laws().columns(k).end(), a.column);
    a.parameters = field<T>(adjoints.parameters);
    a.values = field<T>(adjoints.values);
    a.theta = HeatSteps<T, D>::column_of(adjoints.heat, 0);
    if (a.forward.elastic_F.pointer) a.F = field<T>(adjoints.F), a.elastic_F = field<T>(elastic_F);
    if (a.forward.elastic_J.pointer) a.J = field<T>(adjoints.J), a.elastic_J = field<T>(elastic_J_);
    if (!laws().has_liquid(k)) return a;
    a.fraction = HeatSteps<T, D>::column_of(adjoints.heat, heat.liquid_column());
    a.stress = field<T>(adjoints.stress);
    a.liquid_stress = field<T>(liquid_stress_);
    a.dissipated = field<T>(adjoints.dissipated);
    a.difference = constant(record_.difference[i]);
    return a;
  }

  Recorded<T, D>& record_;
  backend::Stream stream_;
  Tensor elastic_J_, liquid_stress_;  // adjoints, shared by the materials
};

}  // namespace mpm
