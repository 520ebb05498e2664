#pragma once

#include <cmath>

#include "common/elementary.h"
#include "common/fields.h"
#include "grid/topology.h"

// The iteration of the implicit heat step (M/dt + H + X) d = h − (H + X) θ: operations at a node and decisions for a
// scene. The loops of both backends go over nodes, sum over scenes and apply H.
//
// Both methods move along p: d += α p, r −= α A p, p = γ z + β p with z = inverse · r. Conjugate gradients divide by
// the exact diagonal; Chebyshev iteration (Saad 2003, algorithm 12.1) divides by M/dt + X, where the spectrum lies
// between 1 and 1 + c, c the largest K_i / (M_i/dt + X_i), and needs no scalar products.
namespace mpm {

enum class HeatMethod { conjugate_gradients, chebyshev };

// Residual [K] that a solve may always leave, NEGLIGIBLE in torch_mpm/heat/heat.py.
constexpr double kNegligibleResidual = 1e-12;

constexpr int kMostSimpleSteps = 3;

// Sums of a node with w = N m C: w, w β, w θ and w β θ. The last two become the increment of θ and the average θ̄.
enum HeatChannel : int { kHeatCapacity, kHeatVarying, kHeatTheta, kHeatMean, kHeatChannels };

template <class T, int D>
struct HeatArguments {
  Topology<T, D> topology;
  int near_blocks = 0;               // slots that a solve considers, zero for all: on CUDA those in the order of
                                     // scenes, before those without particles; on the CPU those with a block
  const bool* matter = nullptr;      // [slots] on the CPU, whether particles are transferred to the slot; may be absent
  Field<const T> x, conductance;     // conductance κ V [P]
  const T* heat_capacity = nullptr;  // [N], as those below
  const T* theta = nullptr;          // absent: zero
  const T* sums = nullptr;           // on CUDA, in place of these two: [N, kHeatChannels] before any change
  const T* source = nullptr;         // of node i at source + i * source_stride, which is 1 on the CPU; absent: zero
  int source_stride = 1;
  const T* exchange = nullptr;         // absent: zero
  const bool* fixed = nullptr;         // absent: none
  double dt = 0;                       // times scene_dt where given
  const T* scene_dt = nullptr;         // [scenes]
  double tolerance = 0;                // replaced by scene_tolerance where given
  const T* scene_tolerance = nullptr;  // [scenes]
  double relative_tolerance = 0;       // of the first residual
  int most = 0;                        // maximum number of iterations, replaced by scene_most where given
  const int* scene_most = nullptr;     // [scenes]
  HeatMethod method = HeatMethod::conjugate_gradients;
  const double* scene_bound = nullptr;  // [scenes], of the spectrum of H in units of M/dt + X where it is known, but
  double bound_scale = 1;               // for this factor
  bool deterministic = false;
  bool leaves_simple = false;  // whether other kernels solve the scenes of simple_steps(); their results are unchanged
  T* increment = nullptr;      // [N]
  int* iterations = nullptr;   // [scenes], as those below
  T* residual = nullptr;
  bool* converged = nullptr;
  void* workspace = nullptr;  // bytes returned by heat_workspace()
};

// Products H u of the simple steps, from particles that may have left their base blocks, but where sums have an order;
// on CUDA by kernels without barriers of the grid.
template <class T, int D>
struct HeatSimpleArguments {
  HeatArguments<T, D> solve;       // its increments are those of the other scenes
  T* product[kMostSimpleSteps]{};  // [N] H θ, and H (M/dt + X)⁻¹ r after each step but the last; zero on entry on CUDA,
                                   // and without θ the first one
  int step = 0;                    // number of the product
  void* workspace = nullptr;       // on CUDA, of the packed particles of all scenes; absent: that of the solve, with
                                   // those of the scenes of these steps
  bool packed = false;             // whether the particles are packed already
};

// H u, or the diagonal of H where u is absent.
template <class T, int D>
struct HeatOperatorArguments {
  Topology<T, D> topology;
  Field<const T> x, conductance;
  const T* nodes = nullptr;  // u [N]
  bool deterministic = false;
  T* sum = nullptr;           // [N], zero on entry
  void* workspace = nullptr;  // bytes returned by heat_operator_workspace()
};

// Work space of a solve, [N] each.
template <class T>
struct HeatVectors {
  T* mass;     // M, 0 on nodes that are not unknowns
  T* weight;   // M/dt + X; K before the start
  T* inverse;  // of the diagonal, see above; H_ii before the start
  T* r;
  T* p;
  T* product;  // H p, zero between the iterations; H θ before the start
};

// The larger one of two numbers; NaN where one of them is NaN.
template <class V>
MPM_HD V larger_or_nan(const V& a, const V& b) {
  return a == a && !(b <= a) ? b : a;
}

// Sums over nodes after a step.
template <class V>
struct StepSums {
  V heat;            // Σ M d, or Σ M at the start
  V residual;        // Σ r²/M
  V preconditioned;  // Σ r z

  MPM_HD static StepSums zero() { return {}; }
  template <class U>
  MPM_HD void add(const StepSums<U>& o) {
    heat += o.heat;
    residual += o.residual;
    preconditioned += o.preconditioned;
  }
};

// And at the start.
template <class V>
struct StartSums : StepSums<V> {
  V source;  // Σ h
  V open;    // nodes through which heat leaves
  V bound;   // largest K / (M/dt + X)
  V spread;  // largest (M/dt + X) / (M/dt)

  MPM_HD static StartSums zero() { return {}; }
  template <class U>
  MPM_HD void add(const StartSums<U>& o) {
    StepSums<V>::add(o);
    source += o.source;
    open += o.open;
    bound = larger_or_nan(bound, V(o.bound));
    spread = larger_or_nan(spread, V(o.spread));
  }
};

struct HeatScene {
  double dt, mass, source, heat, tolerance, residual, preconditioned, bound, spread, rho;
  double alpha, beta, gamma;
  int iterations, most;
  int simple;  // steps of simple_steps()
  bool running, closed, converged;
};

inline namespace TORCH_MPM_ISA {

template <class T, int D>
MPM_HD int near_blocks(const HeatArguments<T, D>& a) {
  return a.near_blocks > 0 ? a.near_blocks : a.topology.max_blocks;
}

template <class T, int D>
MPM_HD double step_of_scene(const HeatArguments<T, D>& a, int scene) {
  return a.scene_dt ? a.dt * double(a.scene_dt[scene]) : a.dt;
}

// The simple steps d += ω_k (M/dt + X)⁻¹ r. The spectrum of (M/dt + X)⁻¹ A is that of 1 + λ, 0 ≤ λ ≤ c. The first step
// has ω = 1: it leaves no residual where λ = 0, so the energy is conserved, and multiplies the residual by −λ. Each
// further step multiplies it by (μ − λ)/(1 + μ), where ω = 1/(1 + μ). The product of n steps is least on [0, c] where 0
// and the μ are the roots of a Chebyshev polynomial, shifted and scaled: the first root cos(π (2 k + 1)/(2 n)) to 0,
// the end of its interval to c. Half of that interval is h = c / (1 + cos(π/(2 n))), and the product is at most hⁿ 2^(1
// − n).
MPM_HD double simple_reduction(int steps, double c) {
  return steps == 1 ? c : steps == 2 ? 0.1715728752538099 * c * c : 0.038475772933681186 * c * c * c;
}

// ω of step k; μ = h (cos(π/(2 n)) − root) is a share of c. The order of the steps after the first one does not matter.
template <class T>
MPM_HD T simple_weight(int steps, int k, const T& c) {
  const double share = k == 0 ? 0 : steps == 2 ? 0.8284271247461901 : k == 1 ? 0.9282032302755092 : 0.46410161513775455;
  return T(1) / (T(1) + T(share) * c);
}

// Those for a bound c and a tolerance of the residual.
MPM_HD int simple_steps_of(double c, double tolerance) {
  for (int steps = 1; steps <= kMostSimpleSteps; steps++)
    if (simple_reduction(steps, c) <= tolerance) return steps;
  return 0;
}

template <class T, int D>
MPM_HD double bound_of_scene(const HeatArguments<T, D>& a, int scene) {
  return a.bound_scale * a.scene_bound[scene];
}

// Number of simple steps that a known bound c of the spectrum shows to suffice; zero where it is unknown or too large.
// Such scenes need no diagonal and no scalar products.
template <class T, int D>
MPM_HD int simple_steps(const HeatArguments<T, D>& a, int scene) {
  if (!a.scene_bound || scene < 0 || a.method != HeatMethod::conjugate_gradients) return 0;
  return simple_steps_of(bound_of_scene(a, scene), a.relative_tolerance);
}

// Whether the next step is the last one of them: it needs neither H p nor the residual.
MPM_HD bool is_last_simple_step(const HeatScene& s) {
  return s.running && s.simple > 0 && s.iterations + 1 >= s.simple;
}

// After it. These steps conserve the energy.
template <class T, int D>
MPM_HD void finish_simple_steps(const HeatArguments<T, D>& a, int scene, HeatScene& s) {
  s.residual *= simple_reduction(s.simple, bound_of_scene(a, scene));
  s.iterations = s.simple;
  s.heat = s.dt * s.source;
  s.converged = true;
  s.running = false;
}

template <class T>
MPM_HD T mean_of(const T& sum, const T& weight) {
  const auto weighs = weight > T(0);
  return select(weighs, sum / select(weighs, weight, T(1)), T(0));
}

template <class T, int D>
MPM_HD T capacity_at(const HeatArguments<T, D>& a, int64_t row) {
  return a.sums ? a.sums[row * kHeatChannels + kHeatCapacity] : a.heat_capacity[row];
}

template <class T, int D>
MPM_HD bool has_theta(const HeatArguments<T, D>& a) {
  return a.sums || a.theta;
}
template <class T, int D>
MPM_HD T theta_at(const HeatArguments<T, D>& a, int64_t row) {
  if (a.theta) return a.theta[row];
  return mean_of(a.sums[row * kHeatChannels + kHeatTheta], capacity_at(a, row));
}

// What the equation of a node reads.
template <class T>
struct NodeInputs {
  T capacity, exchange, source, theta;  // zero where absent
  bool fixed;
};

template <class T, int D>
MPM_HD NodeInputs<T> node_inputs(const HeatArguments<T, D>& a, int64_t row) {
  return {capacity_at(a, row), a.exchange ? a.exchange[row] : T(0), a.source ? a.source[row * a.source_stride] : T(0),
          a.exchange && has_theta(a) ? theta_at(a, row) : T(0), a.fixed && a.fixed[row]};
}

// The equation of a node at the start, where `product` is H θ. Nodes that are not free have no weight and no residual.
template <class T>
struct NodeEquation {
  bool free, open;  // whether the node is an unknown, and whether heat leaves through it
  T mass, source, weight, residual;
};

template <class T>
MPM_HD NodeEquation<T> node_equation(const NodeInputs<T>& in, const T& product, double dt) {
  const bool material = !(in.capacity <= T(0)), held = material && in.fixed, free = material && !held;
  NodeEquation<T> e{free, held || (free && in.exchange != T(0)), in.capacity, in.source, T(0), T(0)};
  if (!free) return e;
  e.weight = in.capacity / T(dt) + in.exchange;
  e.residual = in.source - product - in.exchange * in.theta;
  return e;
}

// Starts node i of the vectors, which lies in `row`, for zero increment. `used` is false for rows of unused blocks.
template <class T, int D>
MPM_HD StartSums<T> start_node(const HeatArguments<T, D>& a, const HeatVectors<T>& v, int64_t row, int64_t i, double dt,
                               bool used) {
  auto sums = StartSums<T>::zero();
  const T product = v.product[i], diagonal = v.inverse[i], bound = v.weight[i];
  v.p[i] = v.product[i] = v.mass[i] = v.weight[i] = v.inverse[i] = v.r[i] = T(0);
  if (!used) return sums;
  const NodeEquation<T> e = node_equation(node_inputs(a, row), product, dt);
  sums.open = e.open;
  if (!e.free) return sums;
  const T inverse = T(1) / (a.method == HeatMethod::chebyshev ? e.weight : e.weight + diagonal);
  v.mass[i] = e.mass;
  v.weight[i] = e.weight;
  v.inverse[i] = inverse;
  v.r[i] = e.residual;
  sums.heat = e.mass;
  sums.residual = e.residual * (e.residual / e.mass);
  sums.preconditioned = e.residual * (e.residual * inverse);
  sums.source = e.source;
  sums.bound = bound / e.weight;
  sums.spread = T(dt) * (e.weight / e.mass);
  return sums;
}

// The residual of a node before step k of the simple steps of a scene, and the increment so far.
template <class T>
struct SimpleNode {
  T residual, increment, weight;  // M/dt + X, zero where the node is not free
};

// k of the simple steps at free nodes, where product(j + 1) is H (M/dt + X)⁻¹ r after step j. P is T or a pack.
template <class T, class P, class F>
MPM_HD void take_simple_steps(SimpleNode<P>& n, int steps, int k, double c, const F& product) {
  for (int j = 0; j < k; j++) {
    const P omega(simple_weight(steps, j, T(c)));
    n.increment += omega * (n.residual / n.weight);
    if (j + 1 < steps) n.residual = (P(1) - omega) * n.residual - omega * product(j + 1);
  }
}

// The same for a node, where product(0) is H θ.
template <class T, class F>
MPM_HD SimpleNode<T> simple_node(const NodeInputs<T>& in, int steps, int k, double c, double dt, const F& product) {
  const NodeEquation<T> e = node_equation(in, product(0), dt);
  SimpleNode<T> n{e.residual, T(0), e.weight};
  if (e.free) take_simple_steps<T>(n, steps, k, c, product);
  return n;
}
template <class T, int D>
MPM_HD SimpleNode<T> simple_node(const HeatSimpleArguments<T, D>& a, int64_t row, int steps, int k, double c,
                                 double dt) {
  return simple_node(node_inputs(a.solve, row), steps, k, c, dt, [&](int j) { return a.product[j][row]; });
}

// The values u of a product H u of the simple steps, after the first one.
template <class T>
MPM_HD T simple_direction(const SimpleNode<T>& n) {
  return n.weight == T(0) ? T(0) : n.residual / n.weight;
}
template <class T, int D>
MPM_HD T simple_direction(const HeatSimpleArguments<T, D>& a, int64_t row, int steps, double c, double dt) {
  if (a.step == 0) return theta_at(a.solve, row);
  return simple_direction(simple_node(a, row, steps, a.step - 1, c, dt));
}

// The increment of a node after these steps.
template <class T, int D>
MPM_HD T simple_increment(const HeatSimpleArguments<T, D>& a, int64_t row, int steps, double c, double dt) {
  return simple_node(a, row, steps, steps, c, dt).increment;
}

// Next direction; returns the part of p · A p without H.
template <class T>
MPM_HD T direct_node(const HeatVectors<T>& v, int64_t i, T beta, T gamma) {
  T p = gamma * (v.inverse[i] * v.r[i]);
  if (beta != T(0)) p += beta * v.p[i];
  v.p[i] = p;
  return v.weight[i] * p * p;
}

// A step along the direction.
template <class T>
MPM_HD StepSums<T> update_node(const HeatVectors<T>& v, T* increment, int64_t i, T alpha) {
  const T mass = v.mass[i], p = v.p[i], product = v.product[i] + v.weight[i] * p;
  v.product[i] = T(0);
  auto sums = StepSums<T>::zero();
  if (mass == T(0)) return sums;
  const T d = increment[i] + alpha * p, r = v.r[i] - alpha * product;
  increment[i] = d;
  v.r[i] = r;
  sums.heat = mass * d;
  sums.residual = r * (r / mass);
  sums.preconditioned = r * (r * v.inverse[i]);
  return sums;
}

// dt std::sqrt(Σ r²/M / Σ M), which bounds the mass-weighted RMS error [K].
MPM_HD double residual_in_kelvin(const HeatScene& s, double residual) {
  return s.mass == 0 ? 0 : s.dt * std::sqrt(residual / s.mass);
}

MPM_HD void direct_chebyshev(HeatScene& s) {
  const double center = 1 + s.bound / 2, half = s.bound / 2;
  if (s.iterations == 0) {
    s.rho = half / center;
    s.beta = 0;
    s.gamma = 1 / center;
  } else {
    const double gamma = 2 / (2 * center - s.rho * half), rho = gamma * half / 2;
    s.beta = rho * s.rho;
    s.gamma = gamma;
    s.rho = rho;
  }
}

// Number of iterations after which the Chebyshev polynomial has reduced the residual below the tolerance.
MPM_HD int chebyshev_count(const HeatScene& s) {
  const double reduction =
      s.residual / s.tolerance * std::sqrt(s.spread);  // the norm of the polynomial has the weights M/dt + X
  const double count = std::ceil(std::acosh(reduction) / std::acosh(1 + 2 / s.bound));
  return count >= s.most ? s.most : count > 1 ? int(count) : 1;
}

template <class T, int D>
MPM_HD HeatScene start_scene(const HeatArguments<T, D>& a, int scene, const StartSums<double>& sums) {
  HeatScene s{};
  s.dt = step_of_scene(a, scene);
  s.mass = sums.heat;
  s.source = sums.source;
  s.preconditioned = sums.preconditioned;
  s.bound = sums.bound;
  s.spread = sums.spread;
  s.closed = sums.open == 0;
  const bool valid = s.dt > 0;
  s.residual = valid ? residual_in_kelvin(s, sums.residual) : std::nan("");
  const double tolerance = a.scene_tolerance ? double(a.scene_tolerance[scene]) : a.tolerance;
  const double relative = a.relative_tolerance * s.residual;
  s.tolerance = relative > tolerance ? relative : tolerance;
  s.most = a.scene_most ? a.scene_most[scene] : a.most;
  s.running = s.residual > s.tolerance && s.residual < HUGE_VAL && s.most > 0;
  s.converged = s.residual <= s.tolerance;
  s.alpha = s.gamma = 1;
  s.simple = simple_steps(a, scene);
  if (a.method == HeatMethod::chebyshev && s.running) {
    s.most = chebyshev_count(s);
    direct_chebyshev(s);
  }
  return s;
}

// Step length of conjugate gradients. Without curvature no decrease remains, or the matrix is not positive.
MPM_HD void set_step(HeatScene& s, double curvature) {
  s.running = curvature > 0;
  s.alpha = s.running ? s.preconditioned / curvature : 0;
}

// Whether the sums after an iteration are needed.
MPM_HD bool wants_sums(const HeatScene& s, HeatMethod method) {
  return s.simple == 0 && (method != HeatMethod::chebyshev || s.iterations + 1 >= s.most);
}

template <class T, int D>
MPM_HD void finish_iteration(const HeatArguments<T, D>& a, int scene, HeatScene& s, const StepSums<double>& sums) {
  const bool known = wants_sums(s, a.method);
  s.iterations++;
  if (known) {
    s.residual = residual_in_kelvin(s, sums.residual);
    s.heat = sums.heat;
    s.converged = s.residual <= s.tolerance;
    s.running = s.residual > s.tolerance && s.iterations < s.most;
  }
  if (s.simple > 0) {
    s.alpha = simple_weight(s.simple, s.iterations, bound_of_scene(a, scene));
    return;
  }
  if (a.method == HeatMethod::chebyshev) return direct_chebyshev(s);
  s.beta = sums.preconditioned / s.preconditioned;
  s.preconditioned = sums.preconditioned;
}

// A closed scene conserves its energy, Σ M d = dt Σ h, for any remaining residual.
MPM_HD double energy_shift(const HeatScene& s) {
  return s.closed && s.iterations > 0 ? (s.dt * s.source - s.heat) / s.mass : 0;
}

template <class T, int D>
MPM_HD void report_scene(const HeatArguments<T, D>& a, int scene, const HeatScene& s) {
  a.iterations[scene] = s.iterations;
  a.residual[scene] = T(s.residual);
  a.converged[scene] = s.converged;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
