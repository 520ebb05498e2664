#pragma once

#include "pointwise/heat.h"

// Functions that make a law depend on temperature (torch_mpm/laws/thermal.py).
namespace mpm {
inline namespace TORCH_MPM_ISA {

// J, F, α, θ, and one to apply the expansion or zero to remove it: J and F times (1 + α θ)^D and 1 + α θ, or divided.
struct ThermalStretch {
  static constexpr const char* name = "thermal_stretch";
  static constexpr Entries arguments[] = {kScalar, kMatrix, kScalar, kScalar, kScalar};
  static constexpr Entries results[] = {kScalar, kMatrix};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T J = in.scalar();
    const Matrix<T, D> F = in.matrix();
    const T coefficient = in.scalar(), stretch = T(1) + coefficient * in.scalar();
    const T factor = select(in.scalar() > T(0), stretch, T(1) / stretch);
    T power = factor;
    MPM_UNROLL for (int i = 1; i < D; i++)
      power = power * factor;
    out.put(power * J);
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

// J, F, liquid fraction and coherency: J and F of one volume, that of J where the particle flows and forgets its shear,
// F = J^(1/D) 1, that of F elsewhere.
struct MeltingParts {
  static constexpr const char* name = "melting_parts";
  static constexpr Entries arguments[] = {kScalar, kMatrix, kScalar, kScalar};
  static constexpr Entries results[] = {kScalar, kMatrix};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T J = in.scalar();
    const Matrix<T, D> F = in.matrix();
    const T fraction = in.scalar();
    const auto flows = fraction >= in.scalar();
    const T safe = select(flows, select(J > T(0), J, T(1)), T(1));
    const T root = root_of_volume<D>(safe);
    out.put(select(flows, J, determinant(F)));
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) out.put(select(flows, i == j ? root : T(0), F[i][j]));
  }
};

// Stresses of the solid and the liquid, liquid fraction f and coherency: (1 − f) τ_solid + f τ_liquid while the solid
// is coherent, then τ_liquid.
struct MeltingStress {
  static constexpr const char* name = "melting_stress";
  static constexpr Entries arguments[] = {kMatrix, kMatrix, kScalar, kScalar};
  static constexpr Entries results[] = {kMatrix};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const Matrix<T, D> solid = in.matrix(), liquid = in.matrix();
    const T fraction = in.scalar();
    const auto flows = fraction >= in.scalar();
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++)
        out.put(select(flows, liquid[i][j], solid[i][j] + fraction * (liquid[i][j] - solid[i][j])));
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
