#pragma once

#include <climits>
#include <cmath>
#include <cstdint>

#include "boundary/contact.h"
#include "grid/geometry.h"

// Node momentum to node velocity, gravity and the walls of the domain.
namespace mpm {

// The faces of an axis-aligned box at rest: 2 i is the lower face of axis i, 2 i + 1 the upper one.
template <class T, int D>
struct Walls {
  Contact kind[2 * D];
  T friction[2 * D];
  int node[2 * D];  // the last node at or beyond a lower face, the first one at or beyond an upper face

  // Planes are in world coordinates. A node within 1e-6 dx of a plane lies on it.
  void set(int face, Contact contact, double coefficient, double plane, double dx, double lower) {
    constexpr double tolerance = 1e-6, limit = 1 << 30;  // nodes have indices below 2^30 or so, planes may be infinite
    const double cell = std::fmax(-limit, std::fmin(limit, (plane - lower) / dx)) + kPadding;
    kind[face] = contact;
    friction[face] = T(coefficient);
    node[face] = int(face % 2 ? std::ceil(cell - tolerance) : std::floor(cell + tolerance));
    if (contact == Contact::open) node[face] = face % 2 ? INT_MAX : INT_MIN;
  }
};

// A row of the node tensor: mass, then momentum or velocity.
template <class T, int D>
struct alignas(D == 3 ? 16 : alignof(T)) NodeRow {
  T mass;
  Vector<T, D> value;
};

template <class T, int D>
struct GridUpdateArguments {
  Geometry<T, D> geometry;
  int capacity = 0;
  int block_count = 0;         // blocks of all scenes; entries of `block` outside are taken as unused
  const int* block = nullptr;  // [capacity] block of a slot, -1 where unused
  const NodeRow<T, D>* nodes = nullptr;
  const T* gravity = nullptr;   // [scenes, D], or null
  const T* scene_dt = nullptr;  // [scenes], or null; the time step of a scene is dt * scene_dt[scene]
  double dt = 0;
  Walls<T, D> walls;
  NodeRow<T, D>* updated = nullptr;
};

template <class T, int D>
struct GridUpdateBackwardArguments {
  GridUpdateArguments<T, D> forward;  // its `updated` unused
  const NodeRow<T, D>* grad_updated = nullptr;
  NodeRow<T, D>* grad_nodes = nullptr;
  Vector<T, D>* change = nullptr;  // [capacity] adjoint of the velocity change by gravity, summed over a block; or null
};

inline namespace TORCH_MPM_ISA {

// What the nodes of one slot share.
template <class T, int D>
struct SlotUpdate {
  bool active;
  bool walled;           // whether a face touches the block
  int corner[D];         // lattice index of the first node
  Vector<T, D> gravity;  // velocity change in this step
};

template <class T, int D>
MPM_HD SlotUpdate<T, D> slot_update(const GridUpdateArguments<T, D>& a, int slot) {
  SlotUpdate<T, D> s;
  const int index = a.block[slot];
  s.active = index >= 0 && index < a.block_count;
  s.walled = false;
  s.gravity = zero_vector<T, D>();
  if (!s.active) return s;
  const int scene = block_coordinates(a.geometry, index, s.corner);
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    s.corner[i] *= kBlockWidth;
    s.walled |= s.corner[i] <= a.walls.node[2 * i] || s.corner[i] + kBlockWidth > a.walls.node[2 * i + 1];
  }
  if (a.gravity) {
    const T dt = a.scene_dt ? T(a.dt) * a.scene_dt[scene] : T(a.dt);
    MPM_UNROLL
    for (int i = 0; i < D; i++) s.gravity[i] = dt * a.gravity[scene * D + i];
  }
  return s;
}

// The face that acts on a node along an axis, or -1.
template <class T, int D>
MPM_HD int wall_face(const Walls<T, D>& walls, const SlotUpdate<T, D>& s, int axis, int local) {
  const int shift = 2 * (D - 1 - axis);  // kBlockWidth is 4, the last axis fastest
  const int node = s.corner[axis] + ((local >> shift) & (kBlockWidth - 1));
  return node <= walls.node[2 * axis] ? 2 * axis : node >= walls.node[2 * axis + 1] ? 2 * axis + 1 : -1;
}

template <class T, int D>
MPM_HD Vector<T, D> wall_normal(int face) {
  Vector<T, D> n;
  MPM_UNROLL
  for (int i = 0; i < D; i++) n[i] = T(face == 2 * i) - T(face == 2 * i + 1);
  return n;
}

// Velocity of a node with mass before the walls act.
template <class T, int D>
MPM_HD Vector<T, D> free_velocity(const SlotUpdate<T, D>& s, const NodeRow<T, D>& row) {
  Vector<T, D> v;
  MPM_UNROLL
  for (int i = 0; i < D; i++) v[i] = row.value[i] / row.mass + s.gravity[i];
  return v;
}

// A node without mass has no velocity. At edges and corners the faces act one after another, in the order of the axes.
template <class T, int D>
MPM_HD NodeRow<T, D> update_node(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int local,
                                 const NodeRow<T, D>& row) {
  if (!s.active || row.mass == T(0)) return {s.active ? row.mass : T(0), zero_vector<T, D>()};
  Vector<T, D> v = free_velocity(s, row);
  if (s.walled) {
    MPM_UNROLL
    for (int i = 0; i < D; i++) {
      const int face = wall_face(a.walls, s, i, local);
      if (face >= 0) v = contact_velocity(a.walls.kind[face], v, wall_normal<T, D>(face), a.walls.friction[face]);
    }
  }
  return {row.mass, v};
}

// Adjoint of the row; `change` becomes that of the velocity before the walls.
template <class T, int D>
MPM_HD NodeRow<T, D> update_node_backward(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int local,
                                          const NodeRow<T, D>& row, const NodeRow<T, D>& grad, Vector<T, D>& change) {
  change = zero_vector<T, D>();
  if (!s.active || row.mass == T(0)) return {s.active ? grad.mass : T(0), change};
  change = grad.value;
  if (s.walled) {
    Vector<T, D> before[D];  // velocity before each axis
    Vector<T, D> v = free_velocity(s, row);
    MPM_UNROLL
    for (int i = 0; i < D; i++) {
      before[i] = v;
      const int face = wall_face(a.walls, s, i, local);
      if (face >= 0) v = contact_velocity(a.walls.kind[face], v, wall_normal<T, D>(face), a.walls.friction[face]);
    }
    MPM_UNROLL
    for (int i = D - 1; i >= 0; i--) {
      const int face = wall_face(a.walls, s, i, local);
      if (face >= 0)
        change = contact_adjoint(a.walls.kind[face], before[i], wall_normal<T, D>(face), a.walls.friction[face], change);
    }
  }
  NodeRow<T, D> result;
  result.mass = grad.mass;
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    result.value[i] = change[i] / row.mass;
    result.mass -= result.value[i] * (row.value[i] / row.mass);
  }
  return result;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
