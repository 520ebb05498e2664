#pragma once

#include "grid/impulse.h"
#include "grid/obstacle.h"

// One rigid body without the material: its mass and mobility by pose and joint, the velocity that gravity and wrenches
// give it in a step, and its pose and velocity at the end. All in float64. A motion is a velocity [m/s], D numbers,
// followed by an angular velocity [1/s]; a wrench acts along the same numbers.
namespace mpm {

template <int D>
constexpr int kMotions = kImpulse<D>;
template <int D>
constexpr int kPose = D == 2 ? 3 : 7;  // position, and an angle or a unit quaternion w, x, y, z
template <int D>
constexpr int kBodyRow = kPose<D> + kMotions<D>;

enum class BodyJoint : int { free, hinge, slider, driven, count };

// A row of the constants of bodies, see torch_mpm/ops/free_bodies.py.
template <int D>
struct BodyConstants {
  double mass;                // [kg]
  double inertia[kTurns<D>];  // along the axes of the frame [kg m²]
  double anchor[D];           // of a hinge [m]
  double axis[D];             // unit vector, of a slider or, in 3-D, of a hinge
  static constexpr int width = 1 + kTurns<D> + 2 * D;
};

// A row of the poses of obstacles in the frames of their bodies.
template <int D>
struct PartPose {
  double position[D], rotation[kTurns<D>];
  static constexpr int width = D + kTurns<D>;
};

inline namespace TORCH_MPM_ISA {

// ---- rotations: an angle in 2-D, a vector in 3-D

struct Quaternion {
  double w;
  Vector<double, 3> v;
};

// Of unit length.
MPM_HD Quaternion quaternion(const Vector<double, 3>& turn) {
  const double half = 0.5 * length(turn), share = half > 0 ? sin(half) / half : 1;
  return {cos(half), (0.5 * share) * turn};
}

// The vector of a rotation, with an angle of at most π.
MPM_HD Vector<double, 3> rotation_vector(Quaternion q) {
  if (q.w < 0) q.w = -q.w, q.v = -1.0 * q.v;
  const double half = length(q.v);
  // Below, the quotient is 1 to rounding.
  return (2 * (half < 1e-9 ? 1 : ::atan2(half, q.w) / half)) * q.v;
}

MPM_HD Vector<double, 1> rotation_of_pose(const double (&pose)[3]) { return {{pose[2]}}; }
MPM_HD Vector<double, 3> rotation_of_pose(const double (&pose)[7]) {
  return rotation_vector({pose[3], {{pose[4], pose[5], pose[6]}}});
}

MPM_HD void set_rotation(double (&pose)[3], const Vector<double, 1>& turn) { pose[2] = turn[0]; }
MPM_HD void set_rotation(double (&pose)[7], const Vector<double, 3>& turn) {
  const Quaternion q = quaternion(turn);
  pose[3] = q.w;
  MPM_UNROLL for (int i = 0; i < 3; i++)
    pose[4 + i] = q.v[i];
}

// The rotation by b followed by a.
MPM_HD Vector<double, 1> composed(const Vector<double, 1>& a, const Vector<double, 1>& b) { return {{a[0] + b[0]}}; }
MPM_HD Vector<double, 3> composed(const Vector<double, 3>& a, const Vector<double, 3>& b) {
  const Quaternion p = quaternion(a), q = quaternion(b);
  Quaternion r{p.w * q.w - dot(p.v, q.v), p.w * q.v + q.w * p.v};
  MPM_UNROLL for (int i = 0; i < 3; i++) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    r.v[i] = r.v[i] + (p.v[j] * q.v[k] - p.v[k] * q.v[j]);
  }
  return rotation_vector(r);
}

// ---- motions

// Velocity by a unit of number a of a motion, at an arm from the position of the body [m].
template <int D>
MPM_HD Vector<double, D> unit_motion(int a, const Vector<double, D>& arm) {
  Vector<double, D> v = zero_vector<double, D>();
  MPM_UNROLL for (int i = 0; i < D; i++)
    if (a == i) v[i] = 1;
  if constexpr (D == 2) {
    if (a == 2) v = {{-arm[1], arm[0]}};
  } else {
    MPM_UNROLL for (int i = 0; i < 3; i++)
      if (a == 3 + i) v[(i + 1) % 3] = -arm[(i + 2) % 3], v[(i + 2) % 3] = arm[(i + 1) % 3];
  }
  return v;
}

// Velocity by the numbers of a motion from the first on.
template <int D>
MPM_HD Vector<double, D> motion_at(const double* motion, const Vector<double, D>& arm, int first = 0) {
  Vector<double, D> v = zero_vector<double, D>();
  MPM_UNROLL for (int a = 0; a < kMotions<D>; a++)
    if (a >= first) v = v + motion[a] * unit_motion(a, arm);
  return v;
}

// A vector at an arm, along each number of a motion: its components, followed by its moment.
template <class S, int D>
MPM_HD void set_along_motions(const Vector<S, D>& arm, const Vector<S, D>& v, S (&along)[kMotions<D>]) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    along[i] = v[i];
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++) {
    const int j = D == 2 ? 0 : (i + 1) % 3, k = D == 2 ? 1 : (i + 2) % 3;
    along[D + i] = arm[j] * v[k] - arm[k] * v[j];
  }
}

// ---- a body at the beginning of a step

template <int D>
struct BodyNow {
  static constexpr int n = kMotions<D>;
  Vector<double, D> position;
  Vector<double, kTurns<D>> rotation;
  Matrix<double, D> turn;
  double gyration;        // square of the mean radius of gyration [m²]
  double mobility[n][n];  // velocities by impulses
  double predicted[n];    // motion at the end of the step without the material
};

// diag(inertia) or, for power −1, its inverse, times a vector; of a frame that is turned.
template <int D>
MPM_HD Vector<double, 3> turned_inertia(const BodyConstants<D>& c, const Matrix<double, 3>& turn, bool inverse,
                                        const Vector<double, 3>& v) {
  Vector<double, 3> own = transpose(turn) * v;
  MPM_UNROLL for (int i = 0; i < 3; i++)
    own[i] = inverse ? own[i] / c.inertia[i] : own[i] * c.inertia[i];
  return turn * own;
}

// Angular momentum by an angular velocity, or the inverse of that.
template <int D>
MPM_HD Vector<double, kTurns<D>> times_inertia(const BodyConstants<D>& c, const Matrix<double, D>& turn,
                                               const Vector<double, kTurns<D>>& v, bool inverse = false) {
  if constexpr (D == 2)
    return {{inverse ? v[0] / c.inertia[0] : v[0] * c.inertia[0]}};
  else
    return turned_inertia(c, turn, inverse, v);
}

// The one motion that a hinge or a slider allows.
template <int D>
MPM_HD void allowed_motion(const BodyConstants<D>& c, BodyJoint joint, const Vector<double, D>& position,
                           double (&motion)[kMotions<D>]) {
  MPM_UNROLL for (int i = 0; i < kMotions<D>; i++)
    motion[i] = 0;
  if (joint == BodyJoint::slider) {
    MPM_UNROLL for (int i = 0; i < D; i++)
      motion[i] = c.axis[i];
    return;
  }
  Vector<double, D> arm;
  MPM_UNROLL for (int i = 0; i < D; i++)
    arm[i] = position[i] - c.anchor[i];
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    motion[D + i] = D == 2 ? 1 : c.axis[i];
  const Vector<double, D> velocity = motion_at<D>(motion, arm, D);
  MPM_UNROLL for (int i = 0; i < D; i++)
    motion[i] = velocity[i];
}

// Mass and inertia times a motion.
template <int D>
MPM_HD void momentum_of(const BodyConstants<D>& c, const Matrix<double, D>& turn, const double (&motion)[kMotions<D>],
                        double (&momentum)[kMotions<D>]) {
  Vector<double, kTurns<D>> spin;
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    spin[i] = motion[D + i];
  spin = times_inertia(c, turn, spin);
  MPM_UNROLL for (int i = 0; i < kMotions<D>; i++)
    momentum[i] = i < D ? c.mass * motion[i] : spin[i - D];
}

// W: the inverse of mass and inertia of a free body, S (Sᵀ M S)⁻¹ Sᵀ of a body with one motion S, else zero.
template <int D>
MPM_HD void set_mobility(const BodyConstants<D>& c, BodyJoint joint, BodyNow<D>& b) {
  constexpr int n = kMotions<D>;
  MPM_UNROLL for (int i = 0; i < n; i++) MPM_UNROLL
    for (int j = 0; j < n; j++) b.mobility[i][j] = i == j && i < D ? 1 / c.mass : 0;
  if (joint == BodyJoint::free) {
    MPM_UNROLL for (int j = 0; j < kTurns<D>; j++) {
      Vector<double, kTurns<D>> unit;
      MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
        unit[i] = i == j;
      const Vector<double, kTurns<D>> column = times_inertia(c, b.turn, unit, true);
      MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
        b.mobility[D + i][D + j] = column[i];
    }
    return;
  }
  double motion[n] = {}, momentum[n], energy = 0;
  if (joint != BodyJoint::driven) allowed_motion(c, joint, b.position, motion);
  momentum_of(c, b.turn, motion, momentum);
  MPM_UNROLL for (int i = 0; i < n; i++)
    energy += motion[i] * momentum[i];
  MPM_UNROLL for (int i = 0; i < n; i++) MPM_UNROLL
    for (int j = 0; j < n; j++) b.mobility[i][j] = energy > 0 ? motion[i] * motion[j] / energy : 0;
}

// Velocities by an impulse.
template <int D>
MPM_HD double applied(const BodyNow<D>& b, const double* impulse, int i) {
  double sum = 0;
  MPM_UNROLL for (int j = 0; j < kMotions<D>; j++)
    sum += b.mobility[i][j] * impulse[j];
  return sum;
}

// A body by its row at the beginning of a step. `wrench` may be null.
template <int D>
MPM_HD BodyNow<D> body_now(const BodyConstants<D>& c, BodyJoint joint, const double* row, const double* gravity,
                           const double* wrench, double dt) {
  BodyNow<D> b;
  double pose[kPose<D>], impulse[kMotions<D>];
  MPM_UNROLL for (int i = 0; i < kPose<D>; i++)
    pose[i] = row[i];
  MPM_UNROLL for (int i = 0; i < D; i++)
    b.position[i] = pose[i];
  b.rotation = rotation_of_pose(pose);
  b.turn = rotation_matrix(b.rotation.e, 1.0);
  b.gyration = 0;
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    b.gyration += c.inertia[i] / (kTurns<D> * c.mass);
  set_mobility(c, joint, b);
  MPM_UNROLL for (int i = 0; i < kMotions<D>; i++)
    impulse[i] = dt * ((i < D ? c.mass * gravity[i < D ? i : 0] : 0) + (wrench ? wrench[i] : 0));
  MPM_UNROLL for (int i = 0; i < kMotions<D>; i++)
    b.predicted[i] = row[kPose<D> + i] + applied(b, impulse, i);
  return b;
}

// Speed of a motion; of rotation that at the radius of gyration.
template <int D>
MPM_HD double size_of_motion(const BodyNow<D>& b, const double* motion) {
  double squared = 0;
  MPM_UNROLL for (int i = 0; i < kMotions<D>; i++)
    squared += motion[i] * motion[i] * (i < D ? 1 : b.gyration);
  return sqrt(squared);
}

// ---- the obstacles of a body

// Sets the pose of an obstacle of a body, at rest.
template <class T, int D>
MPM_HD void place_part(const BodyNow<D>& b, const PartPose<D>& part, ObstacleRow<T, D>& row) {
  Vector<double, D> arm;
  Vector<double, kTurns<D>> own;
  MPM_UNROLL for (int i = 0; i < D; i++)
    arm[i] = part.position[i];
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    own[i] = part.rotation[i];
  arm = b.turn * arm;
  own = composed(b.rotation, own);
  MPM_UNROLL for (int i = 0; i < D; i++)
    row.position[i] = T(b.position[i] + arm[i]), row.velocity[i] = T(0);
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    row.rotation[i] = T(own[i]), row.angular_velocity[i] = T(0);
}

// Sets the velocities of an obstacle of a body with a motion.
template <class T, int D>
MPM_HD void move_part(const BodyNow<D>& b, const PartPose<D>& part, const double* motion, ObstacleRow<T, D>& row) {
  Vector<double, D> arm;
  MPM_UNROLL for (int i = 0; i < D; i++)
    arm[i] = part.position[i];
  const Vector<double, D> velocity = motion_at<D>(motion, b.turn * arm);
  MPM_UNROLL for (int i = 0; i < D; i++)
    row.velocity[i] = T(velocity[i]);
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    row.angular_velocity[i] = T(motion[D + i]);
}

// ---- the end of a step

// The pose after some time with constant velocities.
template <int D>
MPM_HD void move_pose(const BodyNow<D>& b, const double (&motion)[kMotions<D>], double seconds,
                      double (&pose)[kPose<D>]) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    pose[i] = b.position[i] + seconds * motion[i];
  Vector<double, kTurns<D>> turn;
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    turn[i] = seconds * motion[D + i];
  set_rotation(pose, composed(turn, b.rotation));
}

// Sets the angular velocity of a free body at a pose by its angular momentum.
template <int D>
MPM_HD void set_spin(const BodyConstants<D>& c, const double (&pose)[kPose<D>],
                     const Vector<double, kTurns<D>>& momentum, double (&motion)[kMotions<D>]) {
  const Vector<double, kTurns<D>> spin =
      times_inertia(c, rotation_matrix(rotation_of_pose(pose).e, 1.0), momentum, true);
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    motion[D + i] = spin[i];
}

// The row at the end of a step with a motion. A hinge keeps its distance; a free body keeps its angular momentum, and
// turns by the spin in the middle of the step, which is of second order.
template <int D>
MPM_HD void end_of_step(const BodyConstants<D>& c, BodyJoint joint, const BodyNow<D>& b, double (&motion)[kMotions<D>],
                        double dt, double* row) {
  double pose[kPose<D>];
  Vector<double, kTurns<D>> momentum;
  MPM_UNROLL for (int i = 0; i < kTurns<D>; i++)
    momentum[i] = motion[D + i];
  momentum = times_inertia(c, b.turn, momentum);
  const bool precesses = D == 3 && joint == BodyJoint::free;
  if (precesses) {
    move_pose(b, motion, 0.5 * dt, pose);
    set_spin(c, pose, momentum, motion);
  }
  move_pose(b, motion, dt, pose);
  if (joint == BodyJoint::hinge) {
    Vector<double, D> arm;
    MPM_UNROLL for (int i = 0; i < D; i++)
      arm[i] = b.position[i] - c.anchor[i];
    const Vector<double, D> way = rotation_matrix(rotation_of_pose(pose).e, 1.0) * (transpose(b.turn) * arm);
    const Vector<double, D> velocity = motion_at<D>(motion, way, D);
    MPM_UNROLL for (int i = 0; i < D; i++)
      pose[i] = c.anchor[i] + way[i], motion[i] = velocity[i];
  }
  if (precesses) set_spin(c, pose, momentum, motion);
  MPM_UNROLL for (int i = 0; i < kPose<D>; i++)
    row[i] = pose[i];
  MPM_UNROLL for (int i = 0; i < kMotions<D>; i++)
    row[kPose<D> + i] = motion[i];
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
