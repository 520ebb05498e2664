#pragma once

#include <limits>
#include <type_traits>

#include "common/warp.h"
#include "grid/friction.h"

// The velocity of a node that meets several surfaces at once, as in the inner corner of a tank.
//
// The normal velocities that surfaces stop are those of the nearest velocity that all of them allow,
//     minimise |v' − v|²   with  n_i · v' ≥ n_i · s_i (separate)  or  n_i · v' = n_i · s_i (slip),
// found exactly among the sets of surfaces that press. A sticky surface gives the node its own velocity. Coulomb
// friction lowers the velocity along all pressing surfaces, relative to them, by at most Σ μ_i λ_i, where λ_i is the
// normal velocity that surface i stops.

namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class S, int D>
struct Constraint {
  int owner;  // the obstacle, −1 for a wall of the domain
  Contact kind;
  S friction;
  Vector<S, D> normal, velocity;  // unit normal into the material, velocity of the surface
};

// Those of obstacles come first, at least one, at most D, then those of walls.
template <class S, int D>
struct Constraints {
  static constexpr int most = 2 * D;
  int count = 0;
  Constraint<S, D> e[most];
};

// The functions below have the number N of constraints where the compiler knows it, and otherwise 0. With N their loops
// are unrolled, so that a device keeps their arrays in registers.
template <int N, class S, int D>
MPM_HD int number_of(const Constraints<S, D>& c) {
  return N > 0 ? N : c.count;
}

// Solves the system of a positive definite matrix of order n in place; false where it is nearly singular.
template <int N, class S, int M>
MPM_HD bool solve_definite(S (&g)[M][M], S (&x)[M], int n) {
  constexpr double least = 1e-3;  // of the square of the sine between unit vectors
  MPM_LOOP_OF(N) for (int k = 0; k < n; k++) {
    if (!(g[k][k] > S(least))) return false;
    MPM_LOOP_OF(N) for (int i = k + 1; i < n; i++) {
      const S factor = g[i][k] / g[k][k];
      MPM_LOOP_OF(N) for (int j = k; j < n; j++) g[i][j] = g[i][j] - factor * g[k][j];
      x[i] = x[i] - factor * x[k];
    }
  }
  MPM_LOOP_OF(N) for (int k = n - 1; k >= 0; k--) {
    MPM_LOOP_OF(N) for (int j = k + 1; j < n; j++) x[k] = x[k] - g[k][j] * x[j];
    x[k] = x[k] / g[k][k];
  }
  return true;
}

// x with G_A x = b for the Gram matrix G of the normals of a set A; the entries of others are zero.
template <int N, class S, int D>
MPM_HD bool solve_normals(const Constraints<S, D>& c, unsigned set, S (&b)[Constraints<S, D>::most]) {
  constexpr int most = Constraints<S, D>::most;
  const int count = number_of<N>(c);
  S gram[most][most];
  int members = 0;
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
    const bool has_i = set >> i & 1;
    members += has_i;
    if (!has_i) b[i] = S(0);
    MPM_LOOP_OF(N)
    for (int j = 0; j < count; j++)
      gram[i][j] = has_i && (set >> j & 1) ? dot(c.e[i].normal, c.e[j].normal) : S(i == j ? 1 : 0);
  }
  return members <= D && solve_definite<N, S, most>(gram, b, count);
}

// What each surface stops of a velocity v, λ, and the set of those that are met exactly. Of all sets that with the
// least violation counts: zero, but for rounding or where normals are nearly dependent. The search begins with the
// surfaces that v runs into, which are the set in most cases.
template <int N, class S, int D>
MPM_HD unsigned stopped_velocities(const Constraints<S, D>& c, const Vector<S, D>& v,
                                   S (&lambda)[Constraints<S, D>::most]) {
  using T = ValueOf<S>;
  const int count = number_of<N>(c);
  constexpr T unmet = std::numeric_limits<T>::min();  // an equality counts as unmet where it is not in the set
  T least = std::numeric_limits<T>::max();
  unsigned best = 0, first = 0;
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
    lambda[i] = S(0);
    const T approach = value_of(dot(c.e[i].normal, c.e[i].velocity + S(-1) * v));
    first |= unsigned(c.e[i].kind != Contact::separate || approach > T(0)) << i;
  }
  MPM_LOOP for (unsigned other = 0; other < 1u << count && least > T(0); other++) {
    const unsigned set = first ^ other;
    S trial[Constraints<S, D>::most];
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) trial[i] = dot(c.e[i].normal, c.e[i].velocity + S(-1) * v);
    if (!solve_normals<N, S, D>(c, set, trial)) continue;
    Vector<S, D> after = v;
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) after = after + trial[i] * c.e[i].normal;
    T violation = T(0);
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
      const bool one_sided = c.e[i].kind == Contact::separate, met = set >> i & 1;
      const T missing = value_of(dot(c.e[i].normal, c.e[i].velocity + S(-1) * after));
      const T own = met ? (one_sided ? T(0) - value_of(trial[i]) : T(0)) : one_sided ? missing : abs(missing) + unmet;
      if (own > violation) violation = own;
    }
    if (!(violation < least)) continue;
    least = violation;
    best = set;
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) lambda[i] = trial[i];
  }
  return best;
}

// Friction of a velocity v along the surfaces of a set that stop λ: surface i changes v by −(limit_i / size)
// tangential.
template <class S, int D>
struct Rubbing {
  bool acts = false;                                          // otherwise limits and tangential are zero
  bool sticks = false;                                        // whether it takes all of the tangential velocity
  S limit[Constraints<S, D>::most], sum = S(0), size = S(1);  // size: that of the velocity, or the sum if it sticks
  Vector<S, D> surface = zero_vector<S, D>();                 // their mean velocity by limits
  Vector<S, D> tangential = zero_vector<S, D>();              // of v relative to it
};

template <int N, class S, int D>
MPM_HD Rubbing<S, D> rubbing(const Constraints<S, D>& c, unsigned set, const S (&lambda)[Constraints<S, D>::most],
                             const Vector<S, D>& v) {
  const int count = number_of<N>(c);
  Rubbing<S, D> r;
  bool rubs = false;
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
    r.limit[i] = S(0);
    if (!(lambda[i] > S(0)) || !has_friction(c.e[i].friction)) continue;
    rubs = true;
    r.limit[i] = c.e[i].friction * lambda[i];
    r.sum = r.sum + r.limit[i];
    r.surface = r.surface + r.limit[i] * c.e[i].velocity;
  }
  if (!rubs) return r;
  if (r.sum > S(0)) {
    r.surface = (S(1) / r.sum) * r.surface;
  } else {  // a coefficient of zero whose derivative is wanted
    r.surface = zero_vector<S, D>();
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
      if (lambda[i] > S(0) && has_friction(c.e[i].friction)) r.surface = c.e[i].velocity;
    }
  }
  const Vector<S, D> u = v + S(-1) * r.surface;
  S normal[Constraints<S, D>::most];
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) normal[i] = dot(c.e[i].normal, u);
  if (!solve_normals<N, S, D>(c, set, normal)) return r;
  Vector<S, D> tangential = u;
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) tangential = tangential + (S(0) - normal[i]) * c.e[i].normal;
  const S squared = dot(tangential, tangential);
  if (!(squared > S(0))) return r;
  r.acts = true;
  r.tangential = tangential;
  r.size = sqrt(squared);
  r.sticks = !(r.sum < r.size);
  if (r.sticks) r.size = r.sum;
  return r;
}

// Changes of a velocity v by surfaces that are not sticky.
template <int N, class S, int D>
struct ChangesOfSeveral {
  static constexpr int most = Constraints<S, D>::most;
  const Constraints<S, D>& c;
  S lambda[most];
  unsigned set;
  Rubbing<S, D> friction;

  MPM_HD ChangesOfSeveral(const Constraints<S, D>& c, const Vector<S, D>& v) : c(c) {
    set = stopped_velocities<N>(c, v, lambda);
    Vector<S, D> after = v;
    MPM_LOOP_OF(N) for (int i = 0; i < number_of<N>(c); i++) after = after + lambda[i] * c.e[i].normal;
    friction = rubbing<N>(c, set, lambda, after);
  }

  MPM_HD void changes(Vector<S, D> (&change)[most]) const {
    MPM_LOOP_OF(N) for (int i = 0; i < number_of<N>(c); i++) {
      change[i] = lambda[i] * c.e[i].normal;
      if (friction.acts) change[i] = change[i] + (S(0) - friction.limit[i] / friction.size) * friction.tangential;
    }
  }

  // Derivatives of the changes by the velocity, along an axis, of the surfaces that are the bits of `moved`. Which
  // surfaces press, and whether they stick, does not change.
  MPM_HD void slopes(unsigned moved, int axis, Vector<S, D> (&slope)[most]) const {
    const int count = number_of<N>(c);
    S stopped[most];  // dλ
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) stopped[i] = moved >> i & 1 ? component(c.e[i].normal, axis) : S(0);
    solve_normals<N, S, D>(c, set, stopped);
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) slope[i] = stopped[i] * c.e[i].normal;
    if (friction.acts) add_slopes_of_friction(moved, axis, stopped, slope);
  }

 private:
  MPM_HD static S component(const Vector<S, D>& v, int axis) {
    S own = S(0);
    MPM_UNROLL for (int i = 0; i < D; i++)
      own = i == axis ? v[i] : own;
    return own;
  }

  MPM_HD void add_slopes_of_friction(unsigned moved, int axis, const S (&stopped)[most],
                                     Vector<S, D> (&slope)[most]) const {
    const int count = number_of<N>(c);
    const Rubbing<S, D>& r = friction;
    S limit[most], sum = S(0);                   // their derivatives, as the next ones
    Vector<S, D> surface = zero_vector<S, D>();  // times the sum
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
      limit[i] = lambda[i] > S(0) ? c.e[i].friction * stopped[i] : S(0);
      sum = sum + limit[i];
      surface = surface + limit[i] * (c.e[i].velocity + S(-1) * r.surface);
      MPM_UNROLL for (int j = 0; j < D; j++)
        if (j == axis && (moved >> i & 1)) surface[j] = surface[j] + r.limit[i];
    }
    // The velocity after the normal changes, which are along the normals, has no part in that of the tangential one.
    S normal[most];
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) normal[i] = dot(c.e[i].normal, surface);
    solve_normals<N, S, D>(c, set, normal);
    Vector<S, D> tangential = S(-1) * surface;
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) tangential = tangential + normal[i] * c.e[i].normal;
    tangential = (S(1) / r.sum) * tangential;
    const S size = r.sticks ? sum : dot(r.tangential, tangential) / r.size;
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
      const S share = r.limit[i] / r.size, own = (limit[i] - share * size) / r.size;
      slope[i] = slope[i] + (S(0) - own) * r.tangential + (S(0) - share) * tangential;
    }
  }
};

// Calls f(number), the number as an integral constant where there are functions for it, and else 0.
template <class S, int D, class F>
MPM_HD void with_number(const Constraints<S, D>& c, const F& f) {
  if constexpr (sizeof(S) <= sizeof(double)) {  // Instances for dual numbers of doubles would be long.
    if (c.count == 2) return f(std::integral_constant<int, 2>());
    if (c.count == 3) return f(std::integral_constant<int, 3>());
  }
  f(std::integral_constant<int, 0>());
}

// The first sticky surface, or −1.
template <class S, int D>
MPM_HD int sticky_of(const Constraints<S, D>& c) {
  MPM_LOOP for (int i = 0; i < c.count; i++)
    if (c.e[i].kind == Contact::sticky) return i;
  return -1;
}

// Changes of a velocity v by each surface.
template <class S, int D>
MPM_HD void changes_of_constraints(const Constraints<S, D>& c, const Vector<S, D>& v,
                                   Vector<S, D> (&change)[Constraints<S, D>::most]) {
  MPM_LOOP for (int i = 0; i < c.count; i++)
    change[i] = zero_vector<S, D>();
  const int sticky = sticky_of(c);
  if (sticky >= 0) {
    change[sticky] = c.e[sticky].velocity + S(-1) * v;
  } else if (c.count == 1) {
    const Constraint<S, D>& only = c.e[0];
    const Vector<S, D> u = v + S(-1) * only.velocity;
    change[0] = contact_velocity(only.kind, u, only.normal, only.friction) + S(-1) * u;
  } else {
    with_number(c, [&](auto number) { ChangesOfSeveral<decltype(number)::value, S, D>(c, v).changes(change); });
  }
}

// Derivative of a component of the change of a velocity by one surface, by the velocity of that; u is the velocity
// relative to the surface.
template <class T, int D>
MPM_HD Vector<T, D> slope_of_change(Contact kind, const Vector<T, D>& u, const Vector<T, D>& normal, const T& friction,
                                    int component) {
  Vector<T, D> unit;
  MPM_UNROLL for (int i = 0; i < D; i++)
    unit[i] = T(i == component);
  return unit + T(-1) * contact_adjoint(kind, u, normal, friction, unit);
}

// Calls f(axis, slope) with the derivatives of these changes by the velocity, along each axis, of the surfaces that are
// the bits of `moved`.
template <class T, int D, class F>
MPM_HD void slopes_of_constraints(const Constraints<T, D>& c, const Vector<T, D>& v, unsigned moved, const F& f) {
  Vector<T, D> slope[Constraints<T, D>::most];
  MPM_LOOP for (int i = 0; i < c.count; i++)
    slope[i] = zero_vector<T, D>();
  const int sticky = sticky_of(c);
  if (sticky < 0 && c.count > 1) {
    with_number(c, [&](auto number) {
      const ChangesOfSeveral<decltype(number)::value, T, D> changes(c, v);
      MPM_LOOP for (int axis = 0; axis < D; axis++) {
        changes.slopes(moved, axis, slope);
        f(axis, slope);
      }
    });
    return;
  }
  const int only = sticky >= 0 ? sticky : 0;
  if (!(moved >> only & 1)) return;
  const Constraint<T, D>& surface = c.e[only];
  const Vector<T, D> u = v + T(-1) * surface.velocity;
  Matrix<T, D> by_axis;  // the transpose of the rows
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const Vector<T, D> row = slope_of_change(surface.kind, u, surface.normal, surface.friction, i);
    MPM_UNROLL for (int axis = 0; axis < D; axis++)
      by_axis[axis][i] = row[axis];
  }
  MPM_UNROLL for (int axis = 0; axis < D; axis++) {
    MPM_UNROLL for (int i = 0; i < D; i++)
      slope[only][i] = by_axis[axis][i];
    f(axis, slope);
  }
}

// The velocity v after all of them.
template <class S, int D>
MPM_HD Vector<S, D> after_constraints(const Constraints<S, D>& c, const Vector<S, D>& v) {
  Vector<S, D> change[Constraints<S, D>::most], after = v;
  changes_of_constraints<S, D>(c, v, change);
  MPM_LOOP for (int i = 0; i < c.count; i++)
    after = after + change[i];
  return after;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
