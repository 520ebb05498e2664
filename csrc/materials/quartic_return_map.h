#pragma once

#include "materials/quartic.h"

// Return to the Drucker-Prager cone y = |dev τ| + α tr τ ≤ 0 in Hencky strains, with the trace of the strain kept.
//
// The map is radial: h = p + r |p| n with p = tr h/D < 0 and the unit trial deviator n (supplement, equation 28). In
// units of 4aμ|p|³ the yield function depends on r, n, α and Λ = λ/μ alone:
//   y(r) = |dev q| + α (Σ q − K),   qᵢ = x (3 − 3x + x²) with x = r nᵢ, x ≤ 1 if unilateral,   K = D + D⁴ Λ/2,
// q being 1 + (h/|p|)³: nothing cancels near the hydrostatic axis. For the quadratic energy y = r − α K with K = D + D²
// Λ/2.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T>
struct RootFinding;
template <>
struct RootFinding<float> {
  static constexpr int most_steps = 40;
  static constexpr double tolerance = 3e-5;  // of the last step, relative: the error after it is its square
  static constexpr double rounding = 2e-6;   // of y, relative to its terms
};
template <>
struct RootFinding<double> {
  static constexpr int most_steps = 64;
  static constexpr double tolerance = 1e-9;
  static constexpr double rounding = 4e-15;
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

template <class T>
struct Yield {
  T value, slope, trace;  // y, dy/dr, Σ q − K
  T size;                 // of the terms of y
};

template <class Energy, class T, int D>
MPM_HD Yield<T> yield_function(const T& r, const Vector<T, D>& n, const Cone<T>& cone) {
  const T K = cone.template hydrostatic<Energy, D>();
  if constexpr (Energy::quadratic) {
    return {r - cone.alpha * K, T(1), T(0) - K, r + cone.alpha * K};
  } else {
    Vector<T, D> q, slope;
  MPM_UNROLL
    for (int i = 0; i < D; i++) {
      const T x = Energy::unilateral_yield ? min(r * n[i], T(1)) : r * n[i];
      q[i] = x * (T(3) + x * (x - T(3)));
      slope[i] = T(3) * (T(1) - x) * (T(1) - x) * n[i];
    }
    const T total = sum(q), mean = T(1.0 / D) * total;
    T square = T(0), product = T(0);
    MPM_UNROLL
    for (int i = 0; i < D; i++) {
      const T d = q[i] - mean;
      square = square + d * d;
      product = product + d * slope[i];
    }
    const T norm = sqrt(square);
    const auto sheared = norm > T(0);
    const T norm_slope = select(sheared, product / select(sheared, norm, T(1)), T(3));
    const T trace = total - K;
    return {norm + cone.alpha * trace, norm_slope + cone.alpha * sum(slope), trace, norm + cone.alpha * abs(trace)};
  }
}

template <class T>
struct Root {
  T r;
  MaskOf<T> converged;
};

// The root of y in [0, start], where y(start) > 0: Newton's method, where y > 0 on ∛(y + c) − ∛c with c = αK + 1, nearly
// linear in r for any overshoot, kept in a bracket by bisection. Lanes are independent of each other: each stops when it
// has converged.
template <class Energy, class T, int D>
MPM_HD Root<T> yield_root(const T& start, const Vector<T, D>& n, const Cone<T>& cone, const MaskOf<T>& wanted) {
  const T target = cone.alpha * cone.template hydrostatic<Energy, D>();
  if constexpr (Energy::quadratic) return {max(T(0), target), T(0) == T(0)};
  const T c = target + T(1), w0 = cube_root(c), tolerance = T(RootFinding<T>::tolerance);
  const auto on_axis = target <= T(0);
  T r = select(on_axis, T(0), start), low = T(0), high = start;
  // 1 until a lane has converged.
  T active = select(wanted, select(on_axis, T(0), T(1)), T(0));
  for (int step = 0; step < RootFinding<T>::most_steps && any(active > T(0)); step++) {
    const Yield<T> y = yield_function<Energy>(r, n, cone);
    const auto above = y.value > T(0);
    high = select(above, r, high);
    low = select(above, low, r);
    const T w = cube_root(max(y.value, T(0)) + c);
    // 3 (w0 − w) w²/y' with w0 − w = −y/(w² + w w0 + w0²), which does not cancel.
    const T change = T(-3) * y.value * w * w / ((w * w + w * w0 + w0 * w0) * y.slope), next = r + change;
    const auto small = abs(change) <= tolerance * r;
    // At a multiple root, where the step says nothing, y vanishes to rounding.
    const auto settled = abs(y.value) <= T(RootFinding<T>::rounding) * y.size;
    const auto good = (y.slope > T(0)) & (((next >= low) & (next <= high)) | small);
    const T other = select(settled, r, T(0.5) * (low + high));
    r = select(active > T(0), select(good, next, other), r);
    active = select((good & small) | settled, T(0), active);
  }
  return {r, active <= T(0)};
}

enum SandBranch : int { kElastic = 0, kCone = 1, kApex = 2, kInvalid = 3 };

template <class T, int D>
struct MappedStrain {
  Vector<T, D> h;          // after the map
  Vector<T, D> direction;  // n
  T p, radius, kappa;      // mean strain; r after the map; the factor of the deviator
  MaskOf<T> cone, apex, converged;
};

// The trial strain with positive and negative parts balanced: the nearest h ≥ 0 of the same trace ≥ 0 (projection onto a
// simplex), the limit of the exact flow rule as p → 0.
template <class T, int D>
MPM_HD Vector<T, D> nearest_extension(const Vector<T, D>& h) {
  T least = h[0], most = h[0];
  MPM_UNROLL
  for (int i = 1; i < D; i++) {
    least = min(least, h[i]);
    most = max(most, h[i]);
  }
  const T total = sum(h);
  T shift = most - total;  // one positive strain remains
  if constexpr (D == 3) shift = select(total - most - T(0.5) * least >= T(0), T(-0.5) * least, shift);  // or two
  Vector<T, D> r;
  MPM_UNROLL
  for (int i = 0; i < D; i++) r[i] = max(h[i] - shift, T(0));
  return r;
}

// Whether a strain of trace ≥ 0 lies outside the yield surface.
template <class Energy, class T, int D>
MPM_HD MaskOf<T> yields_in_extension(const Vector<T, D>& h, const T& alpha) {
  T most = T(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++) most = max(most, abs(h[i]));
  if constexpr (!Energy::unilateral_yield) return most > T(0);
  const T scale = inverse_power_of_two(most);
  Vector<T, D> t;
  MPM_UNROLL
  for (int i = 0; i < D; i++) t[i] = cube(min(scale * h[i], T(0)));
  const T total = sum(t), mean = T(1.0 / D) * total;
  T square = T(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++) square = square + (t[i] - mean) * (t[i] - mean);
  return sqrt(square) + alpha * total > T(0);
}

// `keep` chooses between the two apex rules: all strain is lost, or the volume is kept (unilateral energy only). Without
// shear stiffness there is no cone.
template <class Energy, class T, int D>
MPM_HD MappedStrain<T, D> return_map(const Vector<T, D>& h, const Cone<T>& cone, const MaskOf<T>& shear, bool keep) {
  constexpr double most_radius = 1e5;  // where y has the sign of its limit, and its powers do not overflow
  MappedStrain<T, D> m;
  m.p = T(1.0 / D) * sum(h);
  Vector<T, D> s;
  T square = T(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    s[i] = h[i] - m.p;
    square = square + s[i] * s[i];
  }
  const T norm = sqrt(square), pressure = abs(m.p);
  const auto sheared = norm > T(0), compressed = m.p < T(0);
  const T inverse = T(1) / select(sheared, norm, T(1));
  MPM_UNROLL
  for (int i = 0; i < D; i++) m.direction[i] = inverse * s[i];

  const T start = min(norm / select(compressed, pressure, T(1)), T(most_radius));
  const T y = yield_function<Energy>(start, m.direction, cone).value;
  m.cone = compressed & shear & sheared & (y > T(0));
  m.apex = (m.p >= T(0)) & yields_in_extension<Energy>(h, cone.alpha);
  const Root<T> root = yield_root<Energy>(start, m.direction, cone, m.cone);
  m.radius = root.r;
  m.converged = root.converged;
  m.kappa = select(m.cone, root.r * pressure * inverse, select(m.apex, T(0), T(1)));
  const Vector<T, D> kept = nearest_extension(h);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    const T at_apex = Energy::unilateral_yield && keep ? kept[i] : T(0);
    m.h[i] = select(m.cone, m.p + root.r * pressure * m.direction[i], select(m.apex, at_apex, h[i]));
  }
  return m;
}

// Adjoint of `return_map`: from that of the mapped strain to those of the trial strain, α and Λ, by the implicit function
// theorem at the root. On a boundary between branches it is the derivative of the branch that was taken.
template <class T, int D>
struct MapAdjoint {
  Vector<T, D> h;
  T alpha, ratio;
};

template <class Energy, class T, int D>
MPM_HD MapAdjoint<T, D> return_map_adjoint(const MappedStrain<T, D>& m, const Vector<T, D>& grad, const Cone<T>& cone,
                                           bool keep) {
  const Vector<T, D>& n = m.direction;
  // ∂y/∂h at the mapped strain, in units of 4aμp² (2μ of the quadratic energy).
  Vector<T, D> c, q;
  T square = T(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    const T x = Energy::unilateral_yield ? min(m.radius * n[i], T(1)) : m.radius * n[i];
    c[i] = x - T(1);
    q[i] = Energy::quadratic ? x : x * (T(3) + x * (x - T(3)));
  }
  const T mean = T(1.0 / D) * sum(q);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    q[i] = q[i] - mean;
    square = square + q[i] * q[i];
  }
  const auto sheared = square > T(0);
  const T inverse = rsqrt(select(sheared, square, T(1)));
  Vector<T, D> g;
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    const T normal = select(sheared, q[i] * inverse, n[i]);
    if constexpr (Energy::quadratic)
      g[i] = normal + cone.alpha * (T(1) + T(D / 2.0) * cone.ratio);
    else
      g[i] = T(3) * c[i] * c[i] * (normal + cone.alpha) + T(1.5 * D * D * D) * cone.ratio * cone.alpha;
  }

  const T along = dot(n, grad), slope = dot(g, n), step = along / select(m.cone, slope, T(1));
  const T grad_mean = T(1.0 / D) * sum(grad), g_mean = T(1.0 / D) * sum(g);
  // The share of the other strains where the volume is kept: dHᵢ = dhᵢ + Σ_{dropped} dh/#kept.
  T positive = T(0), share = T(0);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    const auto remains = m.h[i] > T(0);
    positive = positive + select(remains, T(1), T(0));
    share = share + select(remains, grad[i], T(0));
  }
  share = share / max(positive, T(1));
  MapAdjoint<T, D> r;
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    const T mapped = grad_mean + m.kappa * (grad[i] - grad_mean) - step * (g_mean + m.kappa * (g[i] - g_mean));
    const T at_apex = Energy::unilateral_yield && keep ? select(m.h[i] > T(0), grad[i], share) : T(0);
    r.h[i] = select(m.cone, mapped, select(m.apex, at_apex, grad[i]));
  }
  const T K = cone.template hydrostatic<Energy, D>();
  const T scaled = select(m.cone, T(0) - step * abs(m.p), T(0));
  r.alpha = scaled * yield_function<Energy>(m.radius, n, cone).trace;
  const T slope_of_K = T((Energy::quadratic ? D * D : D * D * D * D) / 2.0);
  r.ratio = select(K > T(0), T(0) - scaled * cone.alpha * slope_of_K, T(0));
  return r;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
