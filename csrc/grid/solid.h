#pragma once

#include "grid/constraints.h"
#include "grid/shapes.h"

// All obstacles of a scene as one solid: the surfaces that a node inside it meets.
//
// Free space is what lies outside all obstacles. A node inside meets the surfaces of the point of free space that is
// nearest to it, its foot: one face, or all that join at an inner edge or corner. Faces that lie inside another
// obstacle, on one, or at a wall of the domain that they look at, are no surfaces of free space; so the seam of two
// boxes does not act. Candidates for the foot are the feet on each face, and the points where two or three faces meet,
// that are exposed: a step from there into free space leaves all obstacles. Of these that of the least depth counts,
// where the depth below several faces is the largest of those below each; so walls of tanks may be as thin at a corner
// as elsewhere. The tip of a hollow cone on its axis is a corner of two faces, both in the meridian of the node.
//
// Nodes at a wall of the domain or beyond see the obstacles as the nearest point of the wall does, those behind a
// mirror as their images do.
namespace mpm {

constexpr double kReach = 3;    // cells: how far from free space nodes meet its faces
constexpr double kSeam = 0.1;   // cells: half of it is the width of gaps and the height of steps that count as closed
constexpr double kSame = 0.94;  // cosine between normals that count as one, of shapes known by their distance alone
constexpr int kMostFaces = 12;  // that a node looks at, the nearest ones

inline namespace TORCH_MPM_ISA {

// What the nodes of a slot share.
template <class T, int D>
struct ContactSlot {
  bool active = false;
  bool walled = false;  // whether a wall is near
  int scene = 0;
  int corner[D] = {};                      // lattice index of the first node
  uint64_t near = 0;                       // bits of the obstacles that a node may meet, or have beside these
  uint64_t touching = 0;                   // bits of those that a node may be in
  const ObstacleRow<T, D>* row = nullptr;  // the obstacles of its scene
};

// ---- walls

// Arguments of contact, or of a plane of space (grid/meridian.h), are a `Space` where either will do.
template <class Space, class T, int D>
MPM_HD T wall_height(const Space& a, int face, const Vector<T, D>& x) {
  return face % 2 ? a.wall_plane[face] - x[face / 2] : x[face / 2] - a.wall_plane[face];
}

// A position within the walls, and the signs that reflect velocities there: −1 along the axes of mirrors that it is
// behind. `inset` is how far from walls it stays [m].
template <class T, int D>
MPM_HD Vector<T, D> within_walls(const ContactArguments<T, D>& a, Vector<T, D> x, const T& inset, Vector<T, D>& sign) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    sign[i] = T(1);
  MPM_UNROLL for (int face = 0; face < 2 * D; face++) {
    const int axis = face / 2;
    if (a.wall_kind[face] == Contact::open) continue;
    const T height = wall_height(a, face, x);
    if (a.wall_kind[face] == Contact::mirror && height < T(0)) {
      x[axis] = 2 * a.wall_plane[face] - x[axis];
      sign[axis] = T(-1);
    }
    if (wall_height(a, face, x) < inset) x[axis] = a.wall_plane[face] + (face % 2 ? T(0) - inset : inset);
  }
  return x;
}

template <class Space, class T, int D>
MPM_HD T nearest_wall(const Space& a, const Vector<T, D>& x) {
  T nearest = std::numeric_limits<T>::max();
  MPM_UNROLL for (int face = 0; face < 2 * D; face++) {
    const T height = wall_height(a, face, x);
    if (a.wall_kind[face] != Contact::open && height < nearest) nearest = height;
  }
  return nearest;
}

// ---- obstacles near a slot

struct NoVisit {
  template <class Pose>
  MPM_HD void operator()(int, const Pose&) const {}
};

// Whether obstacles have rows and a time in a scene.
template <class T, int D>
MPM_HD bool acts_in(const ContactArguments<T, D>& a, int scene) {
  return (a.rows == 1 || scene < a.rows) && (!a.scene_time || a.times == 1 || scene < a.times);
}

// Half the way from the first node of a block to the last, along an axis [m].
template <class T, int D>
MPM_HD T half_of_block(const ContactArguments<T, D>& a) {
  return T(0.5 * (kBlockWidth - 1) * a.dx);
}

template <class T, int D>
MPM_HD Vector<T, D> middle_of_block(const ContactArguments<T, D>& a, const int (&corner)[D]) {
  Vector<T, D> middle = node_position(a, corner, 0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    middle[i] = middle[i] + half_of_block(a);
  return middle;
}

// Whether a wall is near a block.
template <class T, int D>
MPM_HD bool is_walled(const ContactArguments<T, D>& a, const int (&corner)[D]) {
  return nearest_wall(a, middle_of_block(a, corner)) <= half_of_block(a) + T(kReach * a.dx);
}

// Sets which obstacles are near an active slot, by `pose_of(k)`, and calls visit(k, pose) for each of these: that may
// touch a node of the block or, beside others, have faces within reach of one. Distances change by no more than the way
// from a point to another; samples of distances do so between the nodes of their lattice, so that the slope of their
// multilinear interpolant is at most 1 along each axis.
template <class T, int D, class PoseOf, class Visit>
MPM_HD void find_near(const ContactArguments<T, D>& a, const PoseOf& pose_of, const Visit& visit,
                      ContactSlot<T, D>& s) {
  const T half = half_of_block(a);
  Vector<T, D> middle = middle_of_block(a, s.corner), sign;
  s.walled = is_walled(a, s.corner);
  if (s.walled) middle = within_walls(a, middle, T(0), sign);
  const T radius = std::sqrt(T(D)) * half * T(1.001) + (s.walled ? T(kSeam * a.dx) : T(0));
  const T margin = a.obstacles > 1 ? T((kReach + kSeam) * a.dx) : T(0);
  for (int k = 0; k < a.obstacles; k++) {
    const ObstaclePose<T, D>& pose = pose_of(k);
    if (!pose.acts) continue;
    Vector<T, D> normal;
    const T slope = pose.shape == ObstacleShape::sampled ? std::sqrt(T(D)) : T(1);
    const T way = surface(pose, to_body(pose, middle), normal) - a.rounding;
    if (!(way <= slope * (radius + margin))) continue;
    s.near |= uint64_t(1) << k;
    if (way <= slope * radius) s.touching |= uint64_t(1) << k;
    visit(k, pose);
  }
  if (!s.touching) s.near = 0;
}

// Of a block of a scene, with the lattice index of its first node. `visit` as for `find_near`.
template <class T, int D, class Visit = NoVisit>
MPM_HD ContactSlot<T, D> contact_slot(const ContactArguments<T, D>& a, int scene, const int (&corner)[D],
                                      Visit&& visit = {}) {
  ContactSlot<T, D> s;
  s.scene = scene;
  s.active = acts_in(a, scene);
  s.row = rows_of_scene(a, scene);
  MPM_UNROLL for (int i = 0; i < D; i++)
    s.corner[i] = corner[i];
  if (s.active) find_near(a, [&](int k) { return obstacle_pose(a, a.kind[k], s.row[k], scene); }, visit, s);
  return s;
}

template <class T, int D, class Visit = NoVisit>
MPM_HD ContactSlot<T, D> contact_slot(const ContactArguments<T, D>& a, int slot, Visit&& visit = {}) {
  const int index = a.block[slot];
  if (index < 0) return {};
  int corner[D];
  const int scene = block_coordinates(a.geometry, index, corner);
  MPM_UNROLL for (int i = 0; i < D; i++)
    corner[i] *= kBlockWidth;
  return contact_slot(a, scene, corner, visit);
}

MPM_HD int lowest_bit(uint64_t bits) {
#ifdef __CUDA_ARCH__
  return __ffsll(static_cast<long long>(bits)) - 1;
#else
  return __builtin_ctzll(bits);
#endif
}

// A slot and the obstacles near it. The CPU computes their poses once; a GPU, whose threads have little memory each,
// whenever it looks at one.
template <class T, int D>
class SlotPoses {
 public:
  const ContactArguments<T, D>& a;

#ifdef __CUDA_ARCH__
  const ContactSlot<T, D> s;
  MPM_HD SlotPoses(const ContactArguments<T, D>& arguments, const ContactSlot<T, D>& slot) : a(arguments), s(slot) {}
  MPM_HD SlotPoses(const ContactArguments<T, D>& arguments, int slot) : a(arguments), s(contact_slot(a, slot)) {}
  MPM_HD ObstaclePose<T, D> operator[](int k) const { return obstacle_pose(a, a.kind[k], s.row[k], s.scene); }
#else
 private:
  ObstaclePose<T, D> pose_[kMaxObstacles];
  auto store() {
    return [this](int k, const ObstaclePose<T, D>& pose) { pose_[k] = pose; };
  }

 public:
  const ContactSlot<T, D> s;
  MPM_HD SlotPoses(const ContactArguments<T, D>& arguments, int slot)
      : a(arguments), s(contact_slot(a, slot, store())) {}
  MPM_HD SlotPoses(const ContactArguments<T, D>& arguments, const ContactSlot<T, D>& slot)
      : a(arguments), s(contact_slot(a, slot.scene, slot.corner, store())) {}
  MPM_HD const ObstaclePose<T, D>& operator[](int k) const { return pose_[k]; }
#endif
};

// The same with stored poses, of all obstacles of the scene.
template <class T, int D>
class StoredPoses {
 public:
  const ContactArguments<T, D>& a;
  const ContactSlot<T, D>& s;

  MPM_HD StoredPoses(const ContactArguments<T, D>& arguments, const ContactSlot<T, D>& slot,
                     const ObstaclePose<T, D>* poses)
      : a(arguments), s(slot), pose_(poses) {}
  MPM_HD const ObstaclePose<T, D>& operator[](int k) const { return pose_[k]; }

 private:
  const ObstaclePose<T, D>* const pose_;
};

// Functions below take either as `Poses`.

template <class Poses, class T, int D>
MPM_HD_CALL void compute_height(bool wanted, const Poses& poses, int k, int face, const Vector<T, D>& x, T& height,
                                Vector<T, D>& normal, T& beyond) {
  if (!wanted) return;
  const auto& pose = poses[k];
  Vector<T, D> own;
  height = face_height(pose, face, to_body(pose, x), own, beyond);
  normal = pose.rotation * own;
}

// Height of a point of the world above the surface that carries a face of obstacle k, and the unit normal of that; see
// `face_height`. Zero where it is not wanted.
//
// The threads of a warp compute heights together, as common/warp.h has it. So all functions from here to the end of the
// search for surfaces are called by all threads of a warp, with `wanted` for those whose node needs the result. They
// have no branch around a call but for conditions of `any_of_warp`.
template <class Poses, class T, int D>
MPM_HD T height_above(bool wanted, const Poses& poses, int k, int face, const Vector<T, D>& x, Vector<T, D>& normal,
                      T& beyond) {
  T height = T(0);
  if (any_of_warp(wanted)) {
    compute_height(wanted, poses, k, face, x, height, normal, beyond);
    join_warp();
  }
  return height;
}

// ---- faces near a node

// A face and the point where its normal is read. The height of other points is read there too, or is that above the
// plane through its surface at that point.
template <class T, int D>
struct Face {
  int obstacle, face;
  bool flat;
  Vector<T, D> at, normal;
  T height, depth;  // of `at`; of the node
  bool is_plane;    // that a point beside a shape sees, see `add_plane`
  T rounded;        // depth
};

// Sets what a point sees of a face, whose numbers and point `at` are given.
template <class Poses, class T, int D>
MPM_HD void set_face(const Poses& poses, const T& reach, Face<T, D>& face, T& beyond) {
  const auto& pose = poses[face.obstacle];
  const Vector<T, D> body = to_body(pose, face.at);
  Vector<T, D> normal;
  face.height = face_height(pose, face.face, body, normal, beyond);
  face.normal = pose.rotation * normal;
  face.depth = T(0) - face.height;
  face.flat = is_flat(pose, face.face, body, reach);
}

template <class Poses, class T, int D>
MPM_HD_CALL void compute_face(bool wanted, const Poses& poses, const T& reach, Face<T, D>& face, T& beyond) {
  if (wanted) set_face(poses, reach, face, beyond);
}

template <class T, int D>
struct Faces {
  int count = 0;
  Face<T, D> e[kMostFaces];
};

// A point between a node and free space, of whose faces the normals point there.
template <class T, int D>
struct Foot {
  int count = 0;
  int member[D] = {};
  Vector<T, D> at, step;  // the step has the height 1 above all of them
  T depth = T(0);         // rounded
};

// A depth in steps of 1e-4 cells, so that rounding does not distinguish equal depths.
template <class Space, class T>
MPM_HD T rounded_depth(const Space& a, const T& depth) {
  return std::floor(depth * (T(1e4) * a.geometry.inverse_dx) + T(0.5));
}

// `kSeam` as a length [m], at least some roundings.
template <class Space>
MPM_HD auto seam_of(const Space& a) {
  using T = std::remove_cvref_t<decltype(a.rounding)>;
  const T seam = T(kSeam * a.dx);
  return seam > 4 * a.rounding ? seam : 4 * a.rounding;
}

template <class Poses, class T, int D>
class SolidAt {
 public:
  using V = Vector<T, D>;
  using Space = std::remove_cvref_t<decltype(Poses::a)>;

  MPM_HD SolidAt(const Poses& poses, const V& node)
      : poses_(poses), a_(poses.a), node_(node), seam_(seam_of(poses.a)), reach_(T(kReach * poses.a.dx)) {}

  // Finds the faces that the node meets; their number is zero where none is near enough.
  MPM_HD void find(bool wanted) {
    MPM_LOOP for (uint64_t left = wanted ? poses_.s.near : 0; any_of_warp(left != 0); left &= left - 1)
      add_faces(left != 0, lowest_bit(left));
    Foot<T, D> foot;
    MPM_LOOP while (true) {
      wanted = wanted && next_set(foot);
      if (!any_of_warp(wanted)) break;
      try_foot(wanted, foot);
    }
  }

  MPM_HD const Foot<T, D>& foot() const { return best_; }
  MPM_HD const Face<T, D>& face(int i) const { return faces_.e[best_.member[i]]; }

 private:
  // In order, as `goes_before` has it; the last one makes room. Of several sticky ones the first gives the node its
  // velocity.
  MPM_HD void add(Face<T, D>& face) {
    face.rounded = rounded_depth(a_, face.depth);
    int at = faces_.count < kMostFaces ? faces_.count++ : kMostFaces;
    MPM_LOOP for (; at > 0 && goes_before(face, faces_.e[at - 1]); at--) {
      if (at < kMostFaces) faces_.e[at] = faces_.e[at - 1];
    }
    if (at < kMostFaces) faces_.e[at] = face;
  }

  // An order that does not depend on that of obstacles and outlines: the nearest face, the stricter one, that of more
  // friction, and by the normal.
  MPM_HD bool goes_before(const Face<T, D>& face, const Face<T, D>& other) const {
    if (face.rounded != other.rounded) return face.rounded < other.rounded;
    const int kind = int(a_.kind[face.obstacle].contact), known = int(a_.kind[other.obstacle].contact);
    if (kind != known) return kind < known;
    const T friction = poses_.s.row[face.obstacle].friction, before = poses_.s.row[other.obstacle].friction;
    if (friction != before) return friction > before;
    return is_greater(face.normal, other.normal);
  }

  // By the sizes of components, as a box alone has it, and then by their signs; equal where these are nearly so.
  MPM_HD static bool is_greater(const V& x, const V& y) {
    MPM_LOOP for (int i = 0; i < D; i++) {
      const T size = rounded_component(abs(x[i])), other = rounded_component(abs(y[i]));
      if (size != other) return size > other;
    }
    MPM_LOOP for (int i = 0; i < D; i++) {
      const T own = rounded_component(x[i]), other = rounded_component(y[i]);
      if (own != other) return own > other;
    }
    return false;
  }
  MPM_HD static T rounded_component(const T& x) { return std::floor(x * T(1000) + T(0.5)); }

  // The next set of faces, in the order of their number, of the deepest one, the second one and so on. Sets whose
  // deepest face is deeper than the best foot are skipped.
  MPM_HD bool next_set(Foot<T, D>& foot) const {
    int at = 0;
    MPM_LOOP while (at < foot.count &&
                    foot.member[at] + 1 == (at + 1 < foot.count ? foot.member[at + 1] : faces_.count))
      at++;
    const bool ends = at == foot.count || (at == foot.count - 1 && is_deeper(foot.member[at] + 1));
    if (ends && (foot.count == D || foot.count == faces_.count || is_deeper(foot.count))) return false;
    if (ends)
      at = foot.count++;
    else
      foot.member[at]++;
    MPM_LOOP for (int i = 0; i < foot.count; i++) {
      if (i < at || ends) foot.member[i] = i;
    }
    return true;
  }

  // Whether a foot on a face is deeper than the best one.
  MPM_HD bool is_deeper(int face) const { return best_.count > 0 && faces_.e[face].rounded > best_.depth; }

  MPM_HD T height_of(bool wanted, int k, const V& x, V& normal) const {
    T beyond;
    return height_above(wanted, poses_, k, -1, x, normal, beyond);
  }

  MPM_HD ObstacleShape shape_of(int k) const { return a_.kind[k].shape; }

  // Of a shape of samples, the way between them [m].
  MPM_HD T spacing_of(int k) const { return a_.data[a_.kind[k].first_number + D]; }

  MPM_HD void add_faces(bool wanted, int k) {
    const bool sampled = wanted && shape_of(k) == ObstacleShape::sampled;
    if (any_of_warp(sampled)) add_by_distance(sampled, k);
    int count = wanted && !sampled ? face_count<D>(a_.kind[k], a_.data + a_.kind[k].first_number) : 0;
    const bool is_box = wanted && shape_of(k) == ObstacleShape::box;  // whose faces are all far where it is
    V unused;
    if (!(height_of(is_box, k, node_, unused) <= reach_)) count = 0;
    MPM_LOOP for (int f = 0; any_of_warp(f < count); f++)
      add_face(f < count, k, count == 1 ? -1 : f);
  }

  MPM_HD void add_face(bool wanted, int k, int f) {
    Face<T, D> face{k, f, false, node_, {}, T(0), T(0), false, T(0)};
    T beyond = T(0);
    if (any_of_warp(wanted)) {
      compute_face(wanted, poses_, reach_, face, beyond);
      join_warp();
    }
    if (!wanted || !(face.height <= seam_ / 2) || !(face.depth <= reach_) || beyond > reach_) return;
    if (dot(face.normal, face.normal) > T(0.5)) add(face);
  }

  // Of a shape that is known by its distance alone, its surface, and the planes that free space sees around the point
  // nearest to the node: those of the faces that join there; and where that point is covered, or the node is beside the
  // shape, those of the faces that neighbours of the node see.
  MPM_HD void add_by_distance(bool wanted, int k) {
    Face<T, D> nearest{k, -1, false, node_, {}, T(0), T(0), false, T(0)};
    nearest.height = height_of(wanted, k, node_, nearest.normal);
    nearest.depth = T(0) - nearest.height;
    bool covered = wanted && nearest.height > a_.rounding && nearest.height <= reach_;
    const bool meets = wanted && nearest.height <= seam_ / 2 && nearest.depth <= reach_ &&
                       dot(nearest.normal, nearest.normal) > T(0.5);
    if (any_of_warp(meets) && add_around(meets, k, nearest)) covered = true;
    if (any_of_warp(covered)) add_seen_by_neighbours(covered, k);
  }

  // Adds the surface that is nearest to the node and the planes around it; whether it is covered.
  MPM_HD bool add_around(bool wanted, int k, Face<T, D>& nearest) {
    const T spacing = wanted ? spacing_of(k) : T(0), small = T(2.5) * seam_;
    const T away = T(1.5) * spacing > small ? T(1.5) * spacing : small;
    const V first = node_ + nearest.depth * nearest.normal;
    V unused;
    const T start = height_of(wanted, k, first, unused);
    // The distance has a ridge where the node is equally deep below several faces. The normal there is between theirs,
    // and the nearest point is still inside. Samples round a ridge by a quarter of their spacing.
    const T slack = T(0.5) * seam_ + T(0.25) * spacing;
    const bool ridge = has_others(wanted && start < T(0) - slack, k, nearest.depth);
    MPM_LOOP for (int i = 0; i < kLeaning; i++) {
      V normal;
      const V at = seen_from(wanted, k, first, nearest.normal, away, i);
      const T height = height_of(wanted, k, at, normal);
      if (!wanted) continue;
      const T cosine = dot(normal, nearest.normal);
      // The plane that it sees goes through that point or behind it where faces join; it is before a rounded body. At a
      // ridge it is no deeper than the node.
      const T lowest = ridge ? nearest.height * (T(1) - cosine) - slack : T(-0.5) * seam_;
      const bool joins = height + dot(normal, first + T(-1) * at) >= lowest;
      nearest.flat = nearest.flat || (height >= T(0) && joins && cosine < T(kSame));
    }
    const bool flat = wanted && nearest.flat, is_face = is_a_face(flat, k, first, nearest.normal);
    if (wanted && (is_face || !flat)) add(nearest);
    MPM_LOOP for (int i = 0; i < kLeaning; i++)
      add_plane(flat, k, seen_from(flat, k, first, nearest.normal, away, i));
    const bool is_between = ridge && flat;
    return is_covered(wanted && !is_between, k, first, nearest.normal, start) || is_between;
  }

  // Whether another obstacle, or a wall, is as near to the node as the surface that it is deep below.
  MPM_HD bool has_others(bool wanted, int k, const T& depth) const {
    const T away = 2 * seam_ + depth;
    bool found = wanted && nearest_wall(a_, node_) <= away;
    uint64_t left = wanted && !found ? poses_.s.near & ~(uint64_t(1) << k) : 0;
    MPM_LOOP while (any_of_warp(left != 0)) {
      V unused;
      const T height = height_of(left != 0, lowest_bit(left), node_, unused);
      found = found || (left && height <= away);
      left = found ? 0 : left & (left - 1);
    }
    return found;
  }

  // Whether a normal at a point of the surface is that of a face: at edges distances rise more slowly along it.
  MPM_HD bool is_a_face(bool wanted, int k, const V& first, const V& normal) const {
    V there;
    return height_of(wanted, k, first + seam_ * normal, there) > T(0.8) * seam_;
  }

  // A point around a point of the surface; one behind a face is moved before it.
  MPM_HD V seen_from(bool wanted, int k, const V& first, const V& axis, const T& away, int i) const {
    const V at = first + away * leaning(axis, i);
    V normal;
    const T height = height_of(wanted, k, at, normal);
    return wanted && height < T(0) ? at + (T(0.3) * away - height) * normal : at;
  }

  MPM_HD void add_seen_by_neighbours(bool wanted, int k) {
    constexpr int count = D == 2 ? 9 : 27;
    Matrix<T, D> rotation = {};
    if (wanted) rotation = poses_[k].rotation;
    MPM_LOOP for (int i = 1; i < count; i++) {
      V way;
      MPM_LOOP for (int j = 0, rest = i; j < D; j++, rest /= 3)
        way[j] = T(rest % 3 == 2 ? -1 : rest % 3);
      const V at = node_ + reach_ * (rotation * way);
      add_plane(sees_a_face(wanted, k, at), k, at);
    }
  }

  // Whether the nearest point of the surface to a point is on a face: a step against the normal of an outer edge is
  // less deep than it is long. Samples round edges.
  MPM_HD bool sees_a_face(bool wanted, int k, const V& at) const {
    const T spacing = wanted ? spacing_of(k) : T(0), step = spacing > seam_ ? spacing : seam_;
    V normal = zero_vector<T, D>(), unused;
    const T height = height_of(wanted, k, at, normal);
    return height_of(wanted, k, at + (T(0) - height - step) * normal, unused) <= T(0) - T(kSame) * step;
  }

  // The plane that a point outside the shape sees, unless one with that normal is known.
  MPM_HD void add_plane(bool wanted, int k, const V& at) {
    Face<T, D> face{k, -1, true, at, {}, T(0), T(0), true, T(0)};
    face.height = height_of(wanted, k, face.at, face.normal);
    face.depth = T(0) - (face.height + dot(face.normal, node_ + T(-1) * face.at));
    if (!wanted || !(face.height >= T(0)) || !(dot(face.normal, face.normal) > T(0.5))) return;
    if (!(face.depth >= T(0) - seam_) || face.depth > reach_) return;
    MPM_LOOP for (int j = 0; j < faces_.count; j++) {
      const Face<T, D>& known = faces_.e[j];
      if (known.is_plane && known.obstacle == k && dot(known.normal, face.normal) > T(kSame)) return;
    }
    add(face);
  }

  // A unit vector, and directions at 55° to it, evenly around.
  static constexpr int kLeaning = D == 2 ? 3 : 7;
  MPM_HD static V leaning(const V& axis, int i) {
    if (i == 0) return axis;
    const T c = T(0.57357643635104616), s = T(0.81915204428899180);
    const int k = i - 1;
    if constexpr (D == 2) {
      const T side = k ? s : T(0) - s;
      return {{c * axis[0] - side * axis[1], c * axis[1] + side * axis[0]}};
    } else {
      // An orthonormal basis (Duff et al. 2017).
      const T sign = axis[2] < T(0) ? T(-1) : T(1), f = T(-1) / (sign + axis[2]), g = axis[0] * axis[1] * f;
      const V u = {{T(1) + sign * axis[0] * axis[0] * f, sign * g, T(0) - sign * axis[0]}};
      const V w = {{g, sign + axis[1] * axis[1] * f, T(0) - axis[1]}};
      const T cosine[3] = {T(1), T(0.5), T(-0.5)}, sine = k % 3 ? T(0.86602540378443865) : T(0);
      const T turn = k < 3 ? s : T(0) - s;
      return c * axis + turn * cosine[k % 3] * u + turn * sine * w;
    }
  }

  MPM_HD T height_at(bool wanted, const Face<T, D>& face, const V& x, V& normal) const {
    const bool curved = wanted && !face.flat;
    V there;
    T beyond;
    const T height = height_above(curved, poses_, face.obstacle, face.face, x, there, beyond);
    normal = curved ? there : face.normal;
    return curved ? height : face.height + dot(face.normal, x + T(-1) * face.at);
  }

  // The nearest point on all faces of a foot; false where there is none whose faces all stop the node.
  MPM_HD bool solve(bool wanted, Foot<T, D>& foot) const {
    bool curved = false;
    MPM_LOOP for (int i = 0; i < foot.count; i++)
      curved = curved || !faces_.e[foot.member[i]].flat;
    foot.at = node_;
    const int rounds = curved && foot.count > 1 ? 3 : 1;
    MPM_LOOP for (int round = 0; any_of_warp(wanted && round < rounds); round++) {
      const bool acts = wanted && round < rounds;
      V normal[D];
      T share[D];
      MPM_LOOP for (int i = 0; i < D; i++) {
        const T height = height_at(acts && i < foot.count, faces_.e[foot.member[i]], foot.at, normal[i]);
        share[i] = dot(normal[i], foot.at + T(-1) * node_) - height;
      }
      if (acts) wanted = move_to_faces(normal, share, foot);
    }
    return wanted && length(foot.at + T(-1) * node_) <= reach_;
  }

  // Of faces by their normals and how far along each the node is from them.
  MPM_HD bool move_to_faces(const V (&normal)[D], T (&share)[D], Foot<T, D>& foot) const {
    T gram[D][D], again[D][D], ones[D];
    MPM_LOOP for (int i = 0; i < foot.count; i++) {
      ones[i] = T(1);
      MPM_LOOP for (int j = 0; j < foot.count; j++)
        gram[i][j] = again[i][j] = dot(normal[i], normal[j]);
    }
    if (!solve_definite<0, T, D>(gram, share, foot.count) || !solve_definite<0, T, D>(again, ones, foot.count))
      return false;
    foot.at = node_, foot.step = zero_vector<T, D>();
    MPM_LOOP for (int i = 0; i < foot.count; i++) {
      if (share[i] < T(0) - (foot.count > 1 ? seam_ / 2 : a_.rounding)) return false;
      foot.at = foot.at + share[i] * normal[i];
      foot.step = foot.step + ones[i] * normal[i];
    }
    return true;
  }

  // Whether the faces are there on the side of the foot where they bound free space, and that is free.
  MPM_HD bool is_exposed(bool wanted, const Foot<T, D>& foot) const {
    MPM_LOOP for (int i = 0; any_of_warp(wanted && i < foot.count); i++) {
      const bool acts = wanted && i < foot.count;
      const Face<T, D>& face = faces_.e[foot.member[acts ? i : 0]];
      T near = seam_ / 2;
      const bool sampled = acts && shape_of(face.obstacle) == ObstacleShape::sampled;
      if (sampled) near = near + T(0.5) * spacing_of(face.obstacle);
      V normal, unused;
      height_at(acts && !sampled, face, foot.at, normal);  // that of samples is not defined at an edge
      const V beside = foot.at + seam_ * (foot.step + T(-1) * normal);
      const T height = height_of(acts, face.obstacle, beside, unused);
      wanted = wanted && (!acts || height <= near);
    }
    const bool is_edge = wanted && foot.count > 1, looks_inwards = is_inner(is_edge, foot);
    return is_free(wanted && (looks_inwards || !is_edge), foot.at, foot.step);
  }

  // Whether the edge of a foot looks inwards, so that a point before all of its faces but one is in the body of that:
  // tangents of a rounded body meet outside. Of samples, which round edges; others do not get here.
  MPM_HD bool is_inner(bool wanted, const Foot<T, D>& foot) const {
    bool sampled = false;
    MPM_LOOP for (int i = 0; i < foot.count; i++)
      sampled = sampled || is_of_samples(foot, i);
    if (!any_of_warp(wanted && sampled)) return wanted;
    V normal[D], unused;
    MPM_LOOP for (int i = 0; i < D; i++)
      height_at(wanted && sampled && i < foot.count, faces_.e[foot.member[i]], foot.at, normal[i]);
    MPM_LOOP for (int i = 0; i < D; i++) {
      const bool acts = wanted && i < foot.count && is_of_samples(foot, i);
      const int k = faces_.e[foot.member[i]].obstacle;
      V way = zero_vector<T, D>();
      if (acts) wanted = way_before(normal, i, foot, way);
      const T spacing = acts ? spacing_of(k) : T(0);
      const T height = height_of(acts && wanted, k, foot.at + spacing * way, unused);
      wanted = wanted && !(acts && height > T(0));
    }
    return wanted;
  }

  MPM_HD bool is_of_samples(const Foot<T, D>& foot, int i) const {
    return shape_of(faces_.e[foot.member[i]].obstacle) == ObstacleShape::sampled;
  }

  // A way of height −1 above face i of a foot and 1 above the others; false where there is none.
  MPM_HD bool way_before(const V (&normal)[D], int i, const Foot<T, D>& foot, V& way) const {
    T gram[D][D], share[D];
    MPM_LOOP for (int j = 0; j < foot.count; j++) {
      share[j] = T(i == j);
      MPM_LOOP for (int l = 0; l < foot.count; l++)
        gram[j][l] = dot(normal[j], normal[l]);
    }
    if (!solve_definite<0, T, D>(gram, share, foot.count)) return false;
    way = foot.step;
    MPM_LOOP for (int j = 0; j < foot.count; j++)
      way = way + T(-2) * share[j] * normal[j];
    return true;
  }

  // Whether a step of the height of a seam from a point that is nearest to the node leads into another obstacle, a
  // wall, or deeper into its own obstacle, at distance `height` from that. Values of an inexact distance rise there,
  // even if that point is not on the surface.
  MPM_HD bool is_covered(bool wanted, int k, const V& first, const V& normal, const T& height) const {
    V unused;
    const T rise = height_of(wanted, k, first + seam_ * normal, unused) - height;
    const bool free = is_free(wanted && rise > T(0.25) * seam_, first, normal, uint64_t(1) << k);
    return wanted && !free;
  }

  // Whether a step of the height of a seam from a point of surfaces leads into free space, but for some obstacles.
  MPM_HD bool is_free(bool wanted, const V& at, const V& step, uint64_t but = 0) const {
    V unused;
    const V there = at + seam_ * step;
    bool free = wanted && !faces_a_wall(at, step);
    uint64_t left = free ? poses_.s.near & ~but : 0;
    MPM_LOOP while (any_of_warp(left != 0)) {
      const T height = height_of(left != 0, lowest_bit(left), there, unused);
      free = free && (left == 0 || height > seam_ / 2);
      left = free ? left & (left - 1) : 0;
    }
    return free;
  }

  MPM_HD bool faces_a_wall(const V& at, const V& step) const {
    constexpr double facing = 0.7;  // cosine above which a face looks at a wall
    MPM_LOOP for (int face = 0; face < 2 * D; face++) {
      if (a_.wall_kind[face] == Contact::open) continue;
      const T towards = face % 2 ? step[face / 2] : T(0) - step[face / 2];
      if (wall_height(a_, face, at) <= seam_ && towards > T(facing)) return true;
    }
    return false;
  }

  // Keeps a foot where it is exposed and less deep than the best one; of equals, by `comes_first`.
  MPM_HD void try_foot(bool wanted, Foot<T, D>& foot) {
    if (wanted) foot.depth = faces_.e[foot.member[foot.count - 1]].rounded;
    wanted = wanted && (best_.count == 0 || foot.depth <= best_.depth);
    wanted = solve(wanted, foot);
    wanted = is_exposed(wanted, foot);
    if (!wanted) return;
    if (best_.count == 0 || foot.depth < best_.depth || comes_first(foot)) best_ = foot;
  }

  // Whether a foot as deep as the best one comes first in any order of obstacles and outlines: by the number of
  // its faces, by the strictest of their kinds, by their largest friction, and by where it leads.
  MPM_HD bool comes_first(const Foot<T, D>& foot) const {
    if (foot.count != best_.count) return foot.count > best_.count;
    const int kind = strictest(foot), known = strictest(best_);
    if (kind != known) return kind < known;
    const T friction = largest_friction(foot), before = largest_friction(best_);
    if (friction != before) return friction > before;
    return is_greater(foot.step, best_.step);
  }

  MPM_HD int strictest(const Foot<T, D>& foot) const {
    int kind = int(Contact::separate);
    MPM_LOOP for (int i = 0; i < foot.count; i++) {
      const int own = int(a_.kind[faces_.e[foot.member[i]].obstacle].contact);
      if (own < kind) kind = own;
    }
    return kind;
  }

  MPM_HD T largest_friction(const Foot<T, D>& foot) const {
    T friction = T(0);
    MPM_LOOP for (int i = 0; i < foot.count; i++)
      friction = max(friction, poses_.s.row[faces_.e[foot.member[i]].obstacle].friction);
    return friction;
  }

  const Poses& poses_;
  const Space& a_;
  const V node_;
  const T seam_, reach_;
  Faces<T, D> faces_;
  Foot<T, D> best_;
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
