#pragma once

#include <climits>
#include <cmath>
#include <cstdint>

#include "grid/friction.h"
#include "grid/geometry.h"
#include "grid/impulse.h"
#include "grid/lattice_node.h"

// Node momentum to node velocity, gravity, the walls of the domain and damping.
//
// A mirror makes its plane one of symmetry: node values are those of the particles together with their images behind
// the plane. Mass and momentum (gravity included) of a node and, reflected, of its image are summed; both nodes
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
  T damping = 1;  // share of the velocities after the walls that is left
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

// Whether a mirror may give the nodes of a block images.
template <class T, int D>
MPM_HD bool near_mirror(const Walls<T, D>& walls, const int corner[D], int face) {
  const int first = 2 * corner[face / 2] - walls.mirror[face];  // twice the distance from the plane
  return first <= 2 * kMirrorReach && first + 2 * (kBlockWidth - 1) >= -2 * kMirrorReach;
}

// Whether a contact face touches a block.
template <class T, int D>
MPM_HD bool near_wall(const Walls<T, D>& walls, const int corner[D], int face) {
  const int first = corner[face / 2];
  return face % 2 ? first + kBlockWidth > walls.node[face] : first <= walls.node[face];
}

// Values shared by the nodes of one slot.
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
    s.walled |= near_wall(a.walls, s.corner, 2 * i) || near_wall(a.walls, s.corner, 2 * i + 1);
  }
  if (a.walls.mirrored) {
    MPM_UNROLL for (int face = 0; face < 2 * D; face++)
      s.mirrored |= near_mirror(a.walls, s.corner, face);
  }
  if (a.gravity) {
    const T dt = a.scene_dt ? T(a.dt) * a.scene_dt[s.scene] : T(a.dt);
    MPM_UNROLL for (int i = 0; i < D; i++)
      s.gravity[i] = dt * a.gravity[s.scene * D + i];
  }
  return s;
}

// The contact face that acts on a node with this lattice index along an axis, or -1.
template <class T, int D>
MPM_HD int wall_face(const Walls<T, D>& walls, int axis, int node) {
  return node <= walls.node[2 * axis] ? 2 * axis : node >= walls.node[2 * axis + 1] ? 2 * axis + 1 : -1;
}

template <class T, int D>
MPM_HD Vector<T, D> wall_normal(int face) {
  Vector<T, D> n;
  MPM_UNROLL for (int i = 0; i < D; i++)
    n[i] = T(face == 2 * i) - T(face == 2 * i + 1);
  return n;
}

// The velocity v of a lattice node after the contact faces, which act one after another in the order of the axes;
// see(face, before, after) is called for each that acts.
template <class T, int D, class See>
MPM_HD Vector<T, D> after_walls(const Walls<T, D>& walls, const Vector<int, D>& node, Vector<T, D> v, See&& see) {
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const int face = wall_face(walls, i, node[i]);
    if (face < 0) continue;
    const Vector<T, D> before = v;
    v = contact_velocity(walls.kind[face], before, wall_normal<T, D>(face), walls.friction[face]);
    see(face, before, v);
  }
  return v;
}

// Row of a lattice node in the scene of the slot, or -1 where its block is inactive.
template <class T, int D>
MPM_HD int64_t row_of(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, const Vector<int, D>& node) {
  int block[D];
  MPM_UNROLL for (int i = 0; i < D; i++) {
    if (node[i] < 0 || node[i] >= a.geometry.blocks[i] * kBlockWidth) return -1;
    block[i] = node[i] / kBlockWidth;
  }
  const int slot = a.table[block_index(a.geometry, s.scene, block)];
  return slot < 0 || slot >= a.max_blocks ? -1 : int64_t(slot) * kBlockNodes<D> + node_in_block<D>(node.e);
}

// The mirror along an axis in which a lattice node has an image, or -1.
template <class T, int D>
MPM_HD int mirror_face(const Walls<T, D>& walls, int axis, int node) {
  int face = -1;
  MPM_UNROLL for (int side = 0; side < 2; side++) {
    const int twice = 2 * node - walls.mirror[2 * axis + side];
    if (twice >= -2 * kMirrorReach && twice <= 2 * kMirrorReach) face = 2 * axis + side;
  }
  return face;
}

// Calls f(row, sign, at) for a node and its images in the mirrors, 2^k of them where k mirrors meet; sign is the
// diagonal of the reflection, `at` its lattice index. The images of an image are the same nodes.
template <class T, int D, class F>
MPM_HD void for_images(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int local, F&& f) {
  const Vector<int, D> node = lattice_node<D>(s.corner, local);
  Vector<int, D> image;
  int axes = 0;  // bits of those along which there is an image
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const int face = mirror_face(a.walls, i, node[i]);
    image[i] = face < 0 ? node[i] : a.walls.mirror[face] - node[i];
    axes |= (face >= 0) << i;
  }
  for (int subset = 0; subset < 1 << D; subset++) {
    if ((subset & axes) != subset) continue;
    Vector<T, D> sign;
    Vector<int, D> at;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const bool reflected = subset >> i & 1;
      sign[i] = reflected ? T(-1) : T(1);
      at[i] = reflected ? image[i] : node[i];
    }
    const int64_t row = row_of(a, s, at);
    if (row >= 0) f(row, sign, at);
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
  for_images(a, s, local, [&](int64_t member, const Vector<T, D>& sign, const Vector<int, D>&) {
    const NodeRow<T, D>& image = a.nodes[member];
    r.mass += image.mass;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r.value[i] += sign[i] * (image.value[i] + image.mass * s.gravity[i]);
  });
  MPM_UNROLL for (int i = 0; i < D; i++)
    r.value[i] = r.mass != T(0) ? r.value[i] / r.mass : T(0);
  return r;
}

// A node without mass has no velocity.
template <class T, int D>
MPM_HD NodeRow<T, D> update_node(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int local,
                                 const NodeRow<T, D>& row) {
  if (!s.active) return {T(0), zero_vector<T, D>()};
  const NodeRow<T, D> free = free_node(a, s, local, row);
  Vector<T, D> v = free.value;
  if (s.walled && free.mass != T(0)) {
    const auto see = [](int, const Vector<T, D>&, const Vector<T, D>&) {};
    v = after_walls(a.walls, lattice_node<D>(s.corner, local), v, see);
  }
  return {row.mass, a.damping * v};
}

// The mirror that receives a component of the momentum of a lattice node, or -1 for none: that along the axis, or
// otherwise the first mirror in which the node has an image, since the two nodes exchange it.
template <class T, int D>
MPM_HD int mirror_of(const Walls<T, D>& walls, const Vector<int, D>& node, int axis) {
  int face = mirror_face(walls, axis, node[axis]);
  MPM_UNROLL for (int i = 0; i < D; i++)
    if (face < 0) face = mirror_face(walls, i, node[i]);
  return face;
}

// The impulse of a node on a face.
template <class T, int D>
MPM_HD Vector<T, D> wall_impulse(const GridUpdateArguments<T, D>& a, const SlotUpdate<T, D>& s, int local,
                                 const NodeRow<T, D>& row, int face) {
  const Vector<int, D> node = lattice_node<D>(s.corner, local);
  Vector<T, D> impulse = zero_vector<T, D>();
  const NodeRow<T, D> free = free_node(a, s, local, row);
  if (free.mass == T(0)) return impulse;
  after_walls(a.walls, node, free.value, [&](int acting, const Vector<T, D>& before, const Vector<T, D>& after) {
    if (acting == face) impulse = row.mass * (before + T(-1) * after);
  });
  MPM_UNROLL for (int i = 0; i < D; i++)
    if (s.mirrored && mirror_of(a.walls, node, i) == face)
      impulse[i] += row.value[i] + row.mass * (s.gravity[i] - free.value[i]);
  return impulse;
}

// Adjoint of the velocity v of a lattice node before the contact faces, from that after them.
template <class T, int D, class Impulses>
MPM_HD Vector<T, D> walls_adjoint(const Walls<T, D>& walls, const Vector<int, D>& node, const Vector<T, D>& v,
                                  Vector<T, D> grad, Impulses& impulses) {
  Vector<T, D> before[D], after[D];  // of each axis
  MPM_UNROLL for (int i = 0; i < D; i++)
    before[i] = after[i] = v;
  after_walls(walls, node, v, [&](int face, const Vector<T, D>& from, const Vector<T, D>& to) {
    before[face / 2] = from;
    after[face / 2] = to;
  });
  MPM_UNROLL for (int i = D - 1; i >= 0; i--) {
    const int face = wall_face(walls, i, node[i]);
    if (face < 0) continue;
    if constexpr (Impulses::wanted) grad = impulses.take(impulses.weight(face, node), before[i], after[i], grad);
    grad = contact_adjoint(walls.kind[face], before[i], wall_normal<T, D>(face), walls.friction[face], grad);
    if constexpr (Impulses::wanted) grad = grad + impulses.mass * impulses.weight(face, node);
  }
  return grad;
}

// The same for the mirrors, to the velocity v that the node and its images share; `momentum` becomes the adjoint of the
// node's own momentum, whose difference from its mass times v is the impulse.
template <class T, int D, class Impulses>
MPM_HD Vector<T, D> mirrors_adjoint(const Walls<T, D>& walls, const Vector<int, D>& node, const Vector<T, D>& gravity,
                                    const Vector<T, D>& v, const Vector<T, D>& grad, Impulses& impulses,
                                    Vector<T, D>& momentum) {
  momentum = zero_vector<T, D>();
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const int face = mirror_of(walls, node, i);
    if (face >= 0) momentum[i] = impulses.weight(face, node)[i];
  }
  return impulses.take(momentum, gravity, v, grad);
}

// Adjoint of the velocity that a node and its images share, reflected, from those of their velocities after the walls.
template <class T, int D>
MPM_HD Vector<T, D> shared_adjoint(const GridUpdateBackwardArguments<T, D>& b, const SlotUpdate<T, D>& s, int local,
                                   const Vector<T, D>& free, Vector<T, D> grad) {
  if (s.mirrored) {
    grad = zero_vector<T, D>();
    for_images(b.forward, s, local, [&](int64_t member, const Vector<T, D>& sign, const Vector<int, D>&) {
      MPM_UNROLL for (int i = 0; i < D; i++)
        grad[i] += sign[i] * b.grad_updated[member].value[i];
    });
  }
  grad = b.forward.damping * grad;
  NoImpulses none;
  return s.walled ? walls_adjoint(b.forward.walls, lattice_node<D>(s.corner, local), free, grad, none) : grad;
}

// The same with the adjoints of impulses, which differ from image to image; `own` becomes their contribution to the
// row of the node itself.
template <class T, int D, class ImpulsesOf>
MPM_HD Vector<T, D> shared_adjoint(const GridUpdateBackwardArguments<T, D>& b, const SlotUpdate<T, D>& s, int local,
                                   int64_t index, const Vector<T, D>& free, ImpulsesOf&& impulses, NodeRow<T, D>& own) {
  const GridUpdateArguments<T, D>& a = b.forward;
  Vector<T, D> sum = zero_vector<T, D>();
  bool itself = true;  // the node comes first; it may be its own image
  const auto add_member = [&](int64_t member, const Vector<T, D>& sign, const Vector<int, D>& node) {
    auto on_boundaries = impulses(s.scene, member);
    Vector<T, D> grad = a.damping * b.grad_updated[member].value, v, direct = zero_vector<T, D>();
    MPM_UNROLL for (int i = 0; i < D; i++)
      v[i] = sign[i] * free[i];
    grad = walls_adjoint(a.walls, node, v, grad, on_boundaries);
    if (s.mirrored) grad = mirrors_adjoint(a.walls, node, s.gravity, v, grad, on_boundaries, direct);
    if (itself) own = {on_boundaries.mass_grad, direct};
    itself = false;
    MPM_UNROLL for (int i = 0; i < D; i++)
      sum[i] += sign[i] * grad[i];
  };
  Vector<T, D> upright;
  MPM_UNROLL for (int i = 0; i < D; i++)
    upright[i] = T(1);
  if (s.mirrored)
    for_images(a, s, local, add_member);
  else
    add_member(index, upright, lattice_node<D>(s.corner, local));
  return sum;
}

// Adjoint of row `index`; `change` becomes that of the velocity change by gravity. A node and its images depend on the
// same sum, so the adjoint of the sum is the sum of their adjoints, reflected. `impulses(scene, row)` are
// `NodeImpulses` of a row, or `NoImpulses`.
template <class T, int D, class ImpulsesOf>
MPM_HD NodeRow<T, D> update_node_backward(const GridUpdateBackwardArguments<T, D>& b, const SlotUpdate<T, D>& s,
                                          int local, int64_t index, Vector<T, D>& change, ImpulsesOf&& impulses) {
  constexpr bool with_impulses = decltype(impulses(0, index))::wanted;
  const GridUpdateArguments<T, D>& a = b.forward;
  const NodeRow<T, D> row = a.nodes[index], grad = b.grad_updated[index];
  change = zero_vector<T, D>();
  if (!s.active) return {T(0), change};
  const NodeRow<T, D> free = free_node(a, s, local, row);
  if (free.mass == T(0)) return {grad.mass, change};
  NodeRow<T, D> own{T(0), zero_vector<T, D>()};
  Vector<T, D> sum;  // adjoint of the free velocity
  if constexpr (with_impulses)
    sum = shared_adjoint(b, s, local, index, free.value, impulses, own);
  else
    sum = shared_adjoint(b, s, local, free.value, grad.value);
  NodeRow<T, D> result{grad.mass + own.mass, own.value};
  change = (row.mass / free.mass) * sum;
  if constexpr (with_impulses) change = change + row.mass * result.value;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T by_velocity = sum[i] / free.mass;
    result.value[i] += by_velocity;
    result.mass += by_velocity * (s.gravity[i] - free.value[i]);
  }
  return result;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
