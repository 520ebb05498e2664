#pragma once

#include "laws/elasticity.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Modified Cam-Clay with cohesion on Hencky elasticity (Roscoe and Burland 1968; finite strains as Borja and Tamagnini
// 1998; cohesion as Gaume et al. 2018). With the pressure p = −tr τ/D and q = √((6 − D)/2) |dev τ|,
//   q² + M² (p − p_c)(p + β p_c) ≤ 0,   p_c = p₀ exp(−Θ ln J_p),   associated flow.
// On the ellipse p = c + a cos ϑ, q = M a sin ϑ (c and a: (1 ∓ β) p_c/2) the plastic strains have the ratio
// M cos ϑ : sin ϑ, so backward Euler is one equation for the plastic compaction w of the step,
//   A = S with A = M cos ϑ q_trial, S = sin ϑ ((6 − D) μ w + M² a cos ϑ).
struct CamClay : HenckyElasticity {
  static constexpr const char* name = "cam_clay";
  static constexpr std::array parameters = {not_negative("mu", "Pa"),       real("lam", "Pa"),
                                            positive("critical_slope", ""), positive("consolidation", "Pa"),
                                            positive("hardening", ""),      Quantity{"cohesion", "", 0, 1}};
  static constexpr std::array history = {real("log_plastic_volume", "")};
  static constexpr bool plastic = true;

  template <class T, int D>
  MPM_HD static Flow<T> flow(Vector<T, D>& h, const T p[], T q[]) {
    const Deviator<T, D> s = measure_deviator(h);
    const T bulk = p[1] + T(2.0 / D) * p[0];
    const auto stiff = bulk > T(0);
    const T inverse = T(1) / select(stiff, bulk, T(1));
    State<T> c;  // stresses in units of the bulk modulus
    c.pressure = T(-D) * s.mean;
    c.shear = T((6 - D) / (D == 3 ? 1.2247448713915890 : 1.4142135623730951)) * p[0] * inverse * s.norm;
    c.modulus = T(6.0 - D) * p[0] * inverse;
    c.M = p[2];
    c.theta = p[4];
    c.beta = p[5];
    c.exponent = T(0) - p[4] * q[0];
    c.initial = p[3] * inverse;
    const Ellipse<T> trial = ellipse(c, T(0));
    const T outside = c.shear * c.shear + c.M * c.M * trial.size * trial.size * (trial.cosine * trial.cosine - T(1));
    const MaskOf<T> plastic = stiff & (outside > T(0));

    const Compaction<T> w = compaction(c, plastic);
    const Ellipse<T> e = ellipse(c, w.value);
    // sin ϑ where it is not small, and the flow of the deviator where cos ϑ is not.
    const auto steep = abs(e.cosine) > T(0.7);
    const T sine = sqrt(select(steep, T(1), T(1) - e.cosine * e.cosine));
    const T denominator = select(steep, c.M * c.M * e.size * e.cosine, T(1));
    const T flowed = c.shear / (T(1) + c.modulus * w.value / denominator);
    const T radius = select(steep, flowed, c.M * e.size * sine);
    const auto reduced = plastic & (c.shear > T(0));
    const T kappa = select(reduced, min(radius / select(reduced, c.shear, T(1)), T(1)), T(1));
    h = select(plastic, scale_deviator(h, s.mean, s.mean + T(1.0 / D) * w.value, kappa), h);
    q[0] = q[0] - select(plastic, w.value, T(0));
    return {kappa, plastic, w.converged};
  }

 private:
  template <class T>
  struct State {
    T pressure, shear, modulus, M, theta, beta, exponent, initial;
  };

  template <class T>
  struct Ellipse {
    T size, cosine;  // a, cos ϑ of the pressure
  };

  // Yield surface after the compaction w, with ln (p_c/p₀) bounded by ±10: a much softer surface would be lost in the
  // rounding of the trial pressure.
  template <class T>
  MPM_HD static Ellipse<T> ellipse(const State<T>& c, const T& w) {
    const T exponent = min(max(c.exponent + c.theta * w, T(-10)), T(10));
    const T pc = c.initial * exponential(exponent);
    const T size = T(0.5) * (T(1) + c.beta) * pc;
    return {size, (c.pressure - w - T(0.5) * (T(1) - c.beta) * pc) / size};
  }

  template <class T>
  struct Compaction {
    T value;
    MaskOf<T> converged;
  };

  // A² − S², a smooth function of w also where sin ϑ vanishes.
  template <class T>
  MPM_HD static T squared_residual(const State<T>& c, const Ellipse<T>& e, const T& w) {
    const T A = c.M * e.cosine * c.shear, S = c.modulus * w + c.M * c.M * e.size * e.cosine;
    return A * A - (T(1) - e.cosine) * (T(1) + e.cosine) * S * S;
  }

  // A − S, a regular function also at the critical state, where A and S vanish.
  template <class T>
  MPM_HD static T residual(const State<T>& c, const Ellipse<T>& e, const T& w, const MaskOf<T>& regular) {
    const T sine = sqrt(select(regular, T(1) - e.cosine * e.cosine, T(1)));
    return c.M * e.cosine * c.shear - sine * (c.modulus * w + c.M * c.M * e.size * e.cosine);
  }

  template <class V>
  MPM_HD static State<Dual<V>> constant(const State<V>& c) {
    const auto lift = [](const V& a) { return Dual<V>(a, V(0)); };
    return {lift(c.pressure), lift(c.shear), lift(c.modulus),  lift(c.M),
            lift(c.theta),    lift(c.beta),  lift(c.exponent), lift(c.initial)};
  }

  // w lies between 0 and the compaction at which the pressure would reach the centre of the first ellipse: the ellipse
  // moves towards it, so that cos ϑ changes sign before. Newton's method in a bracket; the last step, in T, carries the
  // derivatives of the root.
  template <class T>
  MPM_HD static Compaction<T> compaction(const State<T>& state, const MaskOf<T>& wanted) {
    using V = ValueOf<T>;
    const State<V> c = {value_of(state.pressure), value_of(state.shear),  value_of(state.modulus),
                        value_of(state.M),        value_of(state.theta),  value_of(state.beta),
                        value_of(state.exponent), value_of(state.initial)};
    const State<Dual<V>> dual = constant(c);
    const Ellipse<V> first = ellipse(c, V(0));
    const V side = select(first.cosine < V(0), V(-1), V(1));
    V near = V(0), far = first.cosine * first.size, w = V(0);  // the root lies between near and far
    const V rounding = V(NewtonTolerance<V>::rounding) * (abs(c.pressure) + first.size);
    V active = select(wanted & (abs(far) > V(0)), V(1), V(0));  // until a lane has converged
    for (int k = 0; k < NewtonTolerance<V>::most_steps && any(active > V(0)); k++) {
      const Dual<V> at(w, V(1));
      const Ellipse<Dual<V>> e = ellipse(dual, at);
      const Dual<V> f = squared_residual(dual, e, at);
      const auto before = (side * e.cosine.value > V(0)) & (f.value > V(0));
      near = select(before, w, near);
      far = select(before, far, w);
      const V step = f.value / f.derivative, next = w - step;
      const auto inside = (side * e.cosine.value > V(0)) & (side * next >= side * near) & (side * next <= side * far);
      const V other = V(0.5) * (near + far);
      const V move = abs(select(inside, next, other) - w);
      w = select(active > V(0), select(inside, next, other), w);
      active = select(move > V(NewtonTolerance<V>::value) * abs(w) + rounding, active, V(0));
    }

    const Dual<V> at(w, V(1));
    const Ellipse<Dual<V>> slopes = ellipse(dual, at);
    const auto regular = abs(slopes.cosine.value) < V(0.7);
    const V slope =
        select(regular, residual(dual, slopes, at, regular).derivative, squared_residual(dual, slopes, at).derivative);
    const T root = lift<T>(w);
    const Ellipse<T> e = ellipse(state, root);
    const T rest = select(regular, residual(state, e, root, regular), squared_residual(state, e, root));
    const auto moves = wanted & (abs(slope) > V(0));
    return {select(moves, root - rest / lift<T>(select(moves, slope, V(1))), root), active <= V(0)};
  }
};

MPM_REGISTER_LAW(CamClay)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
