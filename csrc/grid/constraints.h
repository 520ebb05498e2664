#pragma once

#include <limits>

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

// Adds the change of a velocity v by friction along the surfaces of a set that stop λ, in parts by surface.
template <int N, class S, int D>
MPM_HD void add_friction(const Constraints<S, D>& c, unsigned set, const S (&lambda)[Constraints<S, D>::most],
                         const Vector<S, D>& v, Vector<S, D> (&change)[Constraints<S, D>::most]) {
  const int count = number_of<N>(c);
  S limit[Constraints<S, D>::most], sum = S(0);
  Vector<S, D> surface = zero_vector<S, D>();
  bool rubs = false;
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
    limit[i] = S(0);
    if (!(lambda[i] > S(0)) || !has_friction(c.e[i].friction)) continue;
    rubs = true;
    limit[i] = c.e[i].friction * lambda[i];
    sum = sum + limit[i];
    surface = surface + limit[i] * c.e[i].velocity;
  }
  if (!rubs) return;
  if (sum > S(0)) {
    surface = (S(1) / sum) * surface;
  } else {  // a coefficient of zero whose derivative is wanted
    surface = zero_vector<S, D>();
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
      if (lambda[i] > S(0) && has_friction(c.e[i].friction)) surface = c.e[i].velocity;
    }
  }
  const Vector<S, D> u = v + S(-1) * surface;
  S normal[Constraints<S, D>::most];
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) normal[i] = dot(c.e[i].normal, u);
  if (!solve_normals<N, S, D>(c, set, normal)) return;
  Vector<S, D> tangential = u;
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) tangential = tangential + (S(0) - normal[i]) * c.e[i].normal;
  const S squared = dot(tangential, tangential);
  if (!(squared > S(0))) return;
  const S speed = sqrt(squared);
  if (!(sum < speed)) {
    MPM_LOOP_OF(N) for (int i = 0; i < count; i++) change[i] = change[i] + (S(0) - limit[i] / sum) * tangential;
    return;
  }
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) change[i] = change[i] + (S(0) - limit[i] / speed) * tangential;
}

// Changes of a velocity v by surfaces that are not sticky.
template <int N, class S, int D>
MPM_HD void changes_of_several(const Constraints<S, D>& c, const Vector<S, D>& v,
                               Vector<S, D> (&change)[Constraints<S, D>::most]) {
  const int count = number_of<N>(c);
  S lambda[Constraints<S, D>::most];
  const unsigned set = stopped_velocities<N>(c, v, lambda);
  Vector<S, D> after = v;
  MPM_LOOP_OF(N) for (int i = 0; i < count; i++) {
    change[i] = lambda[i] * c.e[i].normal;
    after = after + change[i];
  }
  add_friction<N>(c, set, lambda, after, change);
}

// Changes of a velocity v by each surface.
template <class S, int D>
MPM_HD void changes_of_constraints(const Constraints<S, D>& c, const Vector<S, D>& v,
                                   Vector<S, D> (&change)[Constraints<S, D>::most]) {
  MPM_LOOP for (int i = 0; i < c.count; i++)
    change[i] = zero_vector<S, D>();
  MPM_LOOP for (int i = 0; i < c.count; i++) {
    if (c.e[i].kind != Contact::sticky) continue;
    change[i] = c.e[i].velocity + S(-1) * v;
    return;
  }
  if (c.count == 1) {
    const Constraint<S, D>& only = c.e[0];
    const Vector<S, D> u = v + S(-1) * only.velocity;
    change[0] = contact_velocity(only.kind, u, only.normal, only.friction) + S(-1) * u;
    return;
  }
  if constexpr (sizeof(S) <= sizeof(double)) {  // Instances for dual numbers of doubles would be long.
    if (c.count == 2) return changes_of_several<2>(c, v, change);
    if (c.count == 3) return changes_of_several<3>(c, v, change);
  }
  changes_of_several<0>(c, v, change);
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
