#pragma once

#include "pointwise/heat.h"

// Functions that make a law depend on temperature (torch_mpm/laws/thermal.py).
namespace mpm {
inline namespace TORCH_MPM_ISA {

// Stretch of a body by a linear expansion α over the temperature θ above the reference.
template <class T>
MPM_HD T thermal_stretch(const T& coefficient, const T& theta) {
  return T(1) + coefficient * theta;
}

// The power of a stretch that a volume ratio takes.
template <int D, class T>
MPM_HD T volume_of_stretch(const T& stretch) {
  T power = stretch;
  MPM_UNROLL for (int i = 1; i < D; i++)
    power = power * stretch;
  return power;
}

// J, F, α, θ, and one to apply the expansion or zero to remove it: J and F times (1 + α θ)^D and 1 + α θ, or divided.
struct ThermalStretch {
  static constexpr const char* name = "thermal_stretch";
  static constexpr Entries arguments[] = {kScalar, kMatrix, kScalar, kScalar, kScalar};
  static constexpr Entries results[] = {kScalar, kMatrix};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T J = in.scalar();
    const Matrix<T, D> F = in.matrix();
    const T coefficient = in.scalar(), stretch = thermal_stretch(coefficient, in.scalar());
    const T factor = select(in.scalar() > T(0), stretch, T(1) / stretch);
    out.put(volume_of_stretch<D>(factor) * J);
    out.put(factor * F);
  }
};

// J^(1/D) for J > 0. For large and small J by the exponential of a positive number, which loses no digits.
template <int D, class T>
MPM_HD T root_of_volume(const T& J) {
  if constexpr (D == 2) return sqrt(J);
  const T power = log_1p(J, J - T(1)) * T(1.0 / 3), large = T(1) + expm1(abs(power));
  return select(power < T(0), T(1) / large, large);
}

// J and F of one volume, that of J where the particle flows and forgets its shear, F = J^(1/D) 1, that of F elsewhere.
template <class T, int D>
struct Phases {
  T J;
  Matrix<T, D> F;
};

template <class T, int D>
MPM_HD Phases<T, D> phases_of(const T& J, const Matrix<T, D>& F, const T& fraction, const T& coherency) {
  const auto flows = fraction >= coherency;
  const T safe = select(flows, select(J > T(0), J, T(1)), T(1)), root = root_of_volume<D>(safe);
  Phases<T, D> phases;
  phases.J = select(flows, J, determinant(F));
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) phases.F[i][j] = select(flows, i == j ? root : T(0), F[i][j]);
  return phases;
}

// (1 − f) τ_solid + f τ_liquid while the solid is coherent, then τ_liquid; an entry of a stress.
template <class T>
MPM_HD T stress_of_phases(const T& solid, const T& liquid, const T& fraction, const T& coherency) {
  return select(fraction >= coherency, liquid, solid + fraction * (liquid - solid));
}

// J, F, liquid fraction and coherency: J and F of both phases.
struct MeltingParts {
  static constexpr const char* name = "melting_parts";
  static constexpr Entries arguments[] = {kScalar, kMatrix, kScalar, kScalar};
  static constexpr Entries results[] = {kScalar, kMatrix};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T J = in.scalar();
    const Matrix<T, D> F = in.matrix();
    const T fraction = in.scalar();
    const Phases<T, D> phases = phases_of(J, F, fraction, in.scalar());
    out.put(phases.J);
    out.put(phases.F);
  }
};

// Stresses of the solid and the liquid, liquid fraction f and coherency: the stress of the material.
struct MeltingStress {
  static constexpr const char* name = "melting_stress";
  static constexpr Entries arguments[] = {kMatrix, kMatrix, kScalar, kScalar};
  static constexpr Entries results[] = {kMatrix};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const Matrix<T, D> solid = in.matrix(), liquid = in.matrix();
    const T fraction = in.scalar();
    const T coherency = in.scalar();
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) out.put(stress_of_phases(solid[i][j], liquid[i][j], fraction, coherency));
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
