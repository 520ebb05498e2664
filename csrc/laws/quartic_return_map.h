#pragma once

#include "laws/quartic_flow.h"

// Return to the Drucker-Prager cone y = |dev τ| + α tr τ ≤ 0 in Hencky strains, at constant trace of the strain.
//
// The map is radial: h = p + r |p| n with p = tr h/D < 0 and the unit trial deviator n (supplement, equation 28); or it
// has the exact flow rule, which is the same in 2-D and for the quadratic energy.
namespace mpm {
inline namespace TORCH_MPM_ISA {

enum SandBranch : int { kElastic = 0, kCone = 1, kApex = 2, kInvalid = 3 };

template <class T, int D>
struct MappedStrain {
  Vector<T, D> h;          // after the map
  Vector<T, D> direction;  // its unit deviator
  T p, radius, kappa;      // mean strain; |dev h|/|p|; the factor of the deviator if radial
  T x, b;                  // of the exact flow, see laws/quartic_flow.h
  T steps;                 // number of evaluations of the yield function by the root finding
  MaskOf<T> cone, apex, converged;
};

// The trial strain with positive and negative parts balanced: the nearest h ≥ 0 of the same trace ≥ 0 (projection onto
// a simplex), the limit of the exact flow rule as p → 0.
template <class T, int D>
MPM_HD Vector<T, D> nearest_extension(const Vector<T, D>& h) {
  T least = h[0], most = h[0];
  MPM_UNROLL for (int i = 1; i < D; i++) {
    least = min(least, h[i]);
    most = max(most, h[i]);
  }
  const T total = sum(h);
  T shift = most - total;  // one positive strain remains
  if constexpr (D == 3) shift = select(total - most - T(0.5) * least >= T(0), T(-0.5) * least, shift);  // or two
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = max(h[i] - shift, T(0));
  return r;
}

// Whether a strain of trace ≥ 0 lies outside the yield surface.
template <class Energy, class T, int D>
MPM_HD MaskOf<T> yields_in_extension(const Vector<T, D>& h, const T& alpha) {
  T most = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    most = max(most, abs(h[i]));
  if constexpr (!Energy::unilateral_yield) return most > T(0);
  const T scale = inverse_power_of_two(most);
  Vector<T, D> t;
  MPM_UNROLL for (int i = 0; i < D; i++)
    t[i] = cube(min(scale * h[i], T(0)));
  const Vector<T, D> d = deviator(t);
  return sqrt(dot(d, d)) + alpha * sum(t) > T(0);
}

// Whether y > 0 at s = r n, in the arithmetic of Rough.
template <class Energy, class Rough, class T, int D>
MPM_HD MaskOf<T> outside(const T& r, const Vector<T, D>& n, const Cone<T>& cone) {
  const Rough most = Rough(RootFinding<Rough>::most_radius);
  const Rough y = yield_function<Energy>(min(convert<Rough>(r), most), convert<Rough>(n), convert<Rough>(cone)).value;
  return convert<MaskOf<T>>(y > Rough(0));
}

// Root of y below r = `most`. Where Rough is a type of fewer digits all steps except the last are computed in it.
template <class Energy, class Rough, class T, int D>
MPM_HD Root<T> radial_root(const T& most, const Vector<T, D>& n, const Cone<T>& cone, const MaskOf<T>& wanted) {
  constexpr double tolerance = RootFinding<Rough>::tolerance;
  T start = most;
  if constexpr (!std::is_same_v<Rough, T>) {
    const Rough end = min(convert<Rough>(most), Rough(RootFinding<Rough>::most_radius));
    const Root<Rough> rough = yield_root<Energy>(end, end, convert<Rough>(n), convert<Rough>(cone),
                                                 convert<MaskOf<Rough>>(wanted), tolerance);
    start = min(convert<T>(rough.r), most);
  }
  return yield_root<Energy>(start, most, n, cone, wanted, tolerance);
}

// Roots that float32 cannot resolve, of steep cones far from their axis: a few in 1e5.
template <class Energy, class T>
MPM_HD_LARGE void solve_in_float64(FlowRoot<T>& f, const Vector<T, 3>& n, const T& x, const Cone<T>& cone,
                                   const MaskOf<T>& open) {
  using W = Wide<T>;
  const auto some = convert<MaskOf<W>>(open);
  const Vector<W, 3> direction = convert<W>(n);
  const Cone<W> wide = convert<W>(cone);
  const W most = min(W(1) / convert<W>(x), W(RootFinding<W>::most_radius));
  const Root<W> radial = radial_root<Energy, W>(most, direction, wide, some);
  const FlowRoot<W> g =
      flow_root<Energy>(radial, W(0), W(0), direction, convert<W>(x), wide, some, RootFinding<W>::tolerance);
  MPM_UNROLL for (int i = 0; i < 3; i++)
    f.direction[i] = select(open, convert<T>(g.direction[i]), f.direction[i]);
  f.r = select(open, convert<T>(g.r), f.r);
  f.b = select(open, convert<T>(g.b), f.b);
  f.steps = f.steps + select(open, convert<T>(g.steps), T(0));
  f.converged = f.converged | (open & convert<MaskOf<T>>(g.converged));
}

template <class Energy, class Rough, class T>
MPM_HD FlowRoot<T> exact_root(const Root<T>& radial, const Vector<T, 3>& n, const T& x, const Cone<T>& cone,
                              const MaskOf<T>& wanted) {
  constexpr double tolerance = RootFinding<Rough>::tolerance;
  Root<T> start = radial;
  T u = T(0), near = T(0);
  if constexpr (!std::is_same_v<Rough, T>) {
    const auto some = convert<MaskOf<Rough>>(wanted);
    const Root<Rough> first{convert<Rough>(radial.r), Rough(0), convert<MaskOf<Rough>>(radial.converged)};
    const FlowRoot<Rough> rough = flow_root<Energy>(first, Rough(0), Rough(0), convert<Rough>(n), convert<Rough>(x),
                                                    convert<Rough>(cone), some, tolerance);
    const auto found = convert<MaskOf<T>>(rough.converged);
    start.r = select(found, convert<T>(rough.r), radial.r);
    u = select(found, convert<T>(rough.u), T(0));
    near = select(found, T(1), T(0));
  }
  FlowRoot<T> f = flow_root<Energy>(start, u, near, n, x, cone, wanted, tolerance);
  if constexpr (Energy::unilateral_yield && !std::is_same_v<T, Wide<T>>) {
    const auto open = wanted & (select(f.converged, T(0), T(1)) > T(0));
    if (any(open)) solve_in_float64<Energy>(f, n, x, cone, open);
  }
  return f;
}

// `keep` chooses between the two apex rules: all strain is lost, or the volume is preserved (unilateral energy only).
// Without shear stiffness there is no cone. Torn sand is at the apex in all extension. Rough: see radial_root.
template <class Energy, class Rough, class T, int D>
MPM_HD MappedStrain<T, D> return_map(const Vector<T, D>& h, const Cone<T>& cone, const MaskOf<T>& shear,
                                     const MaskOf<T>& torn, bool keep) {
  MappedStrain<T, D> m;
  m.p = T(1.0 / D) * sum(h);
  Vector<T, D> s;
  MPM_UNROLL for (int i = 0; i < D; i++)
    s[i] = h[i] - m.p;
  const T square = dot(s, s), pressure = abs(m.p);
  const auto sheared = square > T(0), compressed = m.p < T(0);
  const T inverse = rsqrt(select(sheared, square, T(1))), norm = square * inverse;
  m.direction = inverse * s;

  const T start = min(norm / select(compressed, pressure, T(1)), T(RootFinding<T>::most_radius));
  m.cone = compressed & shear & sheared & outside<Energy, Rough>(start, m.direction, cone);
  const auto yields = yields_in_extension<Energy>(convert<Rough>(h), convert<Rough>(cone.alpha));
  m.apex = (m.p >= T(0)) & (torn | convert<MaskOf<T>>(yields));
  const Root<T> root = radial_root<Energy, Rough>(start, m.direction, cone, m.cone);
  m.radius = root.r;
  m.converged = root.converged;
  m.steps = root.steps;
  m.kappa = select(m.cone, root.r * pressure * inverse, select(m.apex, T(0), T(1)));
  m.x = m.b = T(0);
  if constexpr (Energy::exact_flow) {
    m.x = max(pressure * inverse, T(1e-30));
    const FlowRoot<T> flow = exact_root<Energy, Rough>(root, m.direction, m.x, cone, m.cone);
    m.radius = flow.r;
    m.direction = flow.direction;
    m.b = flow.b;
    m.converged = flow.converged;
    m.steps = flow.steps;
  }
  const Vector<T, D> kept = nearest_extension(h);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T at_apex = Energy::unilateral_yield && keep ? kept[i] : T(0);
    m.h[i] = select(m.cone, m.p + m.radius * pressure * m.direction[i], select(m.apex, at_apex, h[i]));
  }
  return m;
}

// (Hᵢ − Hⱼ)/(hᵢ − hⱼ) of mapped strains H of trial strains h, also where these are equal. `trial` is hᵢ − hⱼ.
// Differences are computed in T, their quotient in V.
template <class Energy, class V, class T, int D>
MPM_HD V strain_quotient(const MappedStrain<T, D>& m, int i, int j, const T& trial) {
  T on_cone = m.kappa;
  if constexpr (Energy::exact_flow) {
    const T a = m.radius * m.direction[i] - T(1), b = m.radius * m.direction[j] - T(1);
    on_cone = m.x / (m.x + m.b * cube_quotient<Energy::unilateral_yield>(a, b));
    on_cone = select(m.cone, on_cone, T(1));
  }
  // At the apex 1 between preserved strains, 0 between those that are not.
  const V before = convert<V>(trial), after = convert<V>(m.h[i] - m.h[j]);
  const auto equal = before == V(0);
  const MaskOf<T> both = (m.h[i] > T(0)) & (m.h[j] > T(0));
  const V at_apex = select(convert<MaskOf<V>>(both), V(1), select(equal, V(0), after / select(equal, V(1), before)));
  return select(convert<MaskOf<V>>(m.apex), at_apex, convert<V>(on_cone));
}

// Adjoint of `return_map`: from that of the mapped strain to those of the trial strain, α and Λ, by the implicit
// function theorem at the root. On a boundary between branches it is the derivative of the selected branch.
template <class T, int D>
struct MapAdjoint {
  Vector<T, D> h;
  T alpha, ratio;
};

// Aᵀ⁻¹ a of the flow rule A dH = dh − d db without the yield surface: A = κ⁻¹ in the deviators if radial, and I + b/x
// dev diag(∂q/∂s) if exact. As mean + scale deviator, whose mean differs from that of a if exact: x may be far below
// the rounding of the mean.
template <class T, int D>
struct PulledBack {
  T mean, scale;
  Vector<T, D> deviator;

  MPM_HD T operator[](int i) const { return mean + scale * deviator[i]; }
};

template <class Energy, class T, int D>
MPM_HD PulledBack<T, D> pull_back(const MappedStrain<T, D>& m, const Vector<T, D>& slope, const Vector<T, D>& a) {
  PulledBack<T, D> r;
  if constexpr (Energy::exact_flow) {
    Vector<T, D> inverse;
    MPM_UNROLL for (int i = 0; i < D; i++)
      inverse[i] = T(1) / (m.x + m.b * slope[i]);
    r.mean = dot(a, inverse) / sum(inverse);
    r.scale = m.x;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r.deviator[i] = (a[i] - r.mean) * inverse[i];
  } else {
    r.mean = T(1.0 / D) * sum(a);
    r.scale = m.kappa;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r.deviator[i] = a[i] - r.mean;
  }
  return r;
}

template <class Energy, class T, int D>
MPM_HD_LARGE MapAdjoint<T, D> return_map_adjoint(const MappedStrain<T, D>& m, const Vector<T, D>& grad,
                                                 const Cone<T>& cone, bool keep) {
  const Vector<T, D>& n = m.direction;
  // ∂y/∂h at the mapped strain, in units of 4aμp² (2μ of the quadratic energy).
  const ScaledStress<T, D> stress = scaled_stress<Energy>(m.radius * n);
  const Vector<T, D> d = deviator(stress.q);
  const T square = dot(d, d), trace = T(Energy::quadratic ? D / 2.0 : 1.5 * D * D * D) * cone.ratio * cone.alpha;
  const auto sheared = square > T(0);
  const T inverse = rsqrt(select(sheared, square, T(1)));
  Vector<T, D> g;
  MPM_UNROLL for (int i = 0; i < D; i++)
    g[i] = stress.slope[i] * (select(sheared, d[i] * inverse, n[i]) + cone.alpha) + trace;

  // dH = A⁻¹ (dh − f dγ) with g · dH = 0 and the flow direction f.
  const PulledBack<T, D> pulled = pull_back<Energy>(m, stress.slope, grad),
                         normal = pull_back<Energy>(m, stress.slope, g);
  T along = dot(n, grad), across = dot(n, g);
  if constexpr (Energy::exact_flow) {  // f = d, to which the means add nothing
    along = select(sheared, dot(d, pulled.deviator), along);
    across = select(sheared, dot(d, normal.deviator), across);
  }
  const T step = quotient(along, select(m.cone, across, T(1)));
  // Share of the other strains where the volume is preserved: dHᵢ = dhᵢ + Σ_{dropped} dh/#kept.
  T positive = T(0), share = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const auto remains = m.h[i] > T(0);
    positive = positive + select(remains, T(1), T(0));
    share = share + select(remains, grad[i], T(0));
  }
  share = share / max(positive, T(1));
  MapAdjoint<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T at_apex = Energy::unilateral_yield && keep ? select(m.h[i] > T(0), grad[i], share) : T(0);
    r.h[i] = select(m.cone, pulled[i] - step * normal[i], select(m.apex, at_apex, grad[i]));
  }
  const T K = cone.template hydrostatic<Energy, D>();
  const T scaled = select(m.cone, T(0) - step * abs(m.p), T(0));
  r.alpha = scaled * (sum(stress.q) - K);
  const T slope_of_K = T((Energy::quadratic ? D * D : D * D * D * D) / 2.0);
  r.ratio = select(K > T(0), T(0) - scaled * cone.alpha * slope_of_K, T(0));
  return r;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
