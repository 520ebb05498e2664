#pragma once

#include <climits>
#include <cmath>
#include <cstdint>

#include "grid/friction.h"
#include "grid/geometry.h"

// Node momentum to node velocity, gravity and the walls of the domain.
//
// A mirror makes its plane one of symmetry: node values are what the particles together with their images behind the
// plane would give. Mass and momentum (gravity included) of a node and, reflected, of its image are summed; both nodes
// get the velocity of the sum, each on its side. A node on the plane is its own image and loses its normal velocity.
namespace mpm {

constexpr int kMirrorReach = 2;  // nodes on both sides of a mirror that have images: the support of particles at it

// The faces of an axis-aligned box at rest: 2 i is the lower face of axis i, 2 i + 1 the upper one.
template <class T, int D>
struct Walls {
  static constexpr int kNoMirror = -(1 << 30);

  Contact kind[2 * D];
  T friction[2 * D];
  int node[2 * D];    // contact: the last node at or beyond a lower face, the first one at or beyond an upper face
  int mirror[2 * D];  // twice the lattice index of a mirror's plane; node i has its image at mirror - i
  bool mirrored = false;

  // Planes are in world coordinates. A node within 1e-6 dx of a plane lies on it.
  void set(int face, Contact contact, double coefficient, double plane, double dx, double lower) {
    constexpr double tolerance = 1e-6, limit = 1 << 29;  // nodes have indices below 2^29 or so, planes may be infinite
    const double cell = std::fmax(-limit, std::fmin(limit, (plane - lower) / dx)) + kPadding;
    kind[face] = contact;
    friction[face] = T(coefficient);
    node[face] = int(face % 2 ? std::ceil(cell - tolerance) : std::floor(cell + tolerance));
    mirror[face] = contact == Contact::mirror ? int(std::lround(2 * cell)) : kNoMirror;
    mirrored |= contact == Contact::mirror;
    if (contact == Contact::open || contact == Contact::mirror) node[face] = face % 2 ? INT_MAX : INT_MIN;
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
  int max_blocks = 0;
  int block_count = 0;         // blocks of all scenes; entries of `block` outside are taken as unused
  const int* block = nullptr;  // [max_blocks] block of a slot, -1 where unused
  const int* table = nullptr;  // slot of a block, -1 where inactive; has entries for block_count blocks
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
  Vector<T, D>* change =
      nullptr;  // [max_blocks] adjoint of the velocity change by gravity, summed over a block; or null
};

inline namespace TORCH_MPM_ISA {

// What the nodes of one slot share.
template <class T, int D>
struct SlotUpdate {
  bool active;
  bool walled;    // whether a contact face touches the block
  bool mirrored;  // whether a node of the block may have an image
  int scene;
  int corner[D];         // lattice index of the first node
  Vector<T, D> gravity;  // velocity change in this step
};

template <class T, int D>
MPM_HD SlotUpdate<T, D> slot_update(const GridUpdateArguments<T, D>& a, int slot) {
  SlotUpdate<T, D> s;
  const int index = a.block[slot];
  s.active = index >= 0 && index < a.block_count;
  s.walled = s.mirrored = false;
  s.gravity = zero_vector<T, D>();
  if (!s.active) return s;
  s.scene = block_coordinates(a.geometry, index, s.corner);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    s.corner[i] *= kBlockWidth;
    s.walled |= s.corner[i] <= a.walls.node[2 * i] || s.corner[i] + kBlockWidth > a.walls.node[2 * i + 1];
  }
  if (a.walls.mirrored) {
    MPM_UNROLL for (int face = 0; face < 2 * D; face++) {
      const int first = 2 * s.corner[face / 2] - a.walls.mirror[face];  // twice the distance from the plane
      s.mirrored |= first <= 2 * kMirrorReach && first + 2 * (kBlockWidth - 1) >= -2 * kMirrorReach;
    }
  }
  if (a.gravity) {
    const T dt = a.scene_dt ? T(a.dt) * a.scene_dt[s.scene] : T(a.dt);
    MPM_UNROLL for (int i = 0; i < D; i++)
      s.gravity[i] = dt * a.gravity[s.scene * D + i];
  }
  return s;
}

// Lattice index of a node of the slot along an axis.
template <class T, int D>
MPM_HD int node_index(const SlotUpdate<T, D>& s, int axis, int local) {
  const int shift = 2 * (D - 1 - axis);  // kBlockWidth is 4, the last axis fastest
  return s.corner[axis] + ((local >> shift) & (kBlockWidth - 1));
}

// The contact face that acts on a node along an axis, or -1.
template <class T, int D>
MPM_HD int wall_face(const Walls<T, D>& walls, const SlotUpdate<T, D>& s, int axis, int local) {
  const int node = node_index(s, axis, local);
  return node <= walls.node[2 * axis] ? 2 * axis : node >= walls.node[2 * axis + 1] ? 2 * axis + 1 : -1;
}

template <class T, int D>
MPM_HD Vector<T, D> wall_normal(int face) {
  Vector<T, D> n;
  MPM_UNROLL for (int i = 0; i < D; i++)
    n[i] = T(face == 2 * i) - T(face == 2 * i + 1);
  return n;
}

// Row of a lattice node in the scene of the slot, or -1 where its block is inactive.
template <class T, int D>
MPM_HD int64_t row_of(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, const int node[D]) {
  int block[D];
  MPM_UNROLL for (int i = 0; i < D; i++) {
    if (node[i] < 0 || node[i] >= a.geometry.blocks[i] * kBlockWidth) return -1;
    block[i] = node[i] / kBlockWidth;
  }
  const int slot = a.table[block_index(a.geometry, s.scene, block)];
  return slot < 0 || slot >= a.max_blocks ? -1 : int64_t(slot) * kBlockNodes<D> + node_in_block<D>(node);
}

// Calls f(row, sign) for a node and its images in the mirrors, 2^k of them where k mirrors meet; sign is the diagonal
// of the reflection. The images of an image are the same nodes.
template <class T, int D, class F>
MPM_HD void for_images(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int local, F&& f) {
  int node[D], image[D], axes = 0;  // axes: bits of those along which there is an image
  MPM_UNROLL for (int i = 0; i < D; i++) {
    node[i] = node_index(s, i, local);
    image[i] = node[i];
    MPM_UNROLL for (int side = 0; side < 2; side++) {
      const int there = a.walls.mirror[2 * i + side] - node[i], twice = node[i] - there;
      if (twice < -2 * kMirrorReach || twice > 2 * kMirrorReach) continue;
      image[i] = there;
      axes |= 1 << i;
    }
  }
  for (int subset = 0; subset < 1 << D; subset++) {
    if ((subset & axes) != subset) continue;
    Vector<T, D> sign;
    int at[D];
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const bool reflected = subset >> i & 1;
      sign[i] = reflected ? T(-1) : T(1);
      at[i] = reflected ? image[i] : node[i];
    }
    const int64_t row = row_of(a, s, at);
    if (row >= 0) f(row, sign);
  }
}

// Mass of a node with its images, and its velocity before contact: zero without mass.
template <class T, int D>
MPM_HD NodeRow<T, D> free_node(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int local,
                               const NodeRow<T, D>& row) {
  NodeRow<T, D> r{row.mass, zero_vector<T, D>()};
  if (!s.mirrored) {
    MPM_UNROLL for (int i = 0; i < D; i++)
      r.value[i] = row.mass != T(0) ? row.value[i] / row.mass + s.gravity[i] : T(0);
    return r;
  }
  r.mass = T(0);
  for_images(a, s, local, [&](int64_t member, const Vector<T, D>& sign) {
    const NodeRow<T, D>& image = a.nodes[member];
    r.mass += image.mass;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r.value[i] += sign[i] * (image.value[i] + image.mass * s.gravity[i]);
  });
  MPM_UNROLL for (int i = 0; i < D; i++)
    r.value[i] = r.mass != T(0) ? r.value[i] / r.mass : T(0);
  return r;
}

// A node without mass has no velocity. At edges and corners the faces act one after another, in the order of the axes.
template <class T, int D>
MPM_HD NodeRow<T, D> update_node(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int local,
                                 const NodeRow<T, D>& row) {
  if (!s.active) return {T(0), zero_vector<T, D>()};
  const NodeRow<T, D> free = free_node(a, s, local, row);
  Vector<T, D> v = free.value;
  if (s.walled && free.mass != T(0)) {
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const int face = wall_face(a.walls, s, i, local);
      if (face >= 0) v = contact_velocity(a.walls.kind[face], v, wall_normal<T, D>(face), a.walls.friction[face]);
    }
  }
  return {row.mass, v};
}

// Adjoint of row `index`; `change` becomes that of the velocity change by gravity. A node and its images depend on the
// same sum, so the adjoint of the sum is that of all of them, reflected.
template <class T, int D>
MPM_HD NodeRow<T, D> update_node_backward(const GridUpdateBackwardArguments<T, D>& b, const SlotUpdate<T, D>& s,
                                          int local, int64_t index, Vector<T, D>& change) {
  const GridUpdateArguments<T, D>& a = b.forward;
  const NodeRow<T, D> row = a.nodes[index], grad = b.grad_updated[index];
  change = zero_vector<T, D>();
  if (!s.active) return {T(0), change};
  const NodeRow<T, D> free = free_node(a, s, local, row);
  if (free.mass == T(0)) return {grad.mass, change};
  if (s.mirrored) {
    for_images(a, s, local, [&](int64_t member, const Vector<T, D>& sign) {
      MPM_UNROLL for (int i = 0; i < D; i++)
        change[i] += sign[i] * b.grad_updated[member].value[i];
    });
  } else {
    change = grad.value;
  }
  if (s.walled) {
    Vector<T, D> before[D];  // velocity before each axis
    Vector<T, D> v = free.value;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      before[i] = v;
      const int face = wall_face(a.walls, s, i, local);
      if (face >= 0) v = contact_velocity(a.walls.kind[face], v, wall_normal<T, D>(face), a.walls.friction[face]);
    }
    MPM_UNROLL for (int i = D - 1; i >= 0; i--) {
      const int face = wall_face(a.walls, s, i, local);
      if (face >= 0)
        change =
            contact_adjoint(a.walls.kind[face], before[i], wall_normal<T, D>(face), a.walls.friction[face], change);
    }
  }
  NodeRow<T, D> result;
  result.mass = grad.mass;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    result.value[i] = change[i] / free.mass;
    result.mass += result.value[i] * (s.gravity[i] - free.value[i]);
  }
  change = (row.mass / free.mass) * change;
  return result;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
