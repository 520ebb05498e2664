#pragma once

#include <cstdint>
#include <limits>

#include "grid/friction.h"
#include "grid/geometry.h"
#include "grid/impulse.h"
#include "grid/lattice_node.h"

// Rigid obstacles: the arguments of contact, poses, and the distance and faces of shapes.
namespace mpm {

enum class ObstacleShape : int { plane = 0, sphere = 1, box = 2, capsule = 3, revolved = 4, sampled = 5 };

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
  T extent[D];                                   // plane: normal; box: edge lengths; capsule: half axis; revolved: axis
  T radius;                                      // of a sphere or capsule
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
  // Of a revolved shape, corners (distance from the axis, position along it), anticlockwise; of a sampled one, the
  // first node of the samples [D], their distance, numbers of them along each axis [D], and the samples, the last axis
  // fastest.
  const T* data = nullptr;
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

// Many substeps of one call cannot tell a kernel that a graph replays which of them it is in: it counts activations.
template <class T, int D>
MPM_HD int step_of_call(const ContactArguments<T, D>& a) {
  return *a.activations - 1 - (a.activations_before ? *a.activations_before : 0);
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
  p.rotation = rotation_matrix(row.angular_velocity, elapsed) * rotation_matrix(row.rotation, S(1));
  return p;
}

// Signed distance of a point (distance from the axis, position along it) from a closed polygon, and the outward normal
// of its nearest edge; among equals, the first counts. `second` is the distance of the edge that is nearest but for
// this one.
template <class S>
MPM_HD S polygon_surface(const ValueOf<S>* corner, int corners, const Vector<S, 2>& p, Vector<S, 2>& normal,
                         ValueOf<S>& second) {
  using T = ValueOf<S>;
  S nearest = S(std::numeric_limits<T>::max());
  second = std::numeric_limits<T>::max();
  normal = zero_vector<S, 2>();
  bool inside = false;
  for (int k = 0; k < corners; k++) {
    const T *const a = corner + 2 * k, *const b = corner + 2 * (k + 1 < corners ? k + 1 : 0);
    const Vector<S, 2> edge = {{lift<S>(b[0] - a[0]), lift<S>(b[1] - a[1])}};
    const Vector<S, 2> arm = {{p[0] - lift<S>(a[0]), p[1] - lift<S>(a[1])}};
    // An odd number of edges is crossed by the ray from the point away from the axis.
    const S side = edge[0] * arm[1] - edge[1] * arm[0];
    if ((a[1] > value_of(p[1])) != (b[1] > value_of(p[1])) && (edge[1] > S(0) ? side > S(0) : side < S(0)))
      inside = !inside;
    if (a[0] == T(0) && b[0] == T(0)) continue;  // an edge on the axis is inside the body
    const S along = dot(arm, edge) / dot(edge, edge);
    Vector<S, 2> offset;
    if (!(along < S(1)))  // exactly as from the next edge
      offset = {{p[0] - lift<S>(b[0]), p[1] - lift<S>(b[1])}};
    else
      offset = arm + (along > S(0) ? S(0) - along : S(0)) * edge;
    const S distance = length(offset);
    if (distance < nearest) {
      second = value_of(nearest);
      nearest = distance;
      normal = direction(Vector<S, 2>{{edge[1], S(0) - edge[0]}});
    } else if (value_of(distance) < second) {
      second = value_of(distance);
    }
  }
  return inside ? S(0) - nearest : nearest;
}

// Signed distance by multilinear interpolation of samples, and the direction of its gradient; beyond the samples the
// distance there and the way to there are legs of a right triangle, so that it is a lower bound. Far away where the
// numbers are not those of samples.
template <class S, int D>
MPM_HD S sampled_surface(const ValueOf<S>* data, int numbers, const Vector<S, D>& p, Vector<S, D>& normal) {
  using T = ValueOf<S>;
  normal = zero_vector<S, D>();
  int64_t samples = numbers > 2 * D ? 1 : 0;
  int count[D];
  MPM_UNROLL for (int i = 0; i < D && samples; i++) {
    const T n = data[D + 1 + i];
    count[i] = n >= T(2) && n < T(1 << 20) ? int(n) : 0;
    samples *= count[i];
  }
  if (samples == 0 || samples > numbers - (2 * D + 1)) return S(std::numeric_limits<T>::max());
  const T spacing = data[D];
  int cell[D];
  Vector<S, D> weight, beyond;  // of the upper node
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const S along = (p[i] - lift<S>(data[i])) / lift<S>(spacing);
    const S last = lift<S>(T(count[i] - 1));
    const S inside = along > S(0) ? (along < last ? along : last) : S(0);
    cell[i] = int(value_of(inside));
    if (cell[i] > count[i] - 2) cell[i] = count[i] - 2;
    weight[i] = inside - lift<S>(T(cell[i]));
    beyond[i] = (along - inside) * lift<S>(spacing);
  }
  S distance = S(0);
  MPM_UNROLL for (int corner = 0; corner < 1 << D; corner++) {
    int64_t index = 0;
    S product = S(1);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const int upper = corner >> i & 1;
      index = index * count[i] + cell[i] + upper;
      product = product * (upper ? weight[i] : S(1) - weight[i]);
    }
    const S value = lift<S>(data[2 * D + 1 + index]);
    distance = distance + product * value;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      S slope = value;
      MPM_UNROLL for (int j = 0; j < D; j++) {
        const int upper = corner >> j & 1;
        slope = slope * (j == i ? S(upper ? 1 : -1) : upper ? weight[j] : S(1) - weight[j]);
      }
      normal[i] = normal[i] + slope;
    }
  }
  normal = direction(normal);
  const S far = dot(beyond, beyond);
  return far > S(0) ? sqrt(distance * distance + far) : distance;
}

// Signed distance of a point in body coordinates, and the unit normal out of the body: right inside, zero where the
// shape has none. Outside, the distance is a lower bound. `second` is the distance of a second face of the shape, where
// its faces may join at inner edges: the least number where they are not known one by one, and else the largest.
template <class T, int D>
MPM_HD T surface(const ObstaclePose<T, D>& o, const Vector<T, D>& body, Vector<T, D>& normal, ValueOf<T>& second) {
  second = std::numeric_limits<ValueOf<T>>::max();
  Vector<T, D> extent;
  MPM_UNROLL for (int i = 0; i < D; i++)
    extent[i] = o.row->extent[i];
  if (o.shape == ObstacleShape::plane) {
    normal = (T(1) / length(extent)) * extent;
    return dot(body, normal);
  }
  if (o.shape == ObstacleShape::box) {  // the nearest face is that of the axis with the least negative distance
    T deepest = T(0);
    int axis = -1;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const T distance = abs(body[i]) - T(0.5) * extent[i];
      if (axis < 0 || distance > deepest) deepest = distance, axis = i;
    }
    MPM_UNROLL for (int i = 0; i < D; i++)
      normal[i] = i != axis ? T(0) : body[i] < T(0) ? T(-1) : T(1);
    return deepest;
  }
  if (o.shape == ObstacleShape::revolved) {
    const Vector<T, D> axis = direction(extent);
    const T along = dot(body, axis);
    const Vector<T, D> across = body + (T(0) - along) * axis;
    Vector<T, 2> plane_normal;
    const T distance =
        polygon_surface(o.data, o.numbers / 2, Vector<T, 2>{{length(across), along}}, plane_normal, second);
    normal = plane_normal[0] * direction(across) + plane_normal[1] * axis;
    return distance;
  }
  if (o.shape == ObstacleShape::sampled) {
    second = std::numeric_limits<ValueOf<T>>::lowest();
    return sampled_surface(o.data, o.numbers, body, normal);
  }
  Vector<T, D> offset = body;
  if (o.shape == ObstacleShape::capsule) {
    const T squared = dot(extent, extent);
    T along = squared > T(0) ? dot(body, extent) / squared : T(0);
    along = along < T(-1) ? T(-1) : along > T(1) ? T(1) : along;
    offset = body + (T(0) - along) * extent;
  }
  const T distance = length(offset);
  normal = (distance > T(0) ? T(1) / distance : T(0)) * offset;
  return distance - o.row->radius;
}

template <class T, int D>
MPM_HD T surface(const ObstaclePose<T, D>& o, const Vector<T, D>& body, Vector<T, D>& normal) {
  ValueOf<T> second;
  return surface(o, body, normal, second);
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

// ---- the faces of a shape, which contact of several obstacles looks at one by one

// A box has 2 D flat faces, a revolved shape one for each edge of its polygon, any other shape its whole surface.
template <int D>
MPM_HD int face_count(const ObstacleKind& o) {
  return o.shape == ObstacleShape::box ? 2 * D : o.shape == ObstacleShape::revolved ? o.numbers / 2 : 1;
}

// Whether the height above a face is linear in the position.
template <int D>
MPM_HD bool is_flat(ObstacleShape shape) {
  return shape == ObstacleShape::box || shape == ObstacleShape::plane || (shape == ObstacleShape::revolved && D == 2);
}

// Height of a point (distance from the axis, position along it) above the line of edge k of a polygon; `beyond` is how
// far the foot of the point is beyond the ends of the edge. Far above where the edge is on the axis, inside the body.
template <class S>
MPM_HD S edge_height(const ValueOf<S>* corner, int corners, int k, const Vector<S, 2>& p, Vector<S, 2>& normal,
                     ValueOf<S>& beyond) {
  using T = ValueOf<S>;
  const T *const a = corner + 2 * k, *const b = corner + 2 * (k + 1 < corners ? k + 1 : 0);
  const Vector<S, 2> edge = {{lift<S>(b[0] - a[0]), lift<S>(b[1] - a[1])}};
  const Vector<S, 2> arm = {{p[0] - lift<S>(a[0]), p[1] - lift<S>(a[1])}};
  normal = direction(Vector<S, 2>{{edge[1], S(0) - edge[0]}});
  const T size = value_of(length(edge)), along = size > T(0) ? value_of(dot(arm, edge)) / size : T(0);
  beyond = along < T(0) ? T(0) - along : along > size ? along - size : T(0);
  if (size == T(0) || (a[0] == T(0) && b[0] == T(0))) return S(std::numeric_limits<T>::max());
  return dot(arm, normal);
}

// Height of a point in body coordinates above the surface that carries a face, and the unit normal of that; `beyond` is
// about how far the foot of the point is from the face itself, as far as that is known. Face −1 is the nearest one, the
// only one whose number `surface` needs.
template <class S, int D>
MPM_HD S face_height(const ObstaclePose<S, D>& o, int face, const Vector<S, D>& body, Vector<S, D>& normal,
                     ValueOf<S>& beyond) {
  using T = ValueOf<S>;
  beyond = T(0);
  if (face >= 0 && o.shape == ObstacleShape::box) {
    const int axis = face / 2;
    const S side = S(face % 2 ? 1 : -1);
    MPM_UNROLL for (int i = 0; i < D; i++)
      normal[i] = i == axis ? side : S(0);
    S along = S(0), size = S(0);
    MPM_UNROLL for (int i = 0; i < D; i++)
      if (i == axis) along = side * body[i], size = o.row->extent[i];
    return along - S(0.5) * size;
  }
  if (face >= 0 && o.shape == ObstacleShape::revolved) {
    Vector<S, D> extent;
    MPM_UNROLL for (int i = 0; i < D; i++)
      extent[i] = o.row->extent[i];
    const Vector<S, D> axis = direction(extent);
    const S along = dot(body, axis);
    const Vector<S, D> across = body + (S(0) - along) * axis;
    Vector<S, 2> plane_normal;
    const S height =
        edge_height(o.data, o.numbers / 2, face, Vector<S, 2>{{length(across), along}}, plane_normal, beyond);
    normal = plane_normal[0] * direction(across) + plane_normal[1] * axis;
    return height;
  }
  return surface(o, body, normal);
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
