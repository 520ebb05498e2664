#pragma once

#include <cstdint>
#include <limits>

#include "grid/friction.h"
#include "grid/geometry.h"
#include "grid/impulse.h"
#include "grid/lattice_node.h"

// Rigid obstacles: which nodes are inside, the velocity of those after contact, and its adjoints.
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
  int64_t stride = 0, grad_stride = 0;
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
// of its nearest edge; among equals, the first counts.
template <class S>
MPM_HD S polygon_surface(const ValueOf<S>* corner, int corners, const Vector<S, 2>& p, Vector<S, 2>& normal) {
  using T = ValueOf<S>;
  S nearest = S(std::numeric_limits<T>::max());
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
      nearest = distance;
      normal = direction(Vector<S, 2>{{edge[1], S(0) - edge[0]}});
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
// shape has none. Outside, the distance is a lower bound.
template <class T, int D>
MPM_HD T surface(const ObstaclePose<T, D>& o, const Vector<T, D>& body, Vector<T, D>& normal) {
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
    const T distance = polygon_surface(o.data, o.numbers / 2, Vector<T, 2>{{length(across), along}}, plane_normal);
    normal = plane_normal[0] * direction(across) + plane_normal[1] * axis;
    return distance;
  }
  if (o.shape == ObstacleShape::sampled) return sampled_surface(o.data, o.numbers, body, normal);
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

// A node seen by an obstacle.
template <class S, int D>
struct Touch {
  bool touching;
  Vector<S, D> normal, surface_velocity;
};

template <class S, class T, int D>
MPM_HD Touch<S, D> touch(const ContactArguments<T, D>& a, const ObstaclePose<S, D>& o, const Vector<T, D>& position) {
  Touch<S, D> t;
  Vector<S, D> arm, normal;
  MPM_UNROLL for (int i = 0; i < D; i++)
    arm[i] = lift<S>(position[i]) - o.centre[i];
  t.touching = value_of(surface(o, transpose(o.rotation) * arm, normal)) <= a.rounding;
  if (!t.touching) return t;
  t.normal = o.rotation * normal;
  const auto& rate = o.row->angular_velocity;
  MPM_UNROLL for (int i = 0; i < D; i++)
    t.surface_velocity[i] = o.row->velocity[i];
  if constexpr (D == 2) {
    t.surface_velocity[0] = t.surface_velocity[0] - rate[0] * arm[1];
    t.surface_velocity[1] = t.surface_velocity[1] + rate[0] * arm[0];
  } else {
    MPM_UNROLL for (int i = 0; i < 3; i++) {
      const int j = (i + 1) % 3, k = (i + 2) % 3;
      t.surface_velocity[i] = t.surface_velocity[i] + (rate[j] * arm[k] - rate[k] * arm[j]);
    }
  }
  return t;
}

// Whether an obstacle may touch a node of the block whose first node is at `first`. Distances change by no more than
// the way from a point to another; samples of distances do so between the nodes of their lattice, so that the slope of
// their multilinear interpolant is at most 1 along each axis.
template <class T, int D>
MPM_HD bool near_block(const ContactArguments<T, D>& a, const ObstaclePose<T, D>& o, const Vector<T, D>& first) {
  const T half = T(0.5 * (kBlockWidth - 1) * a.dx);
  Vector<T, D> arm, normal;
  MPM_UNROLL for (int i = 0; i < D; i++)
    arm[i] = first[i] + half - o.centre[i];
  const T slope = o.shape == ObstacleShape::sampled ? std::sqrt(T(D)) : T(1);
  const T reach = slope * std::sqrt(T(D)) * half * T(1.001) + a.rounding;
  return surface(o, transpose(o.rotation) * arm, normal) <= reach;
}

template <class T, int D>
MPM_HD Vector<T, D> node_position(const ContactArguments<T, D>& a, const int corner[D], int local) {
  Vector<T, D> x;
  MPM_UNROLL for (int i = 0; i < D; i++)
    x[i] = T(a.lower[i] + double(lattice_index<D>(corner, i, local) - kPadding) * a.dx);
  return x;
}

template <class T, int D>
MPM_HD Vector<T, D> relative_velocity(const Touch<T, D>& t, const Vector<T, D>& v) {
  return v + T(-1) * t.surface_velocity;
}

template <class T, int D>
MPM_HD Vector<T, D> after_contact(Contact contact, const T& friction, const Touch<T, D>& t, const Vector<T, D>& v) {
  const Vector<T, D> u = relative_velocity(t, v);
  return v + (contact_velocity(contact, u, t.normal, friction) + T(-1) * u);
}

template <class T, int D>
MPM_HD Vector<T, D> after_contact(const ObstaclePose<T, D>& o, const Touch<T, D>& t, const Vector<T, D>& v) {
  return after_contact(o.contact, o.row->friction, t, v);
}

// What the nodes of a slot share.
template <class T, int D>
struct ContactSlot {
  bool active = false;
  int scene = 0;
  int corner[D] = {};                      // lattice index of the first node
  const ObstacleRow<T, D>* row = nullptr;  // the obstacles of its scene
};

// Of an active block of a scene, with the lattice index of its first node.
template <class T, int D>
MPM_HD ContactSlot<T, D> contact_slot(const ContactArguments<T, D>& a, int scene, const int (&corner)[D]) {
  ContactSlot<T, D> s;
  s.scene = scene;
  s.active = (a.rows == 1 || scene < a.rows) && (!a.scene_time || a.times == 1 || scene < a.times);
  s.row = a.row + (a.rows == 1 ? 0 : int64_t(scene) * a.obstacles);
  if (a.step_stride && a.activations) s.row += step_of_call(a) * a.step_stride;
  MPM_UNROLL for (int i = 0; i < D; i++)
    s.corner[i] = corner[i];
  return s;
}

template <class T, int D>
MPM_HD ContactSlot<T, D> contact_slot(const ContactArguments<T, D>& a, int slot) {
  const int index = a.block[slot];
  if (index < 0) return {};
  int corner[D];
  const int scene = block_coordinates(a.geometry, index, corner);
  MPM_UNROLL for (int i = 0; i < D; i++)
    corner[i] *= kBlockWidth;
  return contact_slot(a, scene, corner);
}

// The pose of obstacle k; it does not act where it cannot touch the block.
template <class T, int D>
MPM_HD ObstaclePose<T, D> pose_at(const ContactArguments<T, D>& a, const ContactSlot<T, D>& s, int k) {
  ObstaclePose<T, D> pose = obstacle_pose(a, a.kind[k], s.row[k], s.scene);
  pose.acts = pose.acts && near_block(a, pose, node_position(a, s.corner, 0));
  return pose;
}

template <class T, int D>
MPM_HD Vector<T, D> load_node(const T* values, int64_t stride, int64_t node) {
  Vector<T, D> v;
  MPM_UNROLL for (int i = 0; i < D; i++)
    v[i] = values[node * stride + i];
  return v;
}

template <class T, int D>
MPM_HD void store_node(T* values, int64_t node, const Vector<T, D>& v, const T& first = T(0)) {
  T* const row = values + node * (1 + D);
  row[0] = first;
  MPM_UNROLL for (int i = 0; i < D; i++)
    row[1 + i] = v[i];
}

// The first obstacle that touches a node.
template <class T, int D>
struct FirstTouch {
  int obstacle;  // their number where none does
  Contact contact;
  T friction;
  Touch<T, D> touch;
};

template <class T, int D>
MPM_HD FirstTouch<T, D> first_touch(const ContactArguments<T, D>& a, const ContactSlot<T, D>& s,
                                    const Vector<T, D>& position) {
  FirstTouch<T, D> first;
  for (first.obstacle = s.active ? 0 : a.obstacles; first.obstacle < a.obstacles; first.obstacle++) {
    const ObstaclePose<T, D> pose = pose_at(a, s, first.obstacle);
    if (!pose.acts) continue;
    first.touch = touch(a, pose, position);
    if (!first.touch.touching) continue;
    first.contact = pose.contact;
    first.friction = pose.row->friction;
    break;
  }
  return first;
}

// The velocity v of a node after the obstacles from one on until `last`, which act one after another.
template <class T, int D>
MPM_HD Vector<T, D> after_obstacles(const ContactArguments<T, D>& a, const ContactSlot<T, D>& s, int first, int last,
                                    const Vector<T, D>& position, Vector<T, D> v) {
  for (int k = first; k < last; k++) {
    const ObstaclePose<T, D> pose = pose_at(a, s, k);
    if (!pose.acts) continue;
    const Touch<T, D> t = touch(a, pose, position);
    if (t.touching) v = after_contact(pose, t, v);
  }
  return v;
}

template <class T, int D>
MPM_HD Vector<T, D> after_obstacles(const ContactArguments<T, D>& a, const ContactSlot<T, D>& s, int last,
                                    const Vector<T, D>& position, const Vector<T, D>& v) {
  return after_obstacles(a, s, 0, last, position, v);
}

// The same after all of them, of which the first one that touches the node is known.
template <class T, int D>
MPM_HD Vector<T, D> after_obstacles(const ContactArguments<T, D>& a, const ContactSlot<T, D>& s,
                                    const FirstTouch<T, D>& first, const Vector<T, D>& position,
                                    const Vector<T, D>& v) {
  if (first.obstacle >= a.obstacles) return v;
  return after_obstacles(a, s, first.obstacle + 1, a.obstacles, position,
                         after_contact(first.contact, first.friction, first.touch, v));
}

// The nodes lane, lane + Lanes, ... of a slot.
template <int Lanes, class T, int D>
MPM_HD void slot_contact(const ContactArguments<T, D>& a, int slot, int lane) {
  constexpr int count = kBlockNodes<D> / Lanes;
  const ContactSlot<T, D> s = contact_slot(a, slot);
  const int64_t first = int64_t(slot) * kBlockNodes<D> + lane;
  Vector<T, D> v[count];
  for (int n = 0; n < count; n++) v[n] = load_node<T, D>(a.velocity, a.stride, first + n * Lanes);
  for (int k = 0; s.active && k < a.obstacles; k++) {
    const ObstaclePose<T, D> pose = pose_at(a, s, k);
    for (int n = 0; pose.acts && n < count; n++) {
      const Touch<T, D> t = touch(a, pose, node_position(a, s.corner, lane + n * Lanes));
      if (t.touching) v[n] = after_contact(pose, t, v[n]);
    }
  }
  for (int n = 0; n < count; n++) store_node(a.result, first + n * Lanes, v[n]);
}

// The nodes of a slot that an obstacle touches, as the backward pass needs them.
template <int count, class T, int D>
struct TouchedNodes {
  Touch<T, D> touch[count];
  Vector<T, D> position[count], before[count], grad[count];  // velocity before the contact, adjoint of that after it
};

// Adjoint of a parameter of an obstacle by some nodes: one directional derivative of the velocities after contact.
template <int count, class T, int D>
MPM_HD T parameter_adjoint(const ContactArguments<T, D>& a, const ContactSlot<T, D>& s, int k, int parameter,
                           const TouchedNodes<count, T, D>& nodes) {
  using S = Dual<T>;
  ObstacleRow<S, D> row;
  const T* const values = reinterpret_cast<const T*>(s.row + k);
  S* const lifted = reinterpret_cast<S*>(&row);
  for (int i = 0; i < ObstacleRow<T, D>::width; i++) lifted[i] = S(values[i], i == parameter ? T(1) : T(0));
  const ObstaclePose<S, D> pose = obstacle_pose(a, a.kind[k], row, s.scene);
  T sum = T(0);
  for (int n = 0; n < count; n++) {
    if (!nodes.touch[n].touching) continue;
    Vector<S, D> v;
    MPM_UNROLL for (int i = 0; i < D; i++)
      v[i] = lift<S>(nodes.before[n][i]);
    const Vector<S, D> after = after_contact(pose, touch(a, pose, nodes.position[n]), v);
    MPM_UNROLL for (int i = 0; i < D; i++)
      sum += nodes.grad[n][i] * after[i].derivative;
  }
  return sum;
}

// `sum_lanes` adds a number over the lanes of a slot; the first lane gets the sum. `impulses(scene, node)` are
// `NodeImpulses` of a node, or `NoImpulses`.
template <int Lanes, class T, int D, class SumLanes, class ImpulsesOf>
MPM_HD void slot_contact_backward(const ContactArguments<T, D>& a, int slot, int lane, SumLanes&& sum_lanes,
                                  ImpulsesOf&& impulses) {
  constexpr int count = kBlockNodes<D> / Lanes, width = ObstacleRow<T, D>::width;
  constexpr bool with_impulses = decltype(impulses(0, 0))::wanted;
  const ContactSlot<T, D> s = contact_slot(a, slot);
  const int64_t first = int64_t(slot) * kBlockNodes<D> + lane;
  TouchedNodes<count, T, D> nodes;
  T mass_grad[count] = {};
  for (int n = 0; n < count; n++) nodes.grad[n] = load_node<T, D>(a.grad, a.grad_stride, first + n * Lanes);
  for (int k = a.obstacles - 1; k >= 0; k--) {
    ObstaclePose<T, D> pose;
    pose.acts = false;
    if (s.active) pose = pose_at(a, s, k);
    for (int n = 0; pose.acts && n < count; n++) {
      nodes.position[n] = node_position(a, s.corner, lane + n * Lanes);
      nodes.touch[n] = touch(a, pose, nodes.position[n]);
      if (!nodes.touch[n].touching) continue;
      nodes.before[n] =
          after_obstacles(a, s, k, nodes.position[n], load_node<T, D>(a.velocity, a.stride, first + n * Lanes));
      if constexpr (with_impulses) {
        auto own = impulses(s.scene, first + n * Lanes);
        const Vector<T, D> after = after_contact(pose, nodes.touch[n], nodes.before[n]);
        nodes.grad[n] =
            own.take(own.weight(k, lattice_node<D>(s.corner, lane + n * Lanes)), nodes.before[n], after, nodes.grad[n]);
        mass_grad[n] += own.mass_grad;
      }
    }
    for (int i = 0; a.row_grad && i < width; i++) {
      const T sum = pose.acts ? sum_lanes(parameter_adjoint(a, s, k, i, nodes)) : T(0);
      if (lane == 0) a.row_grad[(int64_t(slot) * a.obstacles + k) * width + i] = sum;
    }
    for (int n = 0; pose.acts && n < count; n++) {
      const Touch<T, D>& t = nodes.touch[n];
      if (!t.touching) continue;
      const Vector<T, D> u = relative_velocity(t, nodes.before[n]);
      nodes.grad[n] = contact_adjoint(pose.contact, u, t.normal, pose.row->friction, nodes.grad[n]);
      if constexpr (with_impulses) {
        const auto own = impulses(s.scene, first + n * Lanes);
        nodes.grad[n] = nodes.grad[n] + own.mass * own.weight(k, lattice_node<D>(s.corner, lane + n * Lanes));
      }
    }
  }
  for (int n = 0; n < count; n++) store_node(a.result, first + n * Lanes, nodes.grad[n], mass_grad[n]);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
