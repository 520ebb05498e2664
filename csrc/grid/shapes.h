#pragma once

#include "grid/obstacle.h"

// The shapes of obstacles: their distance and their faces. A new shape is a struct here, a number and a case of
// `visit_shape`; its class in Python has the same number.
namespace mpm {

enum class ObstacleShape : int { plane, sphere, box, capsule, revolved, sampled, torus, count };

inline namespace TORCH_MPM_ISA {

// The corner at the end of edge k of a polygon.
template <class T>
MPM_HD const T* end_of_edge(const T* corner, int corners, int k) {
  return corner + 2 * (k + 1 < corners ? k + 1 : 0);
}

// From the nearest point of the edge between two corners to a point (distance from the axis, position along it).
template <class S>
MPM_HD Vector<S, 2> offset_from_edge(const ValueOf<S>* a, const ValueOf<S>* b, const Vector<S, 2>& p) {
  const Vector<S, 2> edge = {{lift<S>(b[0] - a[0]), lift<S>(b[1] - a[1])}};
  const Vector<S, 2> arm = {{p[0] - lift<S>(a[0]), p[1] - lift<S>(a[1])}};
  const S along = dot(arm, edge) / dot(edge, edge);
  if (!(along < S(1))) return {{p[0] - lift<S>(b[0]), p[1] - lift<S>(b[1])}};  // exactly as from the next edge
  return arm + (along > S(0) ? S(0) - along : S(0)) * edge;
}

// Whether an edge is on the axis, inside the body.
template <class T>
MPM_HD bool is_on_axis(const T* a, const T* b) {
  return a[0] == T(0) && b[0] == T(0);
}

// Whether an edge leads to a tip, a point of the axis where it meets the same edge on the other side of the axis.
template <class T>
MPM_HD bool leads_to_tip(const T* a, const T* b) {
  return (a[0] == T(0)) != (b[0] == T(0)) && a[1] != b[1];
}

// The edge number `tip` of those that lead to tips; as many as there are corners where there are fewer.
template <class T>
MPM_HD int edge_to_tip(const T* corner, int corners, int tip) {
  int k = 0;
  for (; k < corners; k++)
    if (leads_to_tip(corner + 2 * k, end_of_edge(corner, corners, k)) && tip-- == 0) break;
  return k;
}

template <class S>
MPM_HD Vector<S, 2> across_axis(const Vector<S, 2>& p) {
  return {{S(0) - p[0], p[1]}};
}

// Height of a point (distance from the axis, position along it) above the line of edge k of a polygon; `beyond` is how
// far the foot of the point is beyond the ends of the edge. Far above where the edge is on the axis.
template <class S>
MPM_HD S edge_height(const ValueOf<S>* corner, int corners, int k, const Vector<S, 2>& p, Vector<S, 2>& normal,
                     ValueOf<S>& beyond) {
  using T = ValueOf<S>;
  const T *const a = corner + 2 * k, *const b = end_of_edge(corner, corners, k);
  const Vector<T, 2> edge = {{b[0] - a[0], b[1] - a[1]}};
  const T size = length(edge), inverse = size > T(0) ? T(1) / size : T(0);
  const Vector<S, 2> arm = {{p[0] - lift<S>(a[0]), p[1] - lift<S>(a[1])}};
  normal = {{lift<S>(inverse * edge[1]), lift<S>(T(0) - inverse * edge[0])}};
  const T along = inverse * (value_of(arm[0]) * edge[0] + value_of(arm[1]) * edge[1]);
  beyond = along < T(0) ? T(0) - along : along > size ? along - size : T(0);
  if (size == T(0) || is_on_axis(a, b)) return S(std::numeric_limits<T>::max());
  return dot(arm, normal);
}

// The edge of a closed polygon that is nearest to a point; among equals, the first counts.
template <class S>
struct NearestEdge {
  int edge = -1;
  bool inside = false;  // whether the point is in the polygon
  Vector<S, 2> offset;  // of the point from the edge
  S squared = S(std::numeric_limits<ValueOf<S>>::max());
  ValueOf<S> second = std::numeric_limits<ValueOf<S>>::max();  // square of the distance of the next edge

  MPM_HD NearestEdge(const ValueOf<S>* corner, int corners, const Vector<S, 2>& p) : offset(zero_vector<S, 2>()) {
    for (int k = 0; k < corners; k++) {
      const auto *const a = corner + 2 * k, *const b = end_of_edge(corner, corners, k);
      const Vector<S, 2> along = {{lift<S>(b[0] - a[0]), lift<S>(b[1] - a[1])}};
      // An odd number of edges is crossed by the ray from the point away from the axis.
      const S side = along[0] * (p[1] - lift<S>(a[1])) - along[1] * (p[0] - lift<S>(a[0]));
      if ((a[1] > value_of(p[1])) != (b[1] > value_of(p[1])) && (along[1] > S(0) ? side > S(0) : side < S(0)))
        inside = !inside;
      if (is_on_axis(a, b)) continue;
      const Vector<S, 2> own = offset_from_edge(a, b, p);
      const S distance = dot(own, own);
      if (distance < squared) {
        second = value_of(squared);
        edge = k, offset = own, squared = distance;
      } else if (value_of(distance) < second) {
        second = value_of(distance);
      }
    }
  }
};

// How far edges of a polygon, and those beyond a tip, are from joining edge `nearest` at a point inside (grid/solid.h):
// the way to them from the nearest point of that, which is at an offset, or the height of the point above their line
// where it is not deeper.
template <class T>
MPM_HD T gap_of_edges(const T* corner, int corners, const Vector<T, 2>& p, int nearest, const Vector<T, 2>& offset) {
  const Vector<T, 2> foot = p + T(-1) * offset;
  const T deepest = T(1.001 * 1.001) * dot(offset, offset);  // all of these are squares
  T gap = std::numeric_limits<T>::max();
  const auto add = [&](int k, const Vector<T, 2>& point, const Vector<T, 2>& foot) {
    const T *const a = corner + 2 * k, *const b = end_of_edge(corner, corners, k);
    const Vector<T, 2> away = offset_from_edge(a, b, foot), edge = {{b[0] - a[0], b[1] - a[1]}};
    T way = dot(away, away);
    const T size = dot(edge, edge), side = (point[0] - a[0]) * edge[1] - (point[1] - a[1]) * edge[0];
    if (side > T(0) ? side * side < way * size : size > T(0) && side * side <= deepest * size)
      way = side > T(0) ? side * side / size : T(0);
    if (way < gap) gap = way;
  };
  for (int k = 0; k < corners; k++) {
    const T *const a = corner + 2 * k, *const b = end_of_edge(corner, corners, k);
    if (k != nearest && !is_on_axis(a, b)) add(k, p, foot);
    if (leads_to_tip(a, b)) add(k, across_axis(p), across_axis(foot));
  }
  return sqrt(gap);
}

// Distance of the edges beyond tips from a point.
template <class T>
MPM_HD T distance_across_axis(const T* corner, int corners, const Vector<T, 2>& p) {
  T distance = std::numeric_limits<T>::max();
  for (int k = 0; k < corners; k++) {
    const T *const a = corner + 2 * k, *const b = end_of_edge(corner, corners, k);
    if (leads_to_tip(a, b)) distance = std::fmin(distance, length(offset_from_edge(a, b, across_axis(p))));
  }
  return distance;
}

// Signed distance of a point from a closed polygon, and the outward normal of its nearest edge. `second`, unless null,
// is that of the next edge, or of one beyond a tip; inside it is the depth and the gap of the edges, so that the other
// side of a thin wall is far.
template <class S>
MPM_HD S polygon_surface(const ValueOf<S>* corner, int corners, const Vector<S, 2>& p, Vector<S, 2>& normal,
                         ValueOf<S>* second) {
  const NearestEdge<S> nearest(corner, corners, p);
  const ValueOf<S> far = std::numeric_limits<ValueOf<S>>::max();
  normal = zero_vector<S, 2>();
  if (second) *second = far;
  if (nearest.edge < 0) return S(far);
  const auto *const a = corner + 2 * nearest.edge, *const b = end_of_edge(corner, corners, nearest.edge);
  normal = direction(Vector<S, 2>{{lift<S>(b[1] - a[1]), lift<S>(a[0] - b[0])}});
  const S distance = length(nearest.offset);
  const auto values = [](const Vector<S, 2>& v) { return Vector<ValueOf<S>, 2>{{value_of(v[0]), value_of(v[1])}}; };
  if (second && nearest.inside)
    *second = value_of(distance) + gap_of_edges(corner, corners, values(p), nearest.edge, values(nearest.offset));
  else if (second)
    *second = std::fmin(std::sqrt(nearest.second), distance_across_axis(corner, corners, values(p)));
  return nearest.inside ? S(0) - distance : distance;
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

template <class S, int D>
MPM_HD Vector<S, D> extent_of(const ObstaclePose<S, D>& o) {
  Vector<S, D> extent;
  MPM_UNROLL for (int i = 0; i < D; i++)
    extent[i] = o.row->extent[i];
  return extent;
}

// A unit vector that is perpendicular to one.
template <class S, int D>
MPM_HD Vector<S, D> perpendicular(const Vector<S, D>& axis) {
  int least = 0;
  MPM_UNROLL for (int i = 1; i < D; i++)
    if (abs(axis[i]) < abs(axis[least])) least = i;
  S along = S(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    along = i == least ? axis[i] : along;
  Vector<S, D> unit;
  MPM_UNROLL for (int i = 0; i < D; i++)
    unit[i] = S(i == least ? 1 : 0) - along * axis[i];
  return direction(unit);
}

// A point by its distance from an axis through the origin, and its position along that.
template <class S, int D>
struct AroundAxis {
  Vector<S, D> axis, across;  // unit vectors; of a point on the axis, `across` is zero
  Vector<S, 2> point;

  MPM_HD AroundAxis(const Vector<S, D>& direction_of_axis, const Vector<S, D>& body)
      : axis(direction(direction_of_axis)) {
    const S along = dot(body, axis);
    across = body + (S(0) - along) * axis;
    point = {{length(across), along}};
    across = direction(across);
  }
  // A unit vector; of a point on the axis, that along it or zero.
  MPM_HD Vector<S, D> in_space(const Vector<S, 2>& v) const {
    const Vector<S, D> r = v[0] * across + v[1] * axis;
    return point[0] > S(0) ? r : direction(r);
  }
};

// What most shapes have: one curved face, the surface, whose number is −1.
struct OneFace {
  template <class T, int D>
  MPM_HD static bool is_flat(const ObstaclePose<T, D>&, int, const Vector<T, D>&, const T&) {
    return false;
  }
  template <int D, class T>
  MPM_HD static int face_count(const T*, int) {
    return 1;
  }
  template <class S, int D>
  MPM_HD static S face_height(const ObstaclePose<S, D>&, int, const Vector<S, D>&, Vector<S, D>& normal, ValueOf<S>&) {
    normal = zero_vector<S, D>();
    return S(std::numeric_limits<ValueOf<S>>::max());
  }
};

struct PlaneShape : OneFace {
  template <class T, int D>
  MPM_HD static bool is_flat(const ObstaclePose<T, D>&, int, const Vector<T, D>&, const T&) {
    return true;
  }

  template <class S, int D>
  MPM_HD static S surface(const ObstaclePose<S, D>& o, const Vector<S, D>& body, Vector<S, D>& normal, ValueOf<S>*) {
    const Vector<S, D> extent = extent_of(o);
    normal = (S(1) / length(extent)) * extent;
    return dot(body, normal);
  }
};

// All points within a radius of the one whose offset from `body` is given.
template <class S, int D>
MPM_HD S ball_surface(const Vector<S, D>& offset, const S& radius, Vector<S, D>& normal) {
  const S distance = length(offset);
  normal = (distance > S(0) ? S(1) / distance : S(0)) * offset;
  return distance - radius;
}

struct SphereShape : OneFace {
  template <class S, int D>
  MPM_HD static S surface(const ObstaclePose<S, D>& o, const Vector<S, D>& body, Vector<S, D>& normal, ValueOf<S>*) {
    return ball_surface(body, o.row->radius, normal);
  }
};

struct CapsuleShape : OneFace {
  template <class S, int D>
  MPM_HD static S surface(const ObstaclePose<S, D>& o, const Vector<S, D>& body, Vector<S, D>& normal, ValueOf<S>*) {
    const Vector<S, D> half = extent_of(o);
    const S squared = dot(half, half);
    S along = squared > S(0) ? dot(body, half) / squared : S(0);
    along = along < S(-1) ? S(-1) : along > S(1) ? S(1) : along;
    return ball_surface(body + (S(0) - along) * half, o.row->radius, normal);
  }
};

// All points within a radius of a circle, whose axis is as long as its radius; in 2-D two discs.
struct TorusShape : OneFace {
  template <class S, int D>
  MPM_HD static S surface(const ObstaclePose<S, D>& o, const Vector<S, D>& body, Vector<S, D>& normal, ValueOf<S>*) {
    const Vector<S, D> ring = extent_of(o);
    const AroundAxis<S, D> around(ring, body);
    Vector<S, 2> plane_normal;
    const S distance =
        ball_surface(Vector<S, 2>{{around.point[0] - length(ring), around.point[1]}}, o.row->radius, plane_normal);
    normal = around.in_space(plane_normal);
    return distance;
  }
};

// Faces 2 i and 2 i + 1 are the lower and the upper one of axis i.
struct BoxShape {
  template <class T, int D>
  MPM_HD static bool is_flat(const ObstaclePose<T, D>&, int, const Vector<T, D>&, const T&) {
    return true;
  }

  // The nearest face is that of the axis with the least negative distance.
  template <class S, int D>
  MPM_HD static S surface(const ObstaclePose<S, D>& o, const Vector<S, D>& body, Vector<S, D>& normal, ValueOf<S>*) {
    S deepest = S(0);
    int axis = -1;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const S distance = abs(body[i]) - S(0.5) * o.row->extent[i];
      if (axis < 0 || distance > deepest) deepest = distance, axis = i;
    }
    MPM_UNROLL for (int i = 0; i < D; i++)
      normal[i] = i != axis ? S(0) : body[i] < S(0) ? S(-1) : S(1);
    return deepest;
  }
  template <int D, class T>
  MPM_HD static int face_count(const T*, int) {
    return 2 * D;
  }
  template <class S, int D>
  MPM_HD static S face_height(const ObstaclePose<S, D>& o, int face, const Vector<S, D>& body, Vector<S, D>& normal,
                              ValueOf<S>&) {
    const int axis = face / 2;
    const S side = S(face % 2 ? 1 : -1);
    MPM_UNROLL for (int i = 0; i < D; i++)
      normal[i] = i == axis ? side : S(0);
    S along = S(0), size = S(0);
    MPM_UNROLL for (int i = 0; i < D; i++)
      if (i == axis) along = side * body[i], size = o.row->extent[i];
    return along - S(0.5) * size;
  }
};

// One face for each edge of its polygon, and one more for each edge that leads to a tip: that beyond the axis. Its
// numbers are the corners, anticlockwise: distance from the axis and position along it.
struct RevolvedShape {
  template <class T>
  MPM_HD static int edge_of(const T* corner, int corners, int face) {
    return face < corners ? face : edge_to_tip(corner, corners, face - corners);
  }

  // Near a tip, planes in the meridian of the point are the faces that join there.
  template <class T, int D>
  MPM_HD static bool is_flat(const ObstaclePose<T, D>& o, int face, const Vector<T, D>& body, const T& reach) {
    const int edge = edge_of(o.data, o.numbers / 2, face);
    return D == 2 || (leads_to_tip(o.data + 2 * edge, end_of_edge(o.data, o.numbers / 2, edge)) &&
                      AroundAxis<T, D>(extent_of(o), body).point[0] <= reach);
  }

  template <class S, int D>
  MPM_HD static S surface(const ObstaclePose<S, D>& o, const Vector<S, D>& body, Vector<S, D>& normal,
                          ValueOf<S>* second) {
    const AroundAxis<S, D> around(extent_of(o), body);
    Vector<S, 2> plane_normal;
    const S distance = polygon_surface(o.data, o.numbers / 2, around.point, plane_normal, second);
    normal = around.in_space(plane_normal);
    return distance;
  }
  template <int D, class T>
  MPM_HD static int face_count(const T* corner, int numbers) {
    const int corners = numbers / 2;
    int tips = 0;
    while (edge_to_tip(corner, corners, tips) < corners) tips++;
    return corners + tips;
  }
  template <class S, int D>
  MPM_HD static S face_height(const ObstaclePose<S, D>& o, int face, const Vector<S, D>& body, Vector<S, D>& normal,
                              ValueOf<S>& beyond) {
    AroundAxis<S, D> around(extent_of(o), body);
    const int corners = o.numbers / 2;
    const bool across = face >= corners;
    const int edge = edge_of(o.data, corners, face);
    const bool tip = leads_to_tip(o.data + 2 * edge, end_of_edge(o.data, corners, edge));
    if (tip && !(around.point[0] > S(0))) around.across = perpendicular(around.axis);  // any meridian
    Vector<S, 2> plane_normal;
    const S height =
        edge_height(o.data, corners, edge, across ? across_axis(around.point) : around.point, plane_normal, beyond);
    if (across) plane_normal = across_axis(plane_normal);
    normal = around.in_space(plane_normal);
    return height;
  }
};

// Known by its distance alone. Its numbers are the first node of the samples [D], their distance, numbers of them along
// each axis [D], and the samples, the last axis fastest.
struct SampledShape : OneFace {
  template <class S, int D>
  MPM_HD static S surface(const ObstaclePose<S, D>& o, const Vector<S, D>& body, Vector<S, D>& normal,
                          ValueOf<S>* second) {
    if (second) *second = std::numeric_limits<ValueOf<S>>::lowest();
    return sampled_surface(o.data, o.numbers, body, normal);
  }
};

// Calls a function with the struct of a shape.
template <class F>
MPM_HD auto visit_shape(ObstacleShape shape, F&& f) {
  switch (shape) {
    case ObstacleShape::plane:
      return f(PlaneShape());
    case ObstacleShape::box:
      return f(BoxShape());
    case ObstacleShape::capsule:
      return f(CapsuleShape());
    case ObstacleShape::revolved:
      return f(RevolvedShape());
    case ObstacleShape::sampled:
      return f(SampledShape());
    case ObstacleShape::torus:
      return f(TorusShape());
    default:
      return f(SphereShape());
  }
}

// Signed distance of a point in body coordinates, and the unit normal out of the body: right inside, zero where the
// shape has none. Outside, the distance is a lower bound. `second`, unless null, is the distance of a second face of
// the shape, where its faces may join at inner edges: the least number where they are not known one by one, and else
// the largest.
template <class S, int D>
MPM_HD S surface(const ObstaclePose<S, D>& o, const Vector<S, D>& body, Vector<S, D>& normal,
                 ValueOf<S>* second = nullptr) {
  if (second) *second = std::numeric_limits<ValueOf<S>>::max();
  return visit_shape(o.shape, [&](auto shape) { return decltype(shape)::surface(o, body, normal, second); });
}

// ---- the faces of a shape, which contact of several obstacles looks at one by one

// `data` are the numbers of the shape.
template <int D, class T>
MPM_HD int face_count(const ObstacleKind& o, const T* data) {
  return visit_shape(o.shape, [&](auto shape) { return decltype(shape)::template face_count<D>(data, o.numbers); });
}

// Whether the height above a face is linear in the position, within a reach around a point in body coordinates.
template <class T, int D>
MPM_HD bool is_flat(const ObstaclePose<T, D>& o, int face, const Vector<T, D>& body, const T& reach) {
  return visit_shape(o.shape, [&](auto shape) { return decltype(shape)::is_flat(o, face, body, reach); });
}

// Height of a point in body coordinates above the surface that carries a face, and the unit normal of that; `beyond` is
// about how far the foot of the point is from the face itself, as far as that is known. Face −1 is the nearest one, and
// that of shapes of one face.
template <class S, int D>
MPM_HD S face_height(const ObstaclePose<S, D>& o, int face, const Vector<S, D>& body, Vector<S, D>& normal,
                     ValueOf<S>& beyond) {
  beyond = ValueOf<S>(0);
  if (face < 0) return surface(o, body, normal);
  return visit_shape(o.shape, [&](auto shape) { return decltype(shape)::face_height(o, face, body, normal, beyond); });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
