#pragma once

#include "bodies/free_body.h"
#include "grid/contact.h"

// Nodes in contact with free bodies: the impulses that they give by the velocities of the surfaces, and the
// derivatives. The surfaces that a node meets do not depend on velocities, so they are found once in a step.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
struct BodyNode {
  int node = 0;            // row of the node tensors
  Vector<int, D> lattice;  // its place, where impulses act
  Vector<T, D> position;   // the same within the walls, where velocities of surfaces are read
  MetSurfaces<T, D> met;   // faces of obstacles come first, at most D
};

// Impulses on the faces of a node. What walls give beside obstacles counts as that of the first face.
template <class T, int D>
struct NodePush {
  int faces = 0;
  int obstacle[D];
  Vector<double, D> at, position;  // [m]
  T impulse[D][D];                 // by face and axis [N s]
  T slope[D][D][D][D];             // derivative of the impulse [face][axis] by the velocity of a surface [face][axis]
};

// Sets the surfaces that a node meets. By all threads of a warp, as `any_of_warp`.
template <class T, int D>
MPM_HD_CALL void set_body_node(bool wanted, const SlotPoses<T, D>& poses, const NodeContact<T, D>& contact, int node,
                               int local, BodyNode<T, D>& result) {
  if (!wanted) return;
  result.node = node;
  result.lattice = lattice_node<D>(poses.s.corner, local);
  result.position = contact.position;
  result.met.any = 1;
  result.met.sign = contact.sign;
  find_constraints(poses, contact, result.met.constraints);
}

// Sets the velocities of the surfaces by the rows of their obstacles.
template <class T, int D>
MPM_HD void set_surface_velocities(const ObstacleRow<T, D>* rows, BodyNode<T, D>& node) {
  Constraints<T, D>& c = node.met.constraints;
  MPM_LOOP for (int i = 0; i < c.count; i++) {
    if (c.e[i].owner < 0) continue;
    ObstaclePose<T, D> pose;
    pose.row = rows + c.e[i].owner;
    MPM_UNROLL for (int j = 0; j < D; j++)
      pose.centre[j] = pose.row->position[j];
    c.e[i].velocity = velocity_at(pose, node.position);
  }
}

template <class T, int D>
MPM_HD Vector<double, D> as_double(const Vector<T, D>& v) {
  Vector<double, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = double(v[i]);
  return r;
}

// Sets the faces of obstacles that a node meets, and where it is.
template <class T, int D>
MPM_HD void set_faces(const ContactArguments<T, D>& a, const BodyNode<T, D>& node, NodePush<T, D>& push) {
  const Constraints<T, D>& c = node.met.constraints;
  push.faces = 0;
  MPM_LOOP for (int i = 0; i < c.count; i++) {
    if (c.e[i].owner >= 0) push.obstacle[push.faces++] = c.e[i].owner;
  }
  MPM_UNROLL for (int i = 0; i < D; i++)
    push.at[i] = a.lower[i] + double(node.lattice[i] - kPadding) * a.dx;
  push.position = as_double(node.position);
}

// Sets the impulses of a node with a mass and a velocity before contact.
template <class T, int D>
MPM_HD_CALL void set_impulses(bool wanted, const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v,
                              NodePush<T, D>& push) {
  if (!wanted) return;
  const Constraints<T, D>& c = node.met.constraints;
  TakenVelocities<T, D> taken;
  take_velocities(c, node.met.sign, v, taken);
  MPM_LOOP for (int i = 0; i < taken.count; i++) {
    const bool is_wall = c.e[i].owner < 0;
    T(&impulse)[D] = push.impulse[is_wall ? 0 : i];
    MPM_UNROLL for (int axis = 0; axis < D; axis++)
      impulse[axis] = (is_wall ? impulse[axis] : T(0)) + mass * taken.taken[i][axis];
  }
}

// Sets the derivatives of the impulses of a node that meets one surface, by the velocity of that.
template <class T, int D>
MPM_HD void set_slopes_of_one(const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v, NodePush<T, D>& push) {
  const Constraint<T, D>& only = node.met.constraints.e[0];
  const Vector<T, D> u = reflected(node.met.sign, v) + T(-1) * only.velocity;
  MPM_UNROLL for (int axis = 0; axis < D; axis++) {
    Vector<T, D> unit = zero_vector<T, D>();
    unit[axis] = T(1);
    const Vector<T, D> kept = contact_adjoint(only.kind, u, only.normal, only.friction, unit);
    MPM_UNROLL for (int by = 0; by < D; by++)
      push.slope[0][axis][0][by] = mass * node.met.sign[axis] * (kept[by] - unit[by]);
  }
}

// The same by the velocity of a face along an axis, for any number of surfaces, by dual numbers.
template <class T, int D>
MPM_HD_CALL void set_slopes(bool wanted, const BodyNode<T, D>& node, const T& mass, const Vector<T, D>& v, int by_face,
                            int by_axis, NodePush<T, D>& push) {
  if (!wanted) return;
  using S = Dual<T>;
  const Constraints<T, D>& c = node.met.constraints;
  Constraints<S, D> lifted;
  MPM_LOOP for (int i = 0; i < c.count; i++) {
    add_constant(c.e[i], lifted);
    MPM_UNROLL for (int axis = 0; axis < D; axis++)
      if (i == by_face && axis == by_axis) lifted.e[i].velocity[axis].derivative = T(1);
  }
  Vector<S, D> before, change[Constraints<S, D>::most];
  MPM_UNROLL for (int axis = 0; axis < D; axis++)
    before[axis] = lift<S>(node.met.sign[axis] * v[axis]);
  changes_of_constraints<S, D>(lifted, before, change);
  MPM_LOOP for (int i = 0; i < c.count; i++) {
    const bool is_wall = c.e[i].owner < 0;
    MPM_UNROLL for (int axis = 0; axis < D; axis++) {
      T& slope = push.slope[is_wall ? 0 : i][axis][by_face][by_axis];
      slope = (is_wall ? slope : T(0)) - mass * node.met.sign[axis] * change[i][axis].derivative;
    }
  }
}

// Replaces the velocity of a node by that after contact.
template <class T, int D>
MPM_HD_CALL void change_velocity(bool wanted, const BodyNode<T, D>& node, Vector<T, D>& v) {
  if (wanted) v = node.met.after(v);
}

// ---- sums over nodes: impulses on the motions of bodies, and their derivatives

template <class T, int D>
MPM_HD Vector<double, D> arm_from(const BodyNow<D>& b, const Vector<double, D>& x) {
  return x + -1.0 * b.position;
}

// The impulse of a face along motion number i of the body that owns it.
template <class T, int D>
MPM_HD double impulse_along(const NodePush<T, D>& push, int face, const BodyNow<D>& b, int i) {
  const Vector<double, D> way = unit_motion(i, arm_from<T>(b, push.at));
  double sum = 0;
  MPM_UNROLL for (int axis = 0; axis < D; axis++)
    sum += way[axis] * double(push.impulse[face][axis]);
  return sum;
}

// Derivative of the impulse of a face [D] by motion number j of the body that owns face `by_face`.
template <class T, int D>
MPM_HD Vector<double, D> impulse_slope(const NodePush<T, D>& push, int face, int by_face, const BodyNow<D>& by, int j) {
  const Vector<double, D> velocity = unit_motion(j, arm_from<T>(by, push.position));
  Vector<double, D> slope = zero_vector<double, D>();
  MPM_UNROLL for (int p = 0; p < D; p++) MPM_UNROLL
    for (int q = 0; q < D; q++) slope[p] += double(push.slope[face][p][by_face][q]) * velocity[q];
  return slope;
}

// The same along motion number i of the body that owns the face.
template <class T, int D>
MPM_HD double slope_along(const NodePush<T, D>& push, const Vector<double, D>& slope, const BodyNow<D>& b, int i) {
  return dot(unit_motion(i, arm_from<T>(b, push.at)), slope);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
