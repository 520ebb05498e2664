#pragma once

#include "grid/solid.h"

// A body of revolution whose surfaces alone are near a node: the search for these in the plane through the axis and the
// node. All its faces, their normals and the ways between them are in this plane, where faces are straight lines and
// fewer of them join; so the search takes a fraction of the steps of that in space.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// The body in its plane: points have their distance from the axis and their position along it.
template <class T>
struct MeridianPose : ObstaclePose<T, 2> {};

// Points beyond the axis see what their mirror images see.
template <class T>
MPM_HD T face_height(const MeridianPose<T>& o, int face, const Vector<T, 2>& body, Vector<T, 2>& normal, T& beyond) {
  beyond = T(0);
  if (face >= 0) return RevolvedShape::face_height(o, face, body, normal, beyond);
  const bool mirrored = body[0] < T(0);
  const T height =
      polygon_surface(o.data, o.numbers / 2, Vector<T, 2>{{abs(body[0]), body[1]}}, normal, static_cast<T*>(nullptr));
  if (mirrored) normal[0] = T(0) - normal[0];
  return height;
}

template <class T>
MPM_HD bool is_flat(const MeridianPose<T>& o, int face, const Vector<T, 2>& body, const T& reach) {
  return RevolvedShape::is_flat(o, face, body, reach);
}

// One such body as `SolidAt` reads obstacles, without walls.
template <class T>
class MeridianPoses {
 public:
  struct Space {
    struct {
      T inverse_dx;
    } geometry;
    double dx;
    T rounding;
    Contact wall_kind[4];
    T wall_plane[4];
    ObstacleKind kind[1];
    const T* data;
  } a;
  struct {
    uint64_t near;
    const ObstacleRow<T, 2>* row;
  } s;

  template <int D>
  MPM_HD MeridianPoses(const ContactArguments<T, D>& arguments, int k) {
    a.geometry.inverse_dx = arguments.geometry.inverse_dx;
    a.dx = arguments.dx, a.rounding = arguments.rounding;
    MPM_UNROLL for (int face = 0; face < 4; face++)
      a.wall_kind[face] = Contact::open, a.wall_plane[face] = T(0);
    a.kind[0] = arguments.kind[k];
    a.kind[0].first_number = 0;
    a.data = arguments.data + arguments.kind[k].first_number;
    row_ = {};
    row_.extent[1] = T(1);
    s = {1, &row_};
    pose_.acts = true, pose_.shape = ObstacleShape::revolved, pose_.contact = a.kind[0].contact;
    pose_.row = &row_, pose_.data = a.data, pose_.numbers = a.kind[0].numbers;
    pose_.centre = zero_vector<T, 2>(), pose_.rotation = identity<T, 2>();
  }
  MeridianPoses(const MeridianPoses&) = delete;
  MPM_HD const MeridianPose<T>& operator[](int) const { return pose_; }

 private:
  ObstacleRow<T, 2> row_;
  MeridianPose<T> pose_;
};

// Without a call: it is short in a plane, and there is one place for it.
template <class T>
MPM_HD void compute_face(bool wanted, const MeridianPoses<T>& poses, const T& reach, Face<T, 2>& face, T& beyond) {
  if (wanted) set_face(poses, reach, face, beyond);
}

// Whether obstacle `inside` is such a body, with no wall that a foot of the node may be at, and the place of the node
// in its plane. A node on the axis has many planes.
template <class Poses, class T>
MPM_HD bool is_in_meridian(const Poses& poses, int inside, const Vector<T, 3>& x, Vector<T, 2>& place) {
  const auto& a = poses.a;
  const auto& s = poses.s;
  if (inside < 0 || s.near != uint64_t(1) << inside || a.kind[inside].shape != ObstacleShape::revolved) return false;
  if (s.walled && !(nearest_wall(a, x) > T(kReach * a.dx) + 2 * seam_of(a))) return false;
  const auto& pose = poses[inside];
  place = AroundAxis<T, 3>(extent_of(pose), to_body(pose, x)).point;
  return place[0] > T(0);
}

// Finds the faces that a node meets there; by all threads of a warp, as `any_of_warp`.
template <class T, int D>
MPM_HD_CALL void find_in_meridian(bool wanted, const ContactArguments<T, D>& a, int inside, const Vector<T, 2>& place,
                                  int& count, int (&face)[D]) {
  const MeridianPoses<T> poses(a, wanted ? inside : 0);
  SolidAt<MeridianPoses<T>, T, 2> solid(poses, place);
  solid.find(wanted);
  count = solid.foot().count;
  MPM_LOOP for (int i = 0; i < count; i++)
    face[i] = solid.face(i).face;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
