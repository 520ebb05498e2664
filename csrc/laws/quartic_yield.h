#pragma once

#include "laws/quartic_energy.h"

// The Drucker-Prager yield function in Hencky strains of a fixed mean strain p < 0, and its root along a ray.
//
// With the deviator s of h/|p| the yield function depends, in units of 4aμ|p|³, on s, α and Λ = λ/μ alone:
//   y(s) = |dev q| + α (Σ q − K),   qᵢ = x (3 − 3x + x²) with x = sᵢ, x ≤ 1 if unilateral,   K = D + D⁴ Λ/2,
// q being 1 + (h/|p|)³: nothing cancels near the hydrostatic axis. For the quadratic energy q = s and K = D + D² Λ/2.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T>
struct RootFinding;
template <>
struct RootFinding<float> {
  static constexpr int most_steps = 40;
  static constexpr double tolerance = 3e-5;   // of the last step, relative: the error after it is its square
  static constexpr double rounding = 2e-6;    // of y, relative to its terms
  static constexpr double resolution = 5e-7;  // of a direction
  static constexpr double most_radius = 1e6;  // |s| where y has the sign of its limit, and its powers do not overflow
};
template <>
struct RootFinding<double> {
  static constexpr int most_steps = 64;
  static constexpr double tolerance = 1e-9;
  static constexpr double rounding = 4e-15;
  static constexpr double resolution = 1e-15;
  static constexpr double most_radius = 1e12;
};
#ifndef __CUDACC__
template <class T, int N>
struct RootFinding<Pack<T, N>> : RootFinding<T> {};
#endif

template <class T>
struct Cone {
  T alpha, ratio;  // α, Λ

  template <class Energy, int D>
  MPM_HD T hydrostatic() const {  // K; where the bulk modulus is not positive the cone is its axis
    return max(T(0), T(D) + T((Energy::quadratic ? D * D : D * D * D * D) / 2.0) * ratio);
  }
};

template <class To, class T>
MPM_HD Cone<To> convert(const Cone<T>& cone) {
  return {convert<To>(cone.alpha), convert<To>(cone.ratio)};
}

// q and dqᵢ/dsᵢ.
template <class T, int D>
struct ScaledStress {
  Vector<T, D> q, slope;
};

template <class Energy, class T, int D>
MPM_HD ScaledStress<T, D> scaled_stress(const Vector<T, D>& s) {
  ScaledStress<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T x = Energy::unilateral_yield ? min(s[i], T(1)) : s[i];
    r.q[i] = Energy::quadratic ? x : x * (T(3) + x * (x - T(3)));
    r.slope[i] = Energy::quadratic ? T(1) : T(3) * (T(1) - x) * (T(1) - x);
  }
  return r;
}

template <class T, int D>
MPM_HD Vector<T, D> deviator(const Vector<T, D>& a) {
  const T mean = T(1.0 / D) * sum(a);
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = a[i] - mean;
  return r;
}

template <class T>
struct Yield {
  T value, slope, trace;  // y, dy/dr, Σ q − K
  T size;                 // of the terms of y
};

// At s = r n.
template <class Energy, class T, int D>
MPM_HD Yield<T> yield_function(const T& r, const Vector<T, D>& n, const Cone<T>& cone) {
  const T K = cone.template hydrostatic<Energy, D>();
  if constexpr (Energy::quadratic) {
    return {r - cone.alpha * K, T(1), T(0) - K, r + cone.alpha * K};
  } else {
    const ScaledStress<T, D> stress = scaled_stress<Energy>(r * n);
    const Vector<T, D> d = deviator(stress.q);
    T slope = T(0), product = T(0);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const T along = stress.slope[i] * n[i];
      slope = slope + along;
      product = product + d[i] * along;
    }
    const T square = dot(d, d);
    const auto sheared = square > T(0);
    const T inverse = rsqrt(select(sheared, square, T(1))), norm = square * inverse;
    const T trace = sum(stress.q) - K;
    return {norm + cone.alpha * trace, select(sheared, product * inverse, T(3)) + cone.alpha * slope, trace,
            norm + cone.alpha * abs(trace)};
  }
}

template <class T>
struct Root {
  T r;
  T steps;  // evaluations of y
  MaskOf<T> converged;
};

// Root of y in [0, most] from an initial guess `start`, where y(most) > 0: Newton's method, where y > 0 on ∛(y + c) −
// ∛c with c = αK + 1, nearly linear in r for any overshoot, kept in a bracket by bisection, until a step is at most
// `tolerance` of r. Lanes are independent: each stops when it has converged.
template <class Energy, class T, int D>
MPM_HD_LARGE Root<T> yield_root(const T& start, const T& most, const Vector<T, D>& n, const Cone<T>& cone,
                                const MaskOf<T>& wanted, double tolerance) {
  const T target = cone.alpha * cone.template hydrostatic<Energy, D>();
  if constexpr (Energy::quadratic) return {max(T(0), target), T(0), T(0) == T(0)};
  const T c = target + T(1), w0 = cube_root(c);
  const auto on_axis = target <= T(0);
  T r = select(on_axis, T(0), start), low = T(0), high = most;
  // 1 until a lane has converged.
  T active = select(wanted, select(on_axis, T(0), T(1)), T(0)), steps = T(0);
  for (int step = 0; step < RootFinding<T>::most_steps && any(active > T(0)); step++) {
    steps = steps + active;
    const Yield<T> y = yield_function<Energy>(r, n, cone);
    const auto above = y.value > T(0);
    high = select(above, r, high);
    low = select(above, low, r);
    const T w = cube_root(max(y.value, T(0)) + c);
    // 3 (w0 − w) w²/y' with w0 − w = −y/(w² + w w0 + w0²), which does not cancel.
    const T change = T(-3) * y.value * w * w / ((w * w + w * w0 + w0 * w0) * y.slope), next = r + change;
    const auto small = abs(change) <= T(tolerance) * r;
    // At a multiple root, where the step has no meaning, y vanishes to rounding.
    const auto settled = abs(y.value) <= T(RootFinding<T>::rounding) * y.size;
    const auto good = (y.slope > T(0)) & (((next >= low) & (next <= high)) | small);
    const T other = select(settled, r, T(0.5) * (low + high));
    r = select(active > T(0), select(good, next, other), r);
    active = select((good & small) | settled, T(0), active);
  }
  return {r, steps, active <= T(0)};
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
