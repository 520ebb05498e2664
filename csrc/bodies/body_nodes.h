#pragma once

#include "bodies/free_body.h"
#include "grid/contact.h"

// Nodes in contact with free bodies: the impulses that they give by the velocities of the surfaces, and the
// derivatives. The surfaces that a node meets do not depend on velocities, so they are found once in a step. Most nodes
// meet one surface alone (`LoneNode`), and take few numbers and no calls; the others are `BodyNode`s.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// A node that meets the surface of one obstacle, within the walls.
template <class T, int D>
struct LoneNode {
  int node, obstacle;      // row of the node tensors
  Vector<int, D> lattice;  // its place
  Vector<T, D> normal;     // unit, into the material
  T mass;
  Vector<T, D> velocity;  // before contact
};

template <class T, int D>
struct BodyNode {
  int node = 0;            // row of the node tensors
  Vector<int, D> lattice;  // its place, where impulses act
  Vector<T, D> position;   // the same within the walls, where velocities of surfaces are read
  MetSurfaces<T, D> met;   // faces of obstacles come first, at most D
};

// Without the places of surfaces that it does not have.
template <class T, int D>
MPM_HD void copy_node(const BodyNode<T, D>& from, BodyNode<T, D>& to) {
  to.node = from.node, to.lattice = from.lattice, to.position = from.position;
  to.met.any = from.met.any, to.met.sign = from.met.sign;
  to.met.constraints.count = from.met.constraints.count;
  MPM_LOOP for (int i = 0; i < from.met.constraints.count; i++)
    to.met.constraints.e[i] = from.met.constraints.e[i];
}

// The bodies that a node meets, at most D, and their numbers by surface. The faces of a body have one velocity at a
// node, so they count together. What walls give beside obstacles counts as that of the first face.
struct MetBodies {
  static_assert(kMaxObstacles <= 256);
  int count = 0;
  unsigned bodies = 0;   // eight bits each
  unsigned numbers = 0;  // two bits each

  MPM_HD int operator[](int number) const { return int(bodies >> 8 * number & 255); }
  MPM_HD int number_of(int surface) const { return int(numbers >> 2 * surface & 3); }
  MPM_HD void add(int surface, int body) {
    int number = 0;
    MPM_LOOP while (number < count && (*this)[number] != body)
      number++;
    if (number == count) bodies |= unsigned(body) << 8 * count++;
    numbers |= unsigned(number) << 2 * surface;
  }
};

// Derivatives of the impulses of a node on each body by the velocity of one of them.
template <class T, int D>
struct ImpulseSlopes {
  Matrix<T, D> of[D];
};

template <class T, int D>
MPM_HD Vector<double, D> as_double(const Vector<T, D>& v) {
  Vector<double, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = double(v[i]);
  return r;
}

template <class T, int D>
MPM_HD Vector<double, D> place_of(const ContactArguments<T, D>& a, const Vector<int, D>& lattice) {
  Vector<double, D> x;
  MPM_UNROLL for (int i = 0; i < D; i++)
    x[i] = a.lower[i] + double(lattice[i] - kPadding) * a.dx;
  return x;
}

// ---- nodes that meet one surface

// Of a lone node at the present velocities of the obstacles.
template <class T, int D>
struct LoneContact {
  const LoneNode<T, D>& node;
  const ObstaclePose<T, D>& pose;
  Vector<double, D> at;  // where impulses act [m]
  Vector<T, D> u;        // velocity relative to the surface

  MPM_HD LoneContact(const ContactArguments<T, D>& a, const ObstaclePose<T, D>* poses, const LoneNode<T, D>& node)
      : node(node), pose(poses[node.obstacle]), at(place_of(a, node.lattice)) {
    Vector<T, D> x;
    MPM_UNROLL for (int i = 0; i < D; i++)
      x[i] = T(at[i]);
    u = node.velocity + T(-1) * velocity_at(pose, x);
  }

  MPM_HD Vector<T, D> change() const {
    return contact_velocity(pose.contact, u, node.normal, pose.row->friction) + T(-1) * u;
  }
  MPM_HD Vector<double, D> impulse() const { return as_double((T(0) - node.mass) * change()); }

  // Derivative of a component of the impulse by the velocity of the surface.
  MPM_HD Vector<T, D> slope(int axis) const {
    return (T(0) - node.mass) * slope_of_change(pose.contact, u, node.normal, pose.row->friction, axis);
  }
};

// A node that meets an obstacle alone, by its row and its place.
template <class T, int D>
MPM_HD LoneNode<T, D> lone_node(const ContactArguments<T, D>& a, const T* velocity, int64_t stride, int node,
                                const Vector<int, D>& lattice, int obstacle, const Vector<T, D>& normal) {
  return {node, obstacle, lattice, normal, a.mass[node * a.mass_stride], load_node<T, D>(velocity, stride, node)};
}

// ---- nodes that meet any surfaces

// An active slot of a scene, by the poses of the obstacles of its bodies.
template <class T, int D>
MPM_HD ContactSlot<T, D> slot_of_bodies(const ContactArguments<T, D>& a, const ObstaclePose<T, D>* poses, int scene,
                                        const int (&corner)[D]) {
  ContactSlot<T, D> s;
  s.active = true, s.scene = scene, s.row = poses->row;
  MPM_UNROLL for (int i = 0; i < D; i++)
    s.corner[i] = corner[i];
  find_near(a, [&](int k) -> const ObstaclePose<T, D>& { return poses[k]; }, NoVisit(), s);
  return s;
}

// Sets the surfaces that a node meets. By all threads of a warp, as `any_of_warp`.
template <class T, int D>
MPM_HD_CALL void set_body_node(bool wanted, const StoredPoses<T, D>& poses, const NodeContact<T, D>& contact, int node,
                               int local, BodyNode<T, D>& result) {
  if (!wanted) return;
  result.node = node;
  result.lattice = lattice_node<D>(poses.s.corner, local);
  result.position = contact.position;
  result.met.any = 1;
  result.met.sign = contact.sign;
  find_constraints(poses, contact, result.met.constraints);
}

// Whether a node has only what a `LoneNode` has.
template <class T, int D>
MPM_HD bool is_lone(const ContactArguments<T, D>& a, const BodyNode<T, D>& node) {
  bool lone = node.met.constraints.count == 1;
  const Vector<double, D> at = place_of(a, node.lattice);
  MPM_UNROLL for (int i = 0; i < D; i++)
    lone = lone && node.met.sign[i] == T(1) && node.position[i] == T(at[i]);
  return lone;
}

// Sets the velocities of the surfaces by those of their obstacles.
template <class T, int D>
MPM_HD void set_surface_velocities(const ObstaclePose<T, D>* poses, BodyNode<T, D>& node) {
  Constraints<T, D>& c = node.met.constraints;
  MPM_LOOP for (int i = 0; i < c.count; i++)
    if (c.e[i].owner >= 0) c.e[i].velocity = velocity_at(poses[c.e[i].owner], node.position);
}

// The owners of the obstacles that a node meets.
template <class T, int D>
MPM_HD MetBodies bodies_of(const int* owner, const BodyNode<T, D>& node) {
  const Constraints<T, D>& c = node.met.constraints;
  MetBodies met;
  MPM_LOOP for (int i = 0; i < c.count; i++)
    if (c.e[i].owner >= 0) met.add(i, owner[c.e[i].owner]);
  return met;
}

// The velocities that the surfaces take from a node.
template <class T, int D>
MPM_HD_CALL void take_from_node(bool wanted, const BodyNode<T, D>& node, const Vector<T, D>& v,
                                TakenVelocities<T, D>& taken) {
  if (wanted) take_velocities(node.met.constraints, node.met.sign, v, taken);
}

// The impulse of a node on one of its bodies.
template <class T, int D>
MPM_HD Vector<double, D> impulse_on(int number, const MetBodies& bodies, const T& mass,
                                    const TakenVelocities<T, D>& taken) {
  Vector<double, D> impulse = zero_vector<double, D>();
  MPM_LOOP for (int i = 0; i < taken.count; i++)
    if (bodies.number_of(i) == number) impulse = impulse + as_double(mass * taken.taken[i]);
  return impulse;
}

// The velocity v of a node after contact.
template <class T, int D>
MPM_HD Vector<T, D> without(const TakenVelocities<T, D>& taken, Vector<T, D> v) {
  MPM_LOOP for (int i = 0; i < taken.count; i++)
    v = v + T(-1) * taken.taken[i];
  return v;
}

// Sets the derivatives of the impulses of a node by the velocity of one of its bodies.
template <class T, int D>
MPM_HD_CALL void set_slopes(bool wanted, const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v,
                            const MetBodies& bodies, int by, ImpulseSlopes<T, D>& slopes) {
  if (!wanted) return;
  const Constraints<T, D>& c = node.met.constraints;
  unsigned moved = 0;
  MPM_LOOP for (int i = 0; i < c.count; i++)
    moved |= unsigned(c.e[i].owner >= 0 && bodies.number_of(i) == by) << i;
  MPM_LOOP for (int number = 0; number < bodies.count; number++)
    slopes.of[number] = zero_matrix<T, D>();
  slopes_of_constraints(c, reflected(node.met.sign, v), moved, [&](int axis, const auto& change) {
    MPM_LOOP for (int i = 0; i < c.count; i++) {
      Matrix<T, D>& own = slopes.of[bodies.number_of(i)];
      MPM_UNROLL for (int j = 0; j < D; j++)
        own[j][axis] -= mass * node.met.sign[j] * change[i][j];
    }
  });
}

// ---- sums over nodes: impulses on the motions of bodies, and their derivatives

template <int D>
MPM_HD Vector<double, D> arm_from(const BodyNow<D>& b, const Vector<double, D>& x) {
  return x + -1.0 * b.position;
}

template <class T, int D>
MPM_HD Vector<T, D> rounded_arm_from(const BodyNow<D>& b, const Vector<double, D>& x) {
  const Vector<double, D> arm = arm_from(b, x);
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = T(arm[i]);
  return r;
}

// Derivative of an impulse at arm `at` along the motions i of a body, by the motions j of a body at arm `by`, as number
// i n + j; `slope(axis)` is that of a component by the velocity there. The type of the nodes suffices: rounding of
// derivatives changes how Newton's method gets to the solution, and gradients, but no momentum.
template <class T, int D, class Slope>
MPM_HD void set_slope_block(const Slope& slope, const Vector<T, D>& at, const Vector<T, D>& by,
                            T (&block)[kMotions<D> * kMotions<D>]) {
  constexpr int n = kMotions<D>;
  T rows[D][n];
  MPM_UNROLL for (int axis = 0; axis < D; axis++)
    set_along_motions(by, slope(axis), rows[axis]);
  MPM_UNROLL for (int j = 0; j < n; j++) {
    Vector<T, D> column;
    T along[n];
    MPM_UNROLL for (int axis = 0; axis < D; axis++)
      column[axis] = rows[axis][j];
    set_along_motions(at, column, along);
    MPM_UNROLL for (int i = 0; i < n; i++)
      block[i * n + j] = along[i];
  }
}

// Of one body of a node, by the velocity of one of them, for `set_slope_block`.
template <class T, int D>
MPM_HD auto slope_of(const ImpulseSlopes<T, D>& slopes, int number) {
  return [&slopes, number](int axis) {
    Vector<T, D> row;
    MPM_UNROLL for (int i = 0; i < D; i++)
      row[i] = slopes.of[number][axis][i];
    return row;
  };
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
