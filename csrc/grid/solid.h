#pragma once

#include "grid/constraints.h"
#include "grid/obstacle.h"

// All obstacles of a scene as one solid: the surfaces that a node inside it meets.
//
// Free space is what lies outside all obstacles. A node inside meets the surfaces of the point of free space that is
// nearest to it, its foot: one face, or all that join at an inner edge or corner. Faces that lie inside another
// obstacle, on one, or at a wall of the domain that they look at, are no surfaces of free space; so the seam of two
// boxes does not act. Candidates for the foot are the feet on each face, and the points where two or three faces meet,
// that are exposed: a step from there into free space leaves all obstacles. Of these that of the least depth counts,
// where the depth below several faces is the largest of those below each; so walls of tanks may be as thin at a corner
// as elsewhere.
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
  bool plain = false;  // whether one convex obstacle at most is near, and no wall
  int scene = 0;
  int corner[D] = {};                      // lattice index of the first node
  uint64_t near = 0;                       // bits of the obstacles that a node may meet
  const ObstacleRow<T, D>* row = nullptr;  // the obstacles of its scene
};

// ---- walls

template <class T, int D>
MPM_HD T wall_height(const ContactArguments<T, D>& a, int face, const Vector<T, D>& x) {
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

// ---- obstacles near a slot

// Whether an obstacle may touch a node of the block whose first node is at `first`, or have faces within `margin` of
// it. Distances change by no more than the way from a point to another; samples of distances do so between the nodes of
// their lattice, so that the slope of their multilinear interpolant is at most 1 along each axis.
template <class T, int D>
MPM_HD bool near_block(const ContactArguments<T, D>& a, const ObstaclePose<T, D>& o, const Vector<T, D>& first,
                       const T& margin) {
  const T half = T(0.5 * (kBlockWidth - 1) * a.dx);
  Vector<T, D> middle, sign, normal;
  MPM_UNROLL for (int i = 0; i < D; i++)
    middle[i] = first[i] + half;
  const T slope = o.shape == ObstacleShape::sampled ? std::sqrt(T(D)) : T(1);
  const T reach = slope * (std::sqrt(T(D)) * half * T(1.001) + margin) + a.rounding;
  return surface(o, to_body(o, within_walls(a, middle, T(0), sign)), normal) <= reach;
}

template <class T, int D>
MPM_HD bool is_convex(const ObstacleKind& kind) {
  return kind.shape != ObstacleShape::revolved && kind.shape != ObstacleShape::sampled;
}

template <class T, int D>
MPM_HD bool near_walls(const ContactArguments<T, D>& a, const Vector<T, D>& first) {
  bool near = false;
  MPM_UNROLL for (int face = 0; face < 2 * D; face++) {
    const T width = face % 2 ? T((kBlockWidth - 1) * a.dx) : T(0);
    near = near || (a.wall_kind[face] != Contact::open && wall_height(a, face, first) - width <= T(kReach * a.dx));
  }
  return near;
}

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
  if (!s.active) return s;
  const Vector<T, D> first = node_position(a, s.corner, 0);
  const T margin = a.obstacles > 1 ? T((kReach + kSeam) * a.dx) : T(0);  // what is free beside a node
  int found = 0;
  for (int k = 0; k < a.obstacles; k++) {
    const ObstaclePose<T, D> pose = obstacle_pose(a, a.kind[k], s.row[k], scene);
    if (!pose.acts || !near_block(a, pose, first, margin)) continue;
    s.near |= uint64_t(1) << k;
    found = found == 0 && is_convex<T, D>(a.kind[k]) ? 1 : 2;
  }
  s.plain = found < 2 && (found == 0 || !near_walls(a, first));
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

MPM_HD int lowest_bit(uint64_t bits) {
#ifdef __CUDA_ARCH__
  return __ffsll(static_cast<long long>(bits)) - 1;
#else
  return __builtin_ctzll(bits);
#endif
}

// The obstacles near a slot. The CPU computes their poses once; a GPU, whose threads have little memory each, whenever
// it looks at one.
template <class T, int D>
class SlotPoses {
 public:
  const ContactArguments<T, D>& a;
  const ContactSlot<T, D>& s;

  MPM_HD SlotPoses(const ContactArguments<T, D>& arguments, const ContactSlot<T, D>& slot) : a(arguments), s(slot) {
#ifndef __CUDA_ARCH__
    for (uint64_t left = s.near; left; left &= left - 1) {
      const int k = lowest_bit(left);
      pose_[k] = obstacle_pose(a, a.kind[k], s.row[k], s.scene);
    }
#endif
  }
#ifdef __CUDA_ARCH__
  MPM_HD ObstaclePose<T, D> operator[](int k) const { return obstacle_pose(a, a.kind[k], s.row[k], s.scene); }
#else
  MPM_HD const ObstaclePose<T, D>& operator[](int k) const { return pose_[k]; }

 private:
  ObstaclePose<T, D> pose_[kMaxObstacles];
#endif
};

// ---- faces near a node

// A face and the point where its normal is read. The height of other points is read there too, or is that above the
// plane through its surface at that point.
template <class T, int D>
struct Face {
  int obstacle, face;
  bool flat;
  Vector<T, D> at, normal;
  T height, depth;  // of `at`; of the node
};

template <class T, int D>
struct Faces {
  int count = 0;
  Face<T, D> e[kMostFaces];

  // The deepest one makes room.
  MPM_HD_CALL void add(const Face<T, D>& face) {
    if (count < kMostFaces) {
      e[count++] = face;
      return;
    }
    int deepest = 0;
    for (int i = 1; i < count; i++)
      if (e[i].depth > e[deepest].depth) deepest = i;
    if (face.depth < e[deepest].depth) e[deepest] = face;
  }
};

// A point between a node and free space, of whose faces the normals point there.
template <class T, int D>
struct Foot {
  int count = 0;
  int member[D] = {};
  Vector<T, D> at, step;  // the step has the height 1 above all of them
  T depth = T(0);         // rounded
};

// A depth in steps of 1e-4 cells, so that rounding does not tell apart what is equally deep.
template <class T, int D>
MPM_HD T rounded_depth(const ContactArguments<T, D>& a, const T& depth) {
  return std::floor(depth * T(1e4 / a.dx) + T(0.5));
}

template <class T, int D>
class SolidAt {
 public:
  using V = Vector<T, D>;

  MPM_HD SolidAt(const SlotPoses<T, D>& poses, const V& node)
      : poses_(poses), a_(poses.a), node_(node), seam_(seam_of(poses.a)), reach_(T(kReach * poses.a.dx)) {}

  MPM_HD static T seam_of(const ContactArguments<T, D>& a) {
    const T seam = T(kSeam * a.dx);
    return seam > 4 * a.rounding ? seam : 4 * a.rounding;
  }

  // Finds the faces that the node meets; their number is zero where none is near enough.
  MPM_HD_CALL void find() {
    for (uint64_t left = poses_.s.near; left; left &= left - 1) add_faces(lowest_bit(left));
    sort_faces();
    Foot<T, D> foot;
    foot.count = 1;
    for (int i = 0; i < faces_.count && !is_deeper(i); i++) {
      foot.member[0] = i;
      try_foot(foot);
    }
    foot.count = 2;
    for (int i = 0; i < faces_.count && !is_deeper(i); i++)
      for (int j = 0; j < i; j++) {
        foot.member[0] = j, foot.member[1] = i;
        try_foot(foot);
      }
    if constexpr (D == 3) {
      foot.count = 3;
      for (int i = 0; i < faces_.count && !is_deeper(i); i++)
        for (int j = 0; j < i; j++)
          for (int k = 0; k < j; k++) {
            foot.member[0] = k, foot.member[1] = j, foot.member[2] = i;
            try_foot(foot);
          }
    }
  }

  MPM_HD const Foot<T, D>& foot() const { return best_; }
  MPM_HD const Face<T, D>& face(int i) const { return faces_.e[best_.member[i]]; }

 private:
  // The nearest comes first: of several sticky ones it gives the node its velocity.
  MPM_HD_CALL void sort_faces() {
    for (int i = 0; i < faces_.count; i++) depth_[i] = rounded_depth(a_, faces_.e[i].depth);
    for (int i = 1; i < faces_.count; i++)
      for (int j = i; j > 0 && depth_[j] < depth_[j - 1]; j--) {
        const Face<T, D> face = faces_.e[j];
        faces_.e[j] = faces_.e[j - 1], faces_.e[j - 1] = face;
        const T depth = depth_[j];
        depth_[j] = depth_[j - 1], depth_[j - 1] = depth;
      }
  }

  // Whether a foot on a face is deeper than the best one.
  MPM_HD bool is_deeper(int face) const { return best_.count > 0 && depth_[face] > best_.depth; }

  MPM_HD_CALL T height_of(const ObstaclePose<T, D>& pose, int face, const V& x, V& normal) const {
    T beyond;
    V own;
    const T height = face_height(pose, face, to_body(pose, x), own, beyond);
    normal = pose.rotation * own;
    return height;
  }

  MPM_HD_CALL void add_faces(int k) {
    const auto& pose = poses_[k];
    if (pose.shape == ObstacleShape::sampled) return add_by_distance(k);
    const int count = face_count(pose);
    if (pose.shape == ObstacleShape::box) {  // whose faces are all far where it is
      V normal;
      if (!(height_of(pose, -1, node_, normal) <= reach_)) return;
    }
    for (int f = 0; f < count; f++) {
      Face<T, D> face{k, count == 1 ? -1 : f, is_flat(pose), node_, {}, T(0), T(0)};
      T beyond;
      V own;
      face.height = face_height(pose, face.face, to_body(pose, node_), own, beyond);
      face.depth = T(0) - face.height;
      if (!(face.height <= seam_ / 2) || !(face.depth <= reach_) || beyond > reach_) continue;
      face.normal = pose.rotation * own;
      if (dot(face.normal, face.normal) > T(0.5)) faces_.add(face);
    }
  }

  // Of a shape that is known by its distance alone, its surface, and the planes that free space sees around the point
  // nearest to the node: those of the faces that join there; and where that point is covered, or the node is beside the
  // shape, those that neighbours of the node see.
  MPM_HD_CALL void add_by_distance(int k) {
    const auto& pose = poses_[k];
    Face<T, D> nearest{k, -1, false, node_, {}, T(0), T(0)};
    nearest.height = height_of(pose, -1, node_, nearest.normal);
    nearest.depth = T(0) - nearest.height;
    bool covered = nearest.height > a_.rounding && nearest.height <= reach_;
    if (nearest.height <= seam_ / 2 && nearest.depth <= reach_ && dot(nearest.normal, nearest.normal) > T(0.5)) {
      const T spacing = pose.data[D], small = T(2.5) * seam_,
              away = T(1.5) * spacing > small ? T(1.5) * spacing : small;
      const V first = node_ + nearest.depth * nearest.normal;
      for (int i = 0; i < kLeaning; i++) {
        V normal;
        const T height = height_of(pose, -1, seen_from(pose, first, nearest.normal, away, i), normal);
        nearest.flat = nearest.flat || (height >= T(0) && dot(normal, nearest.normal) < T(kSame));
      }
      if (!nearest.flat || is_a_face(pose, first, nearest.normal)) faces_.add(nearest);
      planes_ = faces_.count;
      for (int i = 0; nearest.flat && i < kLeaning; i++)
        add_plane(k, pose, seen_from(pose, first, nearest.normal, away, i));
      covered = covered || !is_free(first, nearest.normal);
    } else {
      planes_ = faces_.count;
    }
    if (covered) add_seen_by_neighbours(k, pose);
  }

  // Whether a normal at a point of the surface is that of a face: at edges distances rise more slowly along it.
  MPM_HD_CALL bool is_a_face(const ObstaclePose<T, D>& pose, const V& first, const V& normal) const {
    V there;
    return height_of(pose, -1, first + seam_ * normal, there) > T(0.8) * seam_;
  }

  // A point around a point of the surface; one behind a face is moved before it.
  MPM_HD_CALL V seen_from(const ObstaclePose<T, D>& pose, const V& first, const V& axis, const T& away, int i) const {
    const V at = first + away * leaning(axis, i);
    V normal;
    const T height = height_of(pose, -1, at, normal);
    return height < T(0) ? at + (T(0.3) * away - height) * normal : at;
  }

  MPM_HD_CALL void add_seen_by_neighbours(int k, const ObstaclePose<T, D>& pose) {
    constexpr int count = D == 2 ? 9 : 27;
    for (int i = 1; i < count; i++) {
      V way;
      for (int j = 0, rest = i; j < D; j++, rest /= 3) way[j] = T(rest % 3 == 2 ? -1 : rest % 3);
      add_plane(k, pose, node_ + reach_ * (pose.rotation * way));
    }
  }

  // The plane that a point outside the shape sees, unless one with that normal is known.
  MPM_HD_CALL void add_plane(int k, const ObstaclePose<T, D>& pose, const V& at) {
    Face<T, D> face{k, -1, true, at, {}, T(0), T(0)};
    face.height = height_of(pose, -1, face.at, face.normal);
    face.depth = T(0) - (face.height + dot(face.normal, node_ + T(-1) * face.at));
    if (!(face.height >= T(0)) || !(dot(face.normal, face.normal) > T(0.5))) return;
    if (!(face.depth >= T(0) - seam_) || face.depth > reach_) return;
    for (int j = planes_; j < faces_.count; j++)
      if (dot(faces_.e[j].normal, face.normal) > T(kSame)) return;
    faces_.add(face);
  }

  // A unit vector, and directions at 55° to it, evenly around.
  static constexpr int kLeaning = D == 2 ? 3 : 7;
  MPM_HD_CALL static V leaning(const V& axis, int i) {
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

  MPM_HD_CALL T height_at(const Face<T, D>& face, const V& x, V& normal) const {
    normal = face.normal;
    if (face.flat) return face.height + dot(face.normal, x + T(-1) * face.at);
    return height_of(poses_[face.obstacle], face.face, x, normal);
  }

  // The nearest point on all faces of a foot; false where there is none whose faces all stop the node.
  MPM_HD_CALL bool solve(Foot<T, D>& foot) const {
    bool curved = false;
    for (int i = 0; i < foot.count; i++) curved = curved || !faces_.e[foot.member[i]].flat;
    foot.at = node_;
    for (int round = 0; round < (curved && foot.count > 1 ? 3 : 1); round++) {
      V normal[D];
      T gram[D][D], again[D][D], share[D], ones[D];
      for (int i = 0; i < foot.count; i++) {
        const T height = height_at(faces_.e[foot.member[i]], foot.at, normal[i]);
        share[i] = dot(normal[i], foot.at + T(-1) * node_) - height;
        ones[i] = T(1);
      }
      for (int i = 0; i < foot.count; i++)
        for (int j = 0; j < foot.count; j++) gram[i][j] = again[i][j] = dot(normal[i], normal[j]);
      if (!solve_definite<T, D>(gram, share, foot.count) || !solve_definite<T, D>(again, ones, foot.count))
        return false;
      foot.at = node_, foot.step = zero_vector<T, D>();
      for (int i = 0; i < foot.count; i++) {
        if (share[i] < T(0) - (foot.count > 1 ? seam_ / 2 : a_.rounding)) return false;
        foot.at = foot.at + share[i] * normal[i];
        foot.step = foot.step + ones[i] * normal[i];
      }
    }
    return length(foot.at + T(-1) * node_) <= reach_;
  }

  // Whether the faces are there on the side of the foot where they bound free space, and that is free.
  MPM_HD_CALL bool is_exposed(const Foot<T, D>& foot) const {
    V normal;
    for (int i = 0; i < foot.count; i++) {
      const Face<T, D>& face = faces_.e[foot.member[i]];
      const auto& pose = poses_[face.obstacle];
      T near = seam_ / 2;
      if (pose.shape == ObstacleShape::sampled) {  // whose normal is not defined at an edge
        normal = face.normal;
        near = near + T(0.5) * pose.data[D];
      } else {
        height_at(face, foot.at, normal);
      }
      const V beside = foot.at + seam_ * (foot.step + T(-1) * normal);
      if (!(height_of(pose, -1, beside, normal) <= near)) return false;
    }
    return is_free(foot.at, foot.step);
  }

  // Whether a step of the height of a seam from a point of surfaces leads into free space.
  MPM_HD_CALL bool is_free(const V& at, const V& step) const {
    V normal;
    const V free = at + seam_ * step;
    for (uint64_t left = poses_.s.near; left; left &= left - 1)
      if (!(height_of(poses_[lowest_bit(left)], -1, free, normal) > seam_ / 2)) return false;
    constexpr double facing = 0.7;  // cosine above which a face looks at a wall
    for (int face = 0; face < 2 * D; face++) {
      if (a_.wall_kind[face] == Contact::open) continue;
      const T towards = face % 2 ? step[face / 2] : T(0) - step[face / 2];
      if (wall_height(a_, face, at) <= seam_ && towards > T(facing)) return false;
    }
    return true;
  }

  // Keeps a foot where it is exposed and less deep than the best one; of equals, by `comes_first`.
  MPM_HD_CALL bool try_foot(Foot<T, D>& foot) {
    foot.depth = depth_[foot.member[foot.count - 1]];
    if (best_.count > 0 && foot.depth > best_.depth) return false;
    if (!solve(foot) || !is_exposed(foot)) return false;
    if (best_.count > 0 && !(foot.depth < best_.depth) && !comes_first(foot)) return false;
    best_ = foot;
    return true;
  }

  // Whether a foot as deep as the best one comes first, whatever the order of obstacles and outlines: by the number of
  // its faces, by the strictest of their kinds, by their largest friction, and by where it leads.
  MPM_HD_CALL bool comes_first(const Foot<T, D>& foot) const {
    if (foot.count != best_.count) return foot.count > best_.count;
    const int kind = strictest(foot), known = strictest(best_);
    if (kind != known) return kind < known;
    const T friction = largest_friction(foot), before = largest_friction(best_);
    if (friction != before) return friction > before;
    for (int i = 0; i < D; i++) {  // as a box alone has it
      const T change = abs(foot.step[i]) - abs(best_.step[i]);
      if (abs(change) > T(1e-3)) return change > T(0);
    }
    for (int i = 0; i < D; i++)
      if (abs(foot.step[i] - best_.step[i]) > T(1e-3)) return foot.step[i] > best_.step[i];
    return false;
  }

  MPM_HD int strictest(const Foot<T, D>& foot) const {
    int kind = int(Contact::separate);
    for (int i = 0; i < foot.count; i++) {
      const int own = int(a_.kind[faces_.e[foot.member[i]].obstacle].contact);
      if (own < kind) kind = own;
    }
    return kind;
  }

  MPM_HD T largest_friction(const Foot<T, D>& foot) const {
    T friction = T(0);
    for (int i = 0; i < foot.count; i++)
      friction = max(friction, poses_.s.row[faces_.e[foot.member[i]].obstacle].friction);
    return friction;
  }

  const SlotPoses<T, D>& poses_;
  const ContactArguments<T, D>& a_;
  const V node_;
  const T seam_, reach_;
  Faces<T, D> faces_;
  T depth_[kMostFaces];  // rounded
  int planes_ = 0;       // the first plane of the obstacle that is looked at, see `add_by_distance`
  Foot<T, D> best_;
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
