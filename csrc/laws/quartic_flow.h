#pragma once

#include "laws/quartic_yield.h"

// The exact flow rule of the quartic energies in 3-D (supplement, equations 25 to 27): h + δγ dev ∂y/∂τ = h_trial. In
// the units of laws/quartic_yield.h, with the trial deviator n of unit length and x = |p|/|dev h_trial|,
//   x s + b d = n,   y(s) = 0,   d = dev q(s),   b ≥ 0.
//
// dev(h³) = (3p² + |s|²/2) s + 3p dev(s²) lies on the side of triaxial compression of s, so that s lies between the
// trial direction and the axis e of triaxial extension: s = r m(u), m(u) = (n + u e)/√(1 + u²), 0 ≤ u ≤ tan θ, with e
// now the unit vector across n and θ the Lode angle of n measured from that axis. For each u the root r(u) along the
// ray puts s on the surface. What remains, g(u) = d × (n − x s) = 0, has one change of sign. It is bracketed on the
// surface; the last steps are Newton's method on both equations at once, which finds r also where r(u) is steep.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T>
struct FlowRoot {
  Vector<T, 3> direction;  // m
  T u, r, b;
  T steps;  // evaluations of y, those of the radial root included
  MaskOf<T> converged;
};

// e: unit deviator across the unit deviator n, towards larger Σ n³.
template <class T>
MPM_HD Vector<T, 3> towards_extension(const Vector<T, 3>& n) {
  Vector<T, 3> e;
  T cubic = T(0);
  MPM_UNROLL for (int i = 0; i < 3; i++) {
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

// Step of Newton's method: rotation of m, change of r. `value` and `slope` are g/|d| and its derivative along the
// surface.
template <class T>
struct FlowStep {
  T turn, change, value, slope;
};

template <class Energy, class T>
MPM_HD FlowStep<T> flow_step(const T& r, const Vector<T, 3>& m, const Vector<T, 3>& k, const Vector<T, 3>& n,
                             const Vector<T, 3>& e, const T& x, const Cone<T>& cone) {
  const ScaledStress<T, 3> stress = scaled_stress<Energy>(r * m);
  const Vector<T, 3> deviatoric = deviator(stress.q);
  const T square = dot(deviatoric, deviatoric), inverse = rsqrt(square);
  const Vector<T, 3> d = inverse * deviatoric;  // of unit length, so that nothing overflows
  const T y = square * inverse + cone.alpha * (sum(stress.q) - cone.template hydrostatic<Energy, 3>());
  T along = T(0), across = T(0);  // ∂y/∂s · m and · k
  Vector<T, 3> left;              // n − x s
  MPM_UNROLL for (int i = 0; i < 3; i++) {
    const T g = stress.slope[i] * (d[i] + cone.alpha);
    along = along + g * m[i];
    across = across + g * k[i];
    left[i] = n[i] - x * r * m[i];
  }
  const auto cross = [&](const Vector<T, 3>& a, const Vector<T, 3>& b) {
    return dot(a, n) * dot(b, e) - dot(a, e) * dot(b, n);
  };
  const T value = cross(d, left);
  // Derivative of g/|d| by s in the direction of a deviator.
  const auto derivative = [&](const Vector<T, 3>& direction) {
    Vector<T, 3> turn;
    MPM_UNROLL for (int i = 0; i < 3; i++)
      turn[i] = inverse * stress.slope[i] * direction[i];
    return cross(turn, left) - x * cross(d, direction) - value * dot(d, turn);
  };
  const T by_radius = derivative(m), radius_slope = T(0) - r * across / along;
  const T slope = derivative(r * k) + radius_slope * by_radius;
  const T to_surface = T(0) - y / along, turn = T(0) - (value + by_radius * to_surface) / slope;
  return {turn, to_surface + radius_slope * turn, value, slope};
}

// From the radial root, u = 0 with near = 0; or from a point near the root, with near = 1. Until a step is at most
// `tolerance`.
template <class Energy, class T>
MPM_HD_LARGE FlowRoot<T> flow_root(const Root<T>& start, T u, T near, const Vector<T, 3>& n, const T& x,
                                   const Cone<T>& cone, const MaskOf<T>& wanted, double tolerance) {
  const Vector<T, 3> e = towards_extension(n);
  FlowRoot<T> f;
  f.direction = rsqrt(T(1) + u * u) * (n + u * e);
  f.r = start.r;
  f.steps = start.steps;
  f.converged = start.converged;
  const T most = T(RootFinding<T>::most_radius);
  T low = T(0), high = tangent_of_lode_angle(n);
  T active = select(wanted & start.converged & (start.r > T(0)), T(1), T(0));
  T on_surface = T(1);  // whether r(u) exists; near: whether the last step was small and r was not solved for
  for (int step = 0; step < RootFinding<T>::most_steps && any(active > T(0)); step++) {
    const T square = T(1) + u * u, cosine = rsqrt(square);
    const Vector<T, 3> k = cosine * (e + (T(0) - u) * n);
    const FlowStep<T> g = flow_step<Energy>(f.r, f.direction, k, n, e, x, cone);
    const auto before = (g.value > T(0)) & (on_surface > T(0));
    low = select(near > T(0), low, select(before, u, low));
    high = select((near > T(0)) | before, high, u);
    const T next = u + g.turn * square, size = abs(g.turn) + abs(g.change) / f.r;
    // Where rounding keeps the steps of an ill-conditioned root larger, the last of them may be.
    const auto small = size <= T(tolerance * (step + 5 < RootFinding<T>::most_steps ? 1 : 300));
    const auto inside = (next >= low) & (next <= high);
    // A bracket that cannot be halved further may still leave r open.
    const auto settled = high - low <= T(RootFinding<T>::resolution);
    const auto good =
        (g.slope < T(0)) & (on_surface > T(0)) & (inside | small | settled | ((near > T(0)) & (size <= T(0.02))));
    const auto now = active > T(0);
    u = select(now, select(good, max(next, T(0)), T(0.5) * (low + high)), u);
    f.r = select(now & good, min(max(T(0.5) * f.r, min(T(2) * f.r, f.r + g.change)), most), f.r);
    f.direction = rsqrt(T(1) + u * u) * (n + u * e);
    near = select(good & ((size <= T(0.02)) | settled), T(1), T(0));
    on_surface = T(1);
    if constexpr (Energy::unilateral_yield) {
      // Towards the axis of extension a steep cone may have no root: u is too large.
      if (any(now & (near <= T(0)) & (cone.alpha > T(0.408248))))
        on_surface = select((near > T(0)) | (yield_function<Energy>(most, f.direction, cone).value > T(0)), T(1), T(0));
    }
    const auto solve = now & (on_surface > T(0)) & (near <= T(0));
    const Root<T> root = yield_root<Energy>(f.r, most, f.direction, cone, solve, tolerance);
    f.r = select(solve, root.r, f.r);
    f.steps = f.steps + root.steps + active;
    active = select(good & small, T(0), active);
  }
  f.u = u;
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
