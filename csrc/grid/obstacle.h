#pragma once

#include <cstdint>
#include <limits>

#include "grid/friction.h"
#include "grid/geometry.h"
#include "grid/impulse.h"
#include "grid/lattice_node.h"

// Rigid obstacles: the arguments of contact, and poses.
namespace mpm {

enum class ObstacleShape : int;  // see grid/shapes.h

constexpr int kMaxObstacles = 64;  // of one call

// What differs between the obstacles of a call, but not between scenes.
struct ObstacleKind {
  ObstacleShape shape;
  Contact contact;
  int scene;                  // -1 for all
  double start, end;          // acts while start <= time < end [s]
  int first_number, numbers;  // of the data of its shape
};

// A row of the table of obstacles, all of it numbers of the nodes' type (torch_mpm/ops/contact.py writes it).
template <class T, int D>
struct ObstacleRow {
  static constexpr int angles = D == 2 ? 1 : 3;
  T friction;
  T position[D], velocity[D];                    // of the centre at time `start`
  T rotation[angles], angular_velocity[angles];  // an angle in 2-D, a vector in 3-D; about the centre
  T extent[D];                                   // the vector of its shape, and
  T radius;                                      // the radius, see grid/shapes.h
  static constexpr int width = 3 * D + 2 * angles + 2;
};

template <class T, int D>
struct ContactArguments {
  Geometry<T, D> geometry;
  double dx, lower[D];
  T rounding;  // distance within which a node lies on a surface [m]
  // The walls of the domain, 2 i the lower and 2 i + 1 the upper one of axis i: see grid/solid.h.
  Contact wall_kind[2 * D];
  T wall_plane[2 * D];
  int max_blocks = 0;
  const int* block = nullptr;  // [max_blocks] block of a slot, -1 where unused
  int obstacles = 0;
  ObstacleKind kind[kMaxObstacles];
  const ObstacleRow<T, D>* row = nullptr;  // [rows, obstacles]; one row for all scenes, or one per scene
  int rows = 0;
  // From there to the rows of the next substep of a call, where each has its own, with the positions of then; else
  // zero.
  int64_t step_stride = 0;
  const T* data = nullptr;             // numbers of the shapes that have many, see grid/shapes.h
  const double* scene_time = nullptr;  // [times], one for all scenes or one per scene; or null
  int times = 0;
  double time = 0;  // where scene_time is null, or
  // the times of the substeps of a call, on the device.
  const double* step_time = nullptr;
  // Where a kernel has to find out which substep of a call it is in: counted with this substep's, and before the call
  // (or null).
  const int *activations = nullptr, *activations_before = nullptr;
  const T* velocity = nullptr;  // node i at velocity + i * stride
  const T* grad = nullptr;      // likewise; backward only
  const T* mass = nullptr;      // likewise, or null; nodes without mass keep their velocity
  int64_t stride = 0, grad_stride = 0, mass_stride = 0;
  T* result =
      nullptr;  // rows [max_blocks * 4^D, 1 + D] as of the grid update, the first column zero or a mass' adjoint
  // Of many substeps: the surfaces that nodes meet where the obstacles rest, on CUDA in a hash table, see `recall`.
  unsigned long long* known_nodes = nullptr;  // keys [known_size], zero on entry
  void* known = nullptr;                      // MetSurfaces [known_size]; on the CPU a std::shared_ptr<void>
  int known_size = 0;                         // a power of two
  T* row_grad = nullptr;  // adjoint of the rows by each slot [max_blocks, obstacles, width], or null; backward only
};

inline namespace TORCH_MPM_ISA {

// With derivative zero at the zero vector.
template <class T, int D>
MPM_HD T length(const Vector<T, D>& v) {
  const T squared = dot(v, v);
  return squared > T(0) ? sqrt(squared) : T(0);
}

template <class T, int D>
MPM_HD Vector<T, D> direction(const Vector<T, D>& v) {
  const T norm = length(v);
  return (norm > T(0) ? T(1) / norm : T(0)) * v;
}

// Rotation by an angle, or by a vector (Rodrigues).
template <class T>
MPM_HD Matrix<T, 2> rotation_matrix(const T (&angle)[1], const T& factor) {
  const T c = cos(angle[0] * factor), s = sin(angle[0] * factor);
  return {{{c, T(0) - s}, {s, c}}};
}

template <class T>
MPM_HD Matrix<T, 3> rotation_matrix(const T (&vector)[3], const T& factor) {
  const T x = vector[0] * factor, y = vector[1] * factor, z = vector[2] * factor;
  const T half = T(0.5) * length(Vector<T, 3>{{x, y, z}});
  const T s = half > T(0) ? sin(half) / half : T(1);  // sin(θ/2)/(θ/2)
  const T first = s * cos(half), second = T(0.5) * s * s;
  const Matrix<T, 3> cross = {{{T(0), T(0) - z, y}, {z, T(0), T(0) - x}, {T(0) - y, x, T(0)}}};
  return identity<T, 3>() + first * cross + second * (cross * cross);
}

// Whether a rotation turns nothing; that of dual numbers may have a derivative.
template <class T, int N>
MPM_HD bool is_zero(const T (&angle)[N]) {
  bool zero = std::is_floating_point_v<T>;
  if constexpr (std::is_floating_point_v<T>) MPM_UNROLL
    for (int i = 0; i < N; i++) zero = zero && angle[i] == T(0);
  return zero;
}

// An obstacle at a time. S is the scalar of its parameters, T or a dual number.
template <class S, int D>
struct ObstaclePose {
  bool acts;
  ObstacleShape shape;
  Contact contact;
  const ObstacleRow<S, D>* row;
  const ValueOf<S>* data;
  int numbers;
  Vector<S, D> centre;
  Matrix<S, D> rotation;  // world = centre + rotation body
};

// Step of a call of many substeps, by the count of activations: a kernel that a graph replays has the same arguments.
template <class T, int D>
MPM_HD int step_of_call(const ContactArguments<T, D>& a) {
  return *a.activations - 1 - (a.activations_before ? *a.activations_before : 0);
}

// Rows of the obstacles of a scene in this step.
template <class T, int D>
MPM_HD const ObstacleRow<T, D>* rows_of_scene(const ContactArguments<T, D>& a, int scene) {
  const ObstacleRow<T, D>* const row = a.row + (a.rows == 1 ? 0 : int64_t(scene) * a.obstacles);
  return a.step_stride && a.activations ? row + step_of_call(a) * a.step_stride : row;
}

template <class T, int D>
MPM_HD double contact_time(const ContactArguments<T, D>& a, int scene) {
  if (a.scene_time) return a.scene_time[a.times == 1 ? 0 : scene];
  return a.step_time ? a.step_time[step_of_call(a)] : a.time;
}

template <class S, class T, int D>
MPM_HD ObstaclePose<S, D> obstacle_pose(const ContactArguments<T, D>& a, const ObstacleKind& kind,
                                        const ObstacleRow<S, D>& row, int scene) {
  const double time = contact_time(a, scene);
  ObstaclePose<S, D> p;
  p.acts = (kind.scene < 0 || kind.scene == scene) && time >= kind.start && time < kind.end;
  if (!p.acts) return p;
  p.shape = kind.shape;
  p.contact = kind.contact;
  p.row = &row;
  p.data = a.data + kind.first_number;
  p.numbers = kind.numbers;
  const S elapsed = lift<S>(T(time - kind.start)), moved = a.step_stride ? S(T(0)) : elapsed;
  MPM_UNROLL for (int i = 0; i < D; i++)
    p.centre[i] = row.position[i] + row.velocity[i] * moved;
  // Most obstacles do not turn, and the matrices take longer than the rest of contact.
  p.rotation = is_zero(row.rotation) ? identity<S, D>() : rotation_matrix(row.rotation, S(1));
  if (!is_zero(row.angular_velocity)) p.rotation = rotation_matrix(row.angular_velocity, elapsed) * p.rotation;
  return p;
}

// Velocity of an obstacle's matter at a position.
template <class S, int D>
MPM_HD Vector<S, D> velocity_at(const ObstaclePose<S, D>& o, const Vector<ValueOf<S>, D>& position) {
  Vector<S, D> arm, velocity;
  const auto& rate = o.row->angular_velocity;
  MPM_UNROLL for (int i = 0; i < D; i++)
    arm[i] = lift<S>(position[i]) - o.centre[i], velocity[i] = o.row->velocity[i];
  if constexpr (D == 2) {
    velocity[0] = velocity[0] - rate[0] * arm[1];
    velocity[1] = velocity[1] + rate[0] * arm[0];
  } else {
    MPM_UNROLL for (int i = 0; i < 3; i++) {
      const int j = (i + 1) % 3, k = (i + 2) % 3;
      velocity[i] = velocity[i] + (rate[j] * arm[k] - rate[k] * arm[j]);
    }
  }
  return velocity;
}

// A point of the world in the coordinates of an obstacle.
template <class S, int D>
MPM_HD Vector<S, D> to_body(const ObstaclePose<S, D>& o, const Vector<ValueOf<S>, D>& position) {
  Vector<S, D> arm;
  MPM_UNROLL for (int i = 0; i < D; i++)
    arm[i] = lift<S>(position[i]) - o.centre[i];
  return transpose(o.rotation) * arm;
}

template <class T, int D>
MPM_HD Vector<T, D> node_position(const ContactArguments<T, D>& a, const int corner[D], int local) {
  Vector<T, D> x;
  MPM_UNROLL for (int i = 0; i < D; i++)
    x[i] = T(a.lower[i] + double(lattice_index<D>(corner, i, local) - kPadding) * a.dx);
  return x;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
