#pragma once

#include "materials/quartic_yield.h"

// The exact flow rule of the quartic energies in 3-D (supplement, equations 25 to 27): h + δγ dev ∂y/∂τ = h_trial. In
// the units of materials/quartic_yield.h, with the trial deviator n of unit length and x = |p|/|dev h_trial|,
//   x s + b d = n,   y(s) = 0,   d = dev q(s),   b ≥ 0.
//
// dev(h³) = (3p² + |s|²/2) s + 3p dev(s²) lies on the side of triaxial compression of s, so that s lies between the
// trial direction and the axis e of triaxial extension: s = r m(u), m(u) = (n + u e)/√(1 + u²), 0 ≤ u ≤ tan θ, with e
// now the unit vector across n and θ the Lode angle of n measured from that axis. For each u the root r(u) along the
// ray puts s on the surface. What remains, g(u) = d × (n − x s) = 0, has one change of sign.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T>
struct FlowRoot {
  Vector<T, 3> direction;  // m
  T r, b;
  T steps;  // evaluations of y, those of the radial root included
  MaskOf<T> converged;
};

// e: unit deviator across the unit deviator n, towards larger Σ n³.
template <class T>
MPM_HD Vector<T, 3> towards_extension(const Vector<T, 3>& n) {
  Vector<T, 3> e;
  T cubic = T(0);
  MPM_UNROLL
  for (int i = 0; i < 3; i++) {
    e[i] = T(0.57735026918962576) * (n[(i + 1) % 3] - n[(i + 2) % 3]);
    cubic = cubic + n[i] * n[i] * e[i];
  }
  return select(cubic < T(0), T(-1), T(1)) * e;
}

template <class T>
MPM_HD T tangent_of_lode_angle(const Vector<T, 3>& n) {
  const T most = max(max(n[0], n[1]), n[2]), least = min(min(n[0], n[1]), n[2]);
  return max(T(0), T(-0.57735026918962576) * (most + T(2) * least) / most);
}

// g/|d|, its derivative and that of r by the angle of m, at a point of the surface.
template <class T>
struct FlowResidual {
  T value, slope, radius_slope;
};

template <class Energy, class T>
MPM_HD FlowResidual<T> flow_residual(const T& r, const Vector<T, 3>& m, const Vector<T, 3>& k, const Vector<T, 3>& n,
                                     const Vector<T, 3>& e, const T& x, const T& alpha) {
  const ScaledStress<T, 3> stress = scaled_stress<Energy>(r * m);
  const Vector<T, 3> deviatoric = deviator(stress.q);
  const T inverse = rsqrt(dot(deviatoric, deviatoric));
  const Vector<T, 3> d = inverse * deviatoric;  // of unit length, so that nothing overflows
  T along = T(0), across = T(0);                // ∂y/∂s · m and · k
  MPM_UNROLL
  for (int i = 0; i < 3; i++) {
    const T g = stress.slope[i] * (d[i] + alpha);
    along = along + g * m[i];
    across = across + g * k[i];
  }
  const T radius_slope = T(0) - r * across / along;
  Vector<T, 3> left, change, turn;  // n − x s, s', d'
  MPM_UNROLL
  for (int i = 0; i < 3; i++) {
    left[i] = n[i] - x * r * m[i];
    change[i] = radius_slope * m[i] + r * k[i];
    turn[i] = inverse * stress.slope[i] * change[i];
  }
  const T dn = dot(d, n), de = dot(d, e), ln = dot(left, n), le = dot(left, e);
  const T value = dn * le - de * ln;
  const T slope = dot(turn, n) * le - dot(turn, e) * ln - x * (dn * dot(change, e) - de * dot(change, n));
  return {value, slope - value * dot(d, turn), radius_slope};
}

// From the radial root.
template <class Energy, class T>
MPM_HD FlowRoot<T> flow_root(const Root<T>& radial, const Vector<T, 3>& n, const T& x, const Cone<T>& cone,
                             const MaskOf<T>& wanted) {
  const Vector<T, 3> e = towards_extension(n);
  FlowRoot<T> f;
  f.direction = n;
  f.r = radial.r;
  f.steps = radial.steps;
  f.converged = radial.converged;
  const T most = T(RootFinding<T>::most_radius);
  T u = T(0), low = T(0), high = tangent_of_lode_angle(n);
  T active = select(wanted & radial.converged & (radial.r > T(0)), T(1), T(0)), on_surface = T(1);
  for (int step = 0; step < RootFinding<T>::most_steps && any(active > T(0)); step++) {
    const T square = T(1) + u * u, cosine = rsqrt(square);
    const Vector<T, 3> k = cosine * (e + (T(0) - u) * n);
    const FlowResidual<T> g = flow_residual<Energy>(f.r, f.direction, k, n, e, x, cone.alpha);
    const auto before = (g.value > T(0)) & (on_surface > T(0));
    low = select(before, u, low);
    high = select(before, high, u);
    const T turn = T(0) - g.value / g.slope, next = u + turn * square;
    const auto small = abs(turn) <= T(RootFinding<T>::tolerance);
    const auto good = (g.slope < T(0)) & (((next >= low) & (next <= high)) | small) & (on_surface > T(0));
    const T moved = select(active > T(0), select(good, max(next, T(0)), T(0.5) * (low + high)), u);
    T guess = max(T(0.5) * f.r, f.r + g.radius_slope * (moved - u) / square);
    guess = select(good, min(guess, most), f.r);
    u = moved;
    f.direction = rsqrt(T(1) + u * u) * (n + u * e);
    on_surface = T(1);
    if constexpr (Energy::unilateral_yield) {
      // Towards the axis of extension a steep cone may have no root: u is too large.
      if (any((active > T(0)) & (cone.alpha > T(0.408248))))
        on_surface = select(yield_function<Energy>(most, f.direction, cone).value > T(0), T(1), T(0));
    }
    const auto solve = (active > T(0)) & (on_surface > T(0));
    const Root<T> root = yield_root<Energy>(guess, most, f.direction, cone, solve);
    f.r = select(solve, root.r, f.r);
    f.steps = f.steps + root.steps;
    active = select(good & small & root.converged & (on_surface > T(0)), T(0), active);
  }
  f.converged = f.converged & (active <= T(0));
  const Vector<T, 3> d = deviator(scaled_stress<Energy>(f.r * f.direction).q);
  const T square = dot(d, d);
  const auto sheared = square > T(0);
  const T left = dot(d, n) - x * f.r * dot(d, f.direction);
  f.b = select(sheared, max(T(0), left) / select(sheared, square, T(1)), T(1e18) * x);  // on the axis b is infinite
  return f;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
