#pragma once

#include "grid/meridian.h"

// Contact of nodes with the obstacles of their scene: velocities after it, impulses, and adjoints.
namespace mpm {

inline namespace TORCH_MPM_ISA {

// The surfaces that a node meets: faces of obstacles, and walls of the domain.
template <class T, int D>
struct NodeContact {
  int count = 0;  // of faces
  int obstacle[D], face[D];
  Vector<T, D> at[D];     // where normals are read
  Vector<T, D> position;  // of the node, within the walls
  Vector<T, D> sign;      // of velocities there
  unsigned walls = 0;     // bits of those that the node is at or beyond

  MPM_HD void add(int k, int f, const Vector<T, D>& point) {
    obstacle[count] = k, face[count] = f, at[count] = point;
    count++;
  }
  MPM_HD bool meets(int k) const {
    bool found = false;
    for (int i = 0; i < count; i++) found = found || obstacle[i] == k;
    return found;
  }
};

// Of a box, that of the first axis among faces that are equally near, and of these the upper one; −1 of other shapes.
template <class T, int D>
MPM_HD int nearest_face(const ContactArguments<T, D>& a, const ObstaclePose<T, D>& pose, const Vector<T, D>& body) {
  if (pose.shape != ObstacleShape::box) return -1;
  T least = std::numeric_limits<T>::max();
  int face = 0;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const T depth = rounded_depth(a, T(0.5) * pose.row->extent[i] - abs(body[i]));
    if (!(depth < least)) continue;
    least = depth;
    face = 2 * i + (rounded_depth(a, body[i]) < T(0) ? 0 : 1);
  }
  return face;
}

// ---- nodes that one surface alone is near, as most have it

template <class T, int D>
struct NodeTouch {
  static constexpr int none = -1, several = -2;
  int obstacle = none;  // or `several`, where `find_surfaces` has to find what is near
  Contact kind;
  T friction;
  Vector<T, D> normal, velocity;  // unit normal into the material, velocity of the surface

  MPM_HD Vector<T, D> after(const Vector<T, D>& v) const {
    const Vector<T, D> u = v + T(-1) * velocity;
    return v + (contact_velocity(kind, u, normal, friction) + T(-1) * u);
  }
};

// Finds the surface that a node meets, from the obstacles near its slot.
template <class T, int D>
class NearestSurface {
 public:
  // `at_wall`: whether the position is on a wall, from where surfaces beside it are seen, too.
  MPM_HD NearestSurface(const ContactArguments<T, D>& a, const Vector<T, D>& position, bool at_wall = false)
      : a_(a), position_(position), farthest_(a.rounding + (at_wall ? beside_wall(a) : T(0))) {}

  MPM_HD void operator()(int k, const ObstaclePose<T, D>& pose) {
    Vector<T, D> normal;
    T other;
    const Vector<T, D> body = to_body(pose, position_);
    const T distance = surface(pose, body, normal, &other);
    if (!(distance < nearest_)) {
      if (distance < second_) second_ = distance;
      return;
    }
    second_ = nearest_ < other ? nearest_ : other;
    nearest_ = distance;
    if (!(distance <= farthest_)) return;
    if (pose.shape == ObstacleShape::box) {
      const int face = nearest_face(a_, pose, body);
      MPM_UNROLL for (int i = 0; i < D; i++)
        normal[i] = T(face == 2 * i + 1) - T(face == 2 * i);
    }
    touch_ = {k, pose.contact, pose.row->friction, pose.rotation * normal, velocity_at(pose, position_)};
  }

  MPM_HD bool is_inside() const { return nearest_ <= a_.rounding; }

  // Of the obstacles that were given. `walled` is whether walls are near.
  MPM_HD NodeTouch<T, D> found(bool walled) {
    const T wall = walled ? nearest_wall(a_, position_) : std::numeric_limits<T>::max();
    const bool joins = is_inside() && (second_ <= away() || (wall <= away() && !is_along_walls()));
    if (joins || wall <= near_wall(a_)) touch_.obstacle = NodeTouch<T, D>::several;
    return touch_;
  }

  // Of a node at a wall or beyond, seen from the point of the wall; `sign` as `within_walls` gives it. A surface that
  // is perpendicular to the wall leaves no gap beside it; points beside the wall may be nearer to it by its curvature.
  MPM_HD NodeTouch<T, D> at_wall(const Vector<T, D>& sign) {
    NodeTouch<T, D> touch = {};
    if (nearest_ > farthest_) return touch;
    const bool outside = nearest_ > T(0.01 * a_.dx);
    if ((is_inside() && second_ > away()) || (outside && second_ > farthest_)) {
      if (is_along_walls(&sign)) return outside ? touch : touch_;
    }
    touch.obstacle = NodeTouch<T, D>::several;
    return touch;
  }

  // How near a node at a wall is to it.
  MPM_HD static T near_wall(const ContactArguments<T, D>& a) { return a.rounding + T(1e-6 * a.dx); }

 private:
  // How far the point beside a wall is, from which `find_surfaces` looks into gaps. Samples of distances have slopes up
  // to √D.
  MPM_HD static T beside_wall(const ContactArguments<T, D>& a) { return T(1.001 * D) * seam_of(a); }

  // Faces and walls within this distance may join the nearest surface.
  MPM_HD T away() const { return 2 * seam_of(a_) - nearest_; }

  // Whether the normal of the nearest surface and its velocity are parallel to all walls that are near, and to mirrors
  // that the node is behind. Contact with the surface alone then keeps the velocity that the walls gave the node.
  MPM_HD bool is_along_walls(const Vector<T, D>* sign = nullptr) {
    constexpr double parallel = 1e-6;  // sine of the angle
    const T fastest = T(parallel) * length(touch_.velocity), near = near_wall(a_) > away() ? near_wall(a_) : away();
    bool along = true;
    MPM_UNROLL for (int face = 0; face < 2 * D; face++) {
      const int axis = face / 2;
      const bool mirrored = sign && (*sign)[axis] < T(0);
      if (a_.wall_kind[face] == Contact::open || !(mirrored || wall_height(a_, face, position_) <= near)) continue;
      along = along && abs(touch_.normal[axis]) <= T(parallel) && abs(touch_.velocity[axis]) <= fastest;
      touch_.normal[axis] = touch_.velocity[axis] = T(0);
    }
    return along;
  }

  const ContactArguments<T, D>& a_;
  const Vector<T, D> position_;
  const T farthest_;  // distance of the surfaces that count
  T nearest_ = std::numeric_limits<T>::max(), second_ = std::numeric_limits<T>::max();
  NodeTouch<T, D> touch_ = {};
};

// ---- nodes near several surfaces

// The least deep obstacle that a position is in, −1 for none. Of equally deep ones the stricter counts, and then that
// of more friction, as `SolidAt` has it.
template <class Poses, class T, int D>
MPM_HD int obstacle_around(bool wanted, const Poses& poses, const Vector<T, D>& x) {
  const auto& a = poses.a;
  int found = -1;
  T least = T(0);
  MPM_LOOP for (uint64_t left = wanted ? poses.s.near : 0; any_of_warp(left != 0); left &= left - 1) {
    const int k = lowest_bit(left);
    Vector<T, D> normal;
    T beyond;
    const T distance = height_above(left != 0, poses, k, -1, x, normal, beyond);
    if (!left || !(distance <= a.rounding)) continue;
    const T depth = rounded_depth(a, T(0) - distance);
    if (found >= 0 && depth > least) continue;
    if (found >= 0 && depth == least) {
      const int kind = int(a.kind[k].contact), known = int(a.kind[found].contact);
      if (kind > known) continue;
      if (kind == known && !(poses.s.row[k].friction > poses.s.row[found].friction)) continue;
    }
    found = k, least = depth;
  }
  return found;
}

// Adds the faces that a node inside obstacle `inside` meets; a negative one adds none.
template <class Poses, class T, int D>
MPM_HD void find_in_solid(const Poses& poses, int inside, NodeContact<T, D>& c) {
  const auto& a = poses.a;
  int in_space = inside;
  if constexpr (D == 3) {
    Vector<T, 2> place = zero_vector<T, 2>();
    const bool in_plane = is_in_meridian(poses, inside, c.position, place);
    if (any_of_warp(in_plane)) {
      int count = 0, face[D];
      find_in_meridian(in_plane, a, inside, place, count, face);
      join_warp();
      MPM_LOOP for (int i = 0; i < count; i++)
        c.add(inside, face[i], c.position);
    }
    if (in_plane) in_space = -1;
  }
  if (any_of_warp(in_space >= 0)) {
    SolidAt<Poses, T, D> solid(poses, c.position);
    solid.find(in_space >= 0);
    const auto& foot = solid.foot();
    MPM_LOOP for (int i = 0; i < foot.count; i++) {
      const auto& face = solid.face(i);
      const bool frozen = face.flat && a.kind[face.obstacle].shape == ObstacleShape::sampled;
      c.add(face.obstacle, face.face, frozen ? face.at : c.position);
    }
  }
  if (inside >= 0 && c.count == 0) c.add(inside, -1, c.position);  // deep inside
}

template <class Poses, class T, int D>
MPM_HD_CALL void find_surfaces(bool wanted, const Poses& poses, const Vector<T, D>& position, NodeContact<T, D>& c) {
  const auto& a = poses.a;
  c.position = within_walls(a, position, T(0), c.sign);
  int around = obstacle_around(wanted, poses, c.position);
  const T near = NearestSurface<T, D>::near_wall(a);
  MPM_LOOP for (int face = 0; wanted && face < 2 * D; face++) {
    if (a.wall_kind[face] != Contact::open && wall_height(a, face, c.position) <= near) c.walls |= 1u << face;
  }
  const bool in_gap = wanted && around < 0 && c.walls;  // between an obstacle and a wall
  if (any_of_warp(in_gap)) {
    Vector<T, D> sign;
    const Vector<T, D> beside = within_walls(a, position, seam_of(a), sign);
    const int there = obstacle_around(in_gap, poses, beside);
    if (there >= 0) around = there, c.position = beside;
  }
  if (any_of_warp(around >= 0)) find_in_solid(poses, around, c);
}

// ---- any node

// `Exact`: a node at a wall always meets several surfaces, whose derivatives are those of the walls, too.
template <bool Exact = false, class Poses, class T, int D>
MPM_HD NodeTouch<T, D> touch_of_node(const Poses& poses, const Vector<T, D>& position) {
  if (poses.s.near == 0) return {};
  Vector<T, D> sign = zero_vector<T, D>();
  const bool at_wall =
      !Exact && poses.s.walled && nearest_wall(poses.a, position) <= NearestSurface<T, D>::near_wall(poses.a);
  NearestSurface<T, D> nearest(poses.a, at_wall ? within_walls(poses.a, position, T(0), sign) : position, at_wall);
  uint64_t left = poses.s.touching, others = poses.s.near & ~left;
  MPM_LOOP while (left) {
    nearest(lowest_bit(left), poses[lowest_bit(left)]);
    left &= left - 1;
    if (!left && (at_wall || nearest.is_inside())) left = others, others = 0;
  }
  return at_wall ? nearest.at_wall(sign) : nearest.found(poses.s.walled);
}

// The contact of a node that meets the surface of one obstacle, or none if k is negative.
template <class Poses, class T, int D>
MPM_HD void meet_alone(const Poses& poses, int k, const Vector<T, D>& position, NodeContact<T, D>& c) {
  c.position = position;
  MPM_UNROLL for (int i = 0; i < D; i++)
    c.sign[i] = T(1);
  if (k >= 0) c.add(k, nearest_face(poses.a, poses[k], to_body(poses[k], position)), position);
}

// Finds the surfaces that a node at a position meets; `c` has none yet. By all threads of a warp, as `any_of_warp`.
template <class T, int D>
MPM_HD void find_contact(bool wanted, const SlotPoses<T, D>& poses, const Vector<T, D>& position,
                         NodeContact<T, D>& c) {
  int k = NodeTouch<T, D>::none;
  if (wanted) k = touch_of_node<true>(poses, position).obstacle;
  const bool several = k == NodeTouch<T, D>::several;
  if (any_of_warp(several)) {
    find_surfaces(several, poses, position, c);
    join_warp();
  }
  if (!several) meet_alone(poses, k, position, c);
}

// Adds that of face i of a contact, whose obstacle has the given pose.
template <class S, class T, int D>
MPM_HD void add_face(const ObstaclePose<S, D>& pose, const NodeContact<T, D>& contact, int i,
                     Constraints<S, D>& added) {
  Constraint<S, D>& c = added.e[added.count++];
  T beyond;
  Vector<S, D> normal;
  face_height(pose, contact.face[i], to_body(pose, contact.at[i]), normal, beyond);
  c.owner = contact.obstacle[i];
  c.kind = pose.contact;
  c.friction = pose.row->friction;
  c.normal = pose.rotation * normal;
  c.velocity = velocity_at(pose, contact.position);
}

template <class S, class T, int D>
MPM_HD void add_constant(const Constraint<T, D>& c, Constraints<S, D>& added) {
  Constraint<S, D>& r = added.e[added.count++];
  r.owner = c.owner, r.kind = c.kind, r.friction = lift<S>(c.friction);
  MPM_UNROLL for (int i = 0; i < D; i++)
    r.normal[i] = lift<S>(c.normal[i]), r.velocity[i] = lift<S>(c.velocity[i]);
}

// The walls that a node meets beside obstacles keep the normal velocity that the grid update gave it. Sticky ones leave
// the node to the obstacle.
template <class S, class T, int D>
MPM_HD void add_walls(const ContactArguments<T, D>& a, const NodeContact<T, D>& contact, Constraints<S, D>& c) {
  MPM_LOOP for (int face = 0; face < 2 * D; face++) {
    if (!(contact.walls >> face & 1) || a.wall_kind[face] == Contact::sticky) continue;
    Constraint<S, D> wall;
    wall.owner = -1;
    wall.kind = a.wall_kind[face] == Contact::mirror ? Contact::slip : a.wall_kind[face];
    wall.friction = S(T(0));
    wall.velocity = zero_vector<S, D>();
    bool known = false;
    MPM_UNROLL for (int i = 0; i < D; i++)
      wall.normal[i] = S(face == 2 * i ? 1 : face == 2 * i + 1 ? -1 : 0);
    for (int i = 0; i < c.count; i++) known = known || abs(value_of(dot(c.e[i].normal, wall.normal))) > T(0.99);
    if (!known) c.e[c.count++] = wall;
  }
}

template <class Poses, class T, int D>
MPM_HD void find_constraints(const Poses& poses, const NodeContact<T, D>& contact, Constraints<T, D>& c) {
  c.count = 0;
  MPM_LOOP for (int i = 0; i < contact.count; i++)
    add_face(poses[contact.obstacle[i]], contact, i, c);
  add_walls(poses.a, contact, c);
}

template <class T, int D>
MPM_HD Vector<T, D> reflected(const Vector<T, D>& sign, Vector<T, D> v) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    v[i] = sign[i] * v[i];
  return v;
}

// What a node meets, in the form in which it changes the velocity.
template <class T, int D>
struct alignas(16) MetSurfaces {
  int any = 0;
  Vector<T, D> sign;
  Constraints<T, D> constraints;

  MPM_HD Vector<T, D> after(const Vector<T, D>& v) const {
    return any ? reflected(sign, after_constraints(constraints, reflected(sign, v))) : v;
  }
};

template <class T, int D>
MPM_HD_CALL void find_met(bool wanted, const SlotPoses<T, D>& poses, const Vector<T, D>& position,
                          MetSurfaces<T, D>& met) {
  NodeContact<T, D> contact;
  find_surfaces(wanted, poses, position, contact);
  join_warp();
  met.any = contact.count > 0;
  if (!met.any) return;
  met.sign = contact.sign;
  find_constraints(poses, contact, met.constraints);
}

// Replaces the velocity of a node by that after contact with all surfaces that are near.
template <class T, int D>
MPM_HD_CALL void apply_surfaces(bool wanted, const SlotPoses<T, D>& poses, const Vector<T, D>& position,
                                Vector<T, D>& v) {
  MetSurfaces<T, D> met;
  find_met(wanted, poses, position, met);
  join_warp();
  if (wanted) v = met.after(v);
}

// The velocity v of a node after contact. By all threads of a warp, also of nodes that meet nothing.
template <class T, int D>
MPM_HD Vector<T, D> after_contact(const SlotPoses<T, D>& poses, const NodeTouch<T, D>& touch,
                                  const Vector<T, D>& position, Vector<T, D> v) {
  const bool several = touch.obstacle == NodeTouch<T, D>::several;
  if (any_of_warp(several)) {
    apply_surfaces(several, poses, position, v);
    join_warp();
  }
  return touch.obstacle >= 0 ? touch.after(v) : v;
}

// ---- surfaces that are found once

// Of a node of a scene, never zero.
template <class T, int D>
MPM_HD unsigned long long key_of_node(const ContactArguments<T, D>& a, int scene, const int (&corner)[D], int local) {
  unsigned long long key = static_cast<unsigned long long>(scene);
  MPM_UNROLL for (int i = 0; i < D; i++)
    key = key * static_cast<unsigned long long>(a.geometry.blocks[i] * kBlockWidth) +
          static_cast<unsigned long long>(lattice_index<D>(corner, i, local));
  return key + 1;
}

#ifdef __CUDA_ARCH__
constexpr unsigned long long kBeingWritten = 1ull << 63;
constexpr int kMostProbes = 8;

__device__ inline int place_of_key(unsigned long long key, int probe, int size) {
  return int((key * 0x9E3779B97F4A7C15ull >> 40) + unsigned(probe)) & (size - 1);  // Fibonacci hashing
}
#endif

// The place of the surfaces of a node in the table, −1 if they are not known.
template <class T, int D>
MPM_HD int known_place([[maybe_unused]] const ContactArguments<T, D>& a, [[maybe_unused]] unsigned long long key) {
#ifdef __CUDA_ARCH__
  if (!a.known_nodes) return -1;
  MPM_LOOP for (int probe = 0; probe < kMostProbes; probe++) {
    const int at = place_of_key(key, probe, a.known_size);
    unsigned long long found;
    asm volatile("ld.acquire.gpu.global.u64 %0, [%1];" : "=l"(found) : "l"(a.known_nodes + at) : "memory");
    if (found == key) return at;
    if (found == 0) break;
  }
#endif
  return -1;
}

// Reads the surfaces at a place of the table.
template <class T, int D>
MPM_HD void recall([[maybe_unused]] const ContactArguments<T, D>& a, [[maybe_unused]] int place,
                   [[maybe_unused]] MetSurfaces<T, D>& met) {
#ifdef __CUDA_ARCH__
  static_assert(sizeof(met) % sizeof(uint4) == 0);
  const uint4* const stored = reinterpret_cast<const uint4*>(static_cast<const MetSurfaces<T, D>*>(a.known) + place);
  MPM_LOOP_OF(8)
  for (unsigned k = 0; k < sizeof(met) / sizeof(uint4); k++) reinterpret_cast<uint4*>(&met)[k] = __ldcg(stored + k);
#endif
}

// Whether the obstacles of a scene stay what they are now.
template <class T, int D>
MPM_HD bool obstacles_rest(const ContactArguments<T, D>& a, int scene) {
  const double time = contact_time(a, scene);
  const ObstacleRow<T, D>* const row = rows_of_scene(a, scene);
  bool rest = a.step_stride == 0;
  MPM_LOOP for (int k = 0; rest && k < a.obstacles; k++) {
    const ObstacleKind& kind = a.kind[k];
    if (kind.scene >= 0 && kind.scene != scene) continue;
    rest = time >= kind.start && kind.end > std::numeric_limits<double>::max();
    rest = rest && is_zero(row[k].velocity) && is_zero(row[k].angular_velocity);
  }
  return rest;
}

// Stores the surfaces of a node where the obstacles rest and there is room.
template <class T, int D>
MPM_HD void remember([[maybe_unused]] const ContactArguments<T, D>& a, [[maybe_unused]] int scene,
                     [[maybe_unused]] unsigned long long key, [[maybe_unused]] const MetSurfaces<T, D>& met) {
#ifdef __CUDA_ARCH__
  if (!a.known_nodes || !obstacles_rest(a, scene)) return;
  MPM_LOOP for (int probe = 0; probe < kMostProbes; probe++) {
    const int at = place_of_key(key, probe, a.known_size);
    const unsigned long long before = atomicCAS(a.known_nodes + at, 0ull, key | kBeingWritten);
    if ((before & ~kBeingWritten) == key) return;  // by another thread
    if (before != 0) continue;
    static_cast<MetSurfaces<T, D>*>(a.known)[at] = met;
    __threadfence();
    atomicExch(a.known_nodes + at, key);
    return;
  }
#endif
}

// Of a node whose thread looks at it alone. A node at a wall or beyond sees the obstacles from the point of the wall,
// or from beside that (`find_surfaces`), where distances differ by no more than the way.
template <class T, int D>
MPM_HD NodeTouch<T, D> lone_touch(const ContactArguments<T, D>& a, int scene, const int (&corner)[D], int local) {
  if (!acts_in(a, scene)) return {};
  Vector<T, D> position = node_position(a, corner, local), sign = zero_vector<T, D>();
  const bool at_wall = nearest_wall(a, position) <= NearestSurface<T, D>::near_wall(a);
  if (at_wall) position = within_walls(a, position, T(0), sign);
  NearestSurface<T, D> nearest(a, position, at_wall);
  const ObstacleRow<T, D>* const row = rows_of_scene(a, scene);
  MPM_LOOP for (int k = 0; k < a.obstacles; k++) {
    const ObstaclePose<T, D> pose = obstacle_pose(a, a.kind[k], row[k], scene);
    if (pose.acts) nearest(k, pose);
  }
  if (at_wall) return nearest.at_wall(sign);
  return nearest.is_inside() ? nearest.found(is_walled(a, corner)) : NodeTouch<T, D>{};
}

template <class T, int D>
MPM_HD_CALL void apply_several(bool wanted, const ContactArguments<T, D>& a, int scene, const int (&corner)[D],
                               int local, Vector<T, D>& v) {
  MetSurfaces<T, D> met;
  const unsigned long long key = key_of_node(a, scene, corner, local);
  const int place = wanted ? known_place(a, key) : -1;
  if (place >= 0) recall(a, place, met);
  const bool searches = wanted && place < 0;
  if (any_of_warp(searches)) {
    ContactSlot<T, D> slot;
    if (searches) slot = contact_slot(a, scene, corner);
    find_met(searches, SlotPoses<T, D>(a, slot), node_position(a, corner, local), met);
    join_warp();
    if (searches) remember(a, scene, key, met);
  }
  if (wanted) v = met.after(v);
}

// The nodes of a thread that meet several surfaces, by their number in the order in which the thread looks at nodes.
// Numbers from `most` on share a bit.
struct SeveralNodes {
  static constexpr int most = 63;
  uint64_t bits = 0;

  MPM_HD bool any() const { return bits != 0; }
  MPM_HD bool may_have(int number) const { return bits >> (number < most ? number : most) & 1; }
  MPM_HD void add(int number) { bits |= uint64_t(1) << (number < most ? number : most); }
};

// Replaces the velocity of the node `number` of a thread, if it is one of `nodes`, by that after contact, and returns
// whether it is. By all threads of a warp, as `any_of_warp`. Kernels call it in a pass of its own, after that over all
// nodes, where few values are live: nvcc keeps values that are live across a deep call in memory.
template <class T, int D>
MPM_HD bool meet_several(const SeveralNodes& nodes, int number, bool has_mass, const ContactArguments<T, D>& a,
                         int scene, const int (&corner)[D], int local, Vector<T, D>& v) {
  bool several = has_mass && nodes.may_have(number);
  if (several && number >= nodes.most)
    several = lone_touch(a, scene, corner, local).obstacle == NodeTouch<T, D>::several;
  if (any_of_warp(several)) {
    apply_several(several, a, scene, corner, local, v);
    join_warp();
  }
  return several;
}

// The touch of a node, and the place of its surfaces in the table where it meets several; −1 if they are not known.
template <class T, int D>
struct alignas(16) KnownTouch {
  NodeTouch<T, D> touch;
  int place = -1;

  KnownTouch() = default;
  MPM_HD KnownTouch(const ContactArguments<T, D>& a, int scene, const int (&corner)[D], int local)
      : touch(lone_touch(a, scene, corner, local)) {
    if (touch.obstacle == touch.several) place = known_place(a, key_of_node(a, scene, corner, local));
  }
  // Whether several surfaces are met that are not known.
  MPM_HD bool is_sought() const { return touch.obstacle == touch.several && place < 0; }
  // The velocity v after contact, if that needs no search for surfaces; `searches` is set if it does.
  MPM_HD Vector<T, D> after(const ContactArguments<T, D>& a, const Vector<T, D>& v, bool& searches) const {
    searches = is_sought();
    if (touch.obstacle >= 0) return touch.after(v);
    if (touch.obstacle != touch.several || searches) return v;
    MetSurfaces<T, D> met;
    recall(a, place, met);
    return met.after(v);
  }
};

// ---- passes over the nodes of a slot

template <class T, int D>
MPM_HD bool has_mass(const ContactArguments<T, D>& a, int64_t node) {
  return !(a.mass && a.mass[node * a.mass_stride] == T(0));
}

template <class T, int D>
MPM_HD bool may_meet(const ContactArguments<T, D>& a, const ContactSlot<T, D>& s, int64_t node) {
  return s.near && has_mass(a, node);
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

// The nodes lane, lane + Lanes, ... of a slot.
template <int Lanes, class T, int D>
MPM_HD void slot_contact(const ContactArguments<T, D>& a, int slot, int lane) {
  const SlotPoses<T, D> poses(a, slot);
  const ContactSlot<T, D>& s = poses.s;
  const int64_t first = int64_t(slot) * kBlockNodes<D>;
  for (int n = 0; n < kBlockNodes<D> / Lanes; n++) {
    const int local = lane + n * Lanes;
    const Vector<T, D> position = node_position(a, s.corner, local);
    NodeTouch<T, D> touch;
    if (may_meet(a, s, first + local)) touch = touch_of_node(poses, position);
    store_node(a.result, first + local,
               after_contact(poses, touch, position, load_node<T, D>(a.velocity, a.stride, first + local)));
  }
}

// The velocities that obstacles take from a node. What walls give beside obstacles counts as that of the first.
template <class T, int D>
struct TakenVelocities {
  int count = 0;
  int obstacle[Constraints<T, D>::most];
  Vector<T, D> taken[Constraints<T, D>::most];
};

// Of a node at a wall or a mirror with the given signs.
template <class T, int D>
MPM_HD void take_velocities(const Constraints<T, D>& c, const Vector<T, D>& sign, const Vector<T, D>& v,
                            TakenVelocities<T, D>& result) {
  Vector<T, D> change[Constraints<T, D>::most];
  changes_of_constraints<T, D>(c, reflected(sign, v), change);
  result.count = c.count;
  for (int i = 0; i < c.count; i++) {
    result.obstacle[i] = c.e[i].owner < 0 ? c.e[0].owner : c.e[i].owner;
    result.taken[i] = T(-1) * reflected(sign, change[i]);
  }
}

template <class T, int D>
MPM_HD_CALL void find_taken(bool wanted, const SlotPoses<T, D>& poses, const NodeContact<T, D>& contact,
                            const Vector<T, D>& v, TakenVelocities<T, D>& result) {
  if (!wanted) return;
  Constraints<T, D> c;
  find_constraints(poses, contact, c);
  take_velocities(c, contact.sign, v, result);
}

// ---- adjoints

// The adjoint of the changes by obstacles at a node: grad of the velocity after contact, less that of the impulses.
template <class T, int D>
struct NodeAdjoint {
  Vector<T, D> before, grad;  // velocity before contact, adjoint of that after it
  Vector<T, D> weight[D];     // of the change by each face
};

// Derivative of the adjoint's scalar along a direction, from the constraints and the velocity as dual numbers.
template <class T, int D>
MPM_HD T directional_derivative(const Constraints<Dual<T>, D>& c, const NodeContact<T, D>& contact,
                                const Vector<Dual<T>, D>& v, const NodeAdjoint<T, D>& node) {
  Vector<Dual<T>, D> change[Constraints<Dual<T>, D>::most];
  changes_of_constraints<Dual<T>, D>(c, v, change);
  T sum = T(0);
  for (int i = 0; i < c.count; i++) {
    const Vector<T, D>& weight = node.weight[c.e[i].owner < 0 ? 0 : i];
    MPM_UNROLL for (int j = 0; j < D; j++)
      sum += weight[j] * contact.sign[j] * change[i][j].derivative;
  }
  return sum;
}

// Adds what contact adds to the adjoint of the velocity before it.
template <class T, int D>
MPM_HD_CALL void add_velocity_adjoint(bool wanted, const SlotPoses<T, D>& poses, const NodeContact<T, D>& contact,
                                      const NodeAdjoint<T, D>& node, Vector<T, D>& result) {
  if (!wanted) return;
  using S = Dual<T>;
  Constraints<T, D> values;
  find_constraints(poses, contact, values);
  Constraints<S, D> c;
  for (int i = 0; i < values.count; i++) add_constant(values.e[i], c);
  for (int axis = 0; axis < D; axis++) {
    Vector<S, D> v;
    MPM_UNROLL for (int i = 0; i < D; i++)
      v[i] = S(contact.sign[i] * node.before[i], i == axis ? contact.sign[i] : T(0));
    result[axis] += directional_derivative(c, contact, v, node);
  }
}

// Adjoint of a parameter of an obstacle by a node that meets it.
template <class T, int D>
MPM_HD T parameter_adjoint(const SlotPoses<T, D>& poses, const NodeContact<T, D>& contact, int k, int parameter,
                           const NodeAdjoint<T, D>& node) {
  using S = Dual<T>;
  const auto& a = poses.a;
  ObstacleRow<S, D> row;
  const T* const values = reinterpret_cast<const T*>(poses.s.row + k);
  S* const lifted = reinterpret_cast<S*>(&row);
  for (int i = 0; i < ObstacleRow<T, D>::width; i++) lifted[i] = S(values[i], i == parameter ? T(1) : T(0));
  const ObstaclePose<S, D> pose = obstacle_pose(a, a.kind[k], row, poses.s.scene);
  Constraints<S, D> c;
  for (int i = 0; i < contact.count; i++) {
    if (contact.obstacle[i] == k) {
      add_face(pose, contact, i, c);
    } else {
      Constraints<T, D> other;
      add_face(poses[contact.obstacle[i]], contact, i, other);
      add_constant(other.e[0], c);
    }
  }
  add_walls(a, contact, c);
  Vector<S, D> v;
  MPM_UNROLL for (int i = 0; i < D; i++)
    v[i] = lift<S>(contact.sign[i] * node.before[i]);
  return directional_derivative(c, contact, v, node);
}

// Nodes of a slot that one lane looks at.
template <int Lanes, class T, int D>
struct LaneNodes {
  static constexpr int count = kBlockNodes<D> / Lanes;
  NodeContact<T, D> contact[count];
  NodeAdjoint<T, D> adjoint[count];
};

// Sets the adjoint of a node after contact and by the impulses on obstacles; the adjoint of its mass. By all threads of
// a warp, as `any_of_warp`.
template <class T, int D, class Impulses>
MPM_HD T set_adjoint(const SlotPoses<T, D>& poses, const NodeContact<T, D>& contact, const Vector<int, D>& at,
                     const Impulses& impulses, NodeAdjoint<T, D>& node) {
  for (int i = 0; i < contact.count; i++) node.weight[i] = node.grad;
  T mass_grad = T(0);
  if constexpr (Impulses::wanted) {
    for (int i = 0; i < contact.count; i++)
      node.weight[i] = node.grad + (T(0) - impulses.mass) * impulses.weight(contact.obstacle[i], at);
    if (any_of_warp(contact.count > 0)) {
      TakenVelocities<T, D> taken;
      find_taken(contact.count > 0, poses, contact, node.before, taken);
      join_warp();
      for (int i = 0; i < taken.count; i++) mass_grad += dot(impulses.weight(taken.obstacle[i], at), taken.taken[i]);
    }
  }
  return mass_grad;
}

// Adds the adjoint of the parameters of obstacle k by the nodes of a lane.
template <int Lanes, class T, int D>
MPM_HD_CALL void add_row_adjoint(bool wanted, const SlotPoses<T, D>& poses, const LaneNodes<Lanes, T, D>& nodes, int k,
                                 T (&sum)[ObstacleRow<T, D>::width]) {
  for (int n = 0; wanted && n < nodes.count; n++) {
    if (!nodes.contact[n].meets(k)) continue;
    for (int i = 0; i < ObstacleRow<T, D>::width; i++)
      sum[i] += parameter_adjoint(poses, nodes.contact[n], k, i, nodes.adjoint[n]);
  }
}

// `sum_lanes` adds a number over the lanes of a slot; the first lane gets the sum. `impulses(scene, node)` are
// `NodeImpulses` of a node, or `NoImpulses`.
template <int Lanes, class T, int D, class SumLanes, class ImpulsesOf>
MPM_HD void slot_contact_backward(const ContactArguments<T, D>& a, int slot, int lane, SumLanes&& sum_lanes,
                                  ImpulsesOf&& impulses) {
  constexpr int width = ObstacleRow<T, D>::width;
  const SlotPoses<T, D> poses(a, slot);
  const ContactSlot<T, D>& s = poses.s;
  const int64_t first = int64_t(slot) * kBlockNodes<D>;
  LaneNodes<Lanes, T, D> nodes;
  for (int n = 0; n < nodes.count; n++) {
    const int local = lane + n * Lanes;
    NodeContact<T, D>& contact = nodes.contact[n];
    NodeAdjoint<T, D>& node = nodes.adjoint[n];
    find_contact(may_meet(a, s, first + local), poses, node_position(a, s.corner, local), contact);
    node.before = load_node<T, D>(a.velocity, a.stride, first + local);
    node.grad = load_node<T, D>(a.grad, a.grad_stride, first + local);
    Vector<T, D> result = node.grad;
    const T mass_grad =
        set_adjoint(poses, contact, lattice_node<D>(s.corner, local), impulses(s.scene, first + local), node);
    if (any_of_warp(contact.count > 0)) {
      add_velocity_adjoint(contact.count > 0, poses, contact, node, result);
      join_warp();
    }
    store_node(a.result, first + local, result, mass_grad);
  }
  for (int k = 0; a.row_grad && k < a.obstacles; k++) {
    const bool near = s.near >> k & 1;
    T sum[width] = {};
    if (any_of_warp(near)) {
      add_row_adjoint(near, poses, nodes, k, sum);
      join_warp();
    }
    for (int i = 0; i < width; i++) {
      const T total = sum_lanes(sum[i]);
      if (lane == 0) a.row_grad[(int64_t(slot) * a.obstacles + k) * width + i] = total;
    }
  }
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
