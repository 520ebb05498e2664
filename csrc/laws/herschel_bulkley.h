#pragma once

#include "laws/elasticity.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Viscoplastic fluid on Hencky elasticity (Herschel and Bulkley 1926; Bingham's for n = 1; as Yue et al. 2015, but in
// Hencky strains): above the yield stress, with t = |dev τ|/√2 and the shear rate g = √2 |dh_p/dt| of simple shear,
//   t = τ_y + η gⁿ.
// Backward Euler over a step Δt keeps the direction of the deviator: t_trial − t = μ Δt g. Without viscosity or with an
// infinite step it is perfect plasticity, without a step it is elasticity.
struct HerschelBulkley : HenckyElasticity {
  static constexpr const char* name = "herschel_bulkley";
  static constexpr std::array parameters = {not_negative("mu", "Pa"),           real("lam", "Pa"),
                                            not_negative("yield_stress", "Pa"), not_negative("consistency", "Pa s^n"),
                                            positive("exponent", ""),           time_step};
  static constexpr bool plastic = true;

  template <class T, int D>
  MPM_HD static Flow<T> flow(Vector<T, D>& h, const T p[], T[]) {
    const Deviator<T, D> s = measure_deviator(h);
    const T stress = T(1.4142135623730951) * p[0] * s.norm, excess = stress - p[2];
    const MaskOf<T> plastic = (excess > T(0)) & (stress > T(0)) & (p[0] * p[5] > T(0));
    const auto viscous = plastic & (p[3] > T(0));
    // z = (t − τ_y)/(t_trial − τ_y) solves z + A z^m = 1 with m = 1/n, A = μ Δt (excess/η)^m/excess.
    const T x = select(viscous, excess, T(1)), m = T(1) / p[4];
    const T rate = logarithm(select(viscous, p[0] * p[5], T(1))) - logarithm(x) +
                   m * (logarithm(x) - logarithm(select(viscous, p[3], T(1))));
    const Share<T> z = share(rate, m, viscous);
    const T kept = p[2] + excess * select(viscous, z.value, T(0));
    const T kappa = select(plastic, kept / select(plastic, stress, T(1)), T(1));
    h = select(plastic, scale_deviator(h, s.mean, s.mean, kappa), h);
    return {kappa, plastic, z.converged};
  }

 private:
  template <class T>
  struct Share {
    T value;
    MaskOf<T> converged;
  };

  // ln(eᵘ + e^(a + m u)) and its slope in u; convex and increasing in u.
  template <class T>
  struct LogSum {
    T value, slope;
  };
  template <class T>
  MPM_HD static LogSum<T> log_sum(const T& u, const T& a, const T& m) {
    const T v = a + m * u, ratio = exponential(T(0) - abs(u - v));
    const T larger = T(1) / (T(1) + ratio), smaller = ratio * larger;
    const auto first = u > v;
    const T slope = select(first, larger + m * smaller, smaller + m * larger);
    return {max(u, v) + log_1p(T(1) + ratio, ratio), slope};
  }

  // z = eᵘ of z + eᵃ zᵐ = 1. Newton's method from the right is monotone; the last step, in T, carries the derivatives
  // of the root.
  template <class T>
  MPM_HD static Share<T> share(const T& a, const T& m, const MaskOf<T>& wanted) {
    using V = ValueOf<T>;
    const V rate = value_of(a), power = value_of(m);
    V u = select(rate > V(0), V(0) - rate / power, V(0));
    V active = select(wanted, V(1), V(0));  // until a lane has converged
    for (int k = 0; k < NewtonTolerance<V>::most_steps && any(active > V(0)); k++) {
      const LogSum<V> f = log_sum(u, rate, power);
      const V step = f.value / f.slope;
      u = select(active > V(0), u - step, u);
      active = select(abs(step) > V(NewtonTolerance<V>::value) * max(V(1), abs(u)), active, V(0));
    }
    const T root = lift<T>(u);
    const LogSum<T> f = log_sum(root, a, m);
    return {exponential(root - f.value / f.slope), active <= V(0)};
  }
};

MPM_REGISTER_LAW(HerschelBulkley)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
