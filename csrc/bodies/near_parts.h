#pragma once

#include "grid/contact.h"

// The parts of bodies near a block, and the one that a node meets: as `contact_slot` and `touch_of_node<true>` find
// obstacles, by poses that are computed once in a step.
namespace mpm {
inline namespace TORCH_MPM_ISA {

struct NearParts {
  uint64_t near = 0, touching = 0;  // as of ContactSlot
  bool walled = false;              // whether a wall is near
};

template <class T, int D>
MPM_HD NearParts near_parts(const ContactArguments<T, D>& a, const ObstaclePose<T, D>* poses, const int (&corner)[D]) {
  NearParts parts;
  Vector<T, D> middle = middle_of_block(a, corner), sign;
  parts.walled = is_walled(a, corner);
  if (parts.walled) middle = within_walls(a, middle, T(0), sign);
  const T radius = std::sqrt(T(D)) * half_of_block(a) * T(1.001) + (parts.walled ? T(kSeam * a.dx) : T(0));
  const T margin = a.obstacles > 1 ? T((kReach + kSeam) * a.dx) : T(0);
  MPM_LOOP for (int k = 0; k < a.obstacles; k++) {
    Vector<T, D> normal;
    const T slope = poses[k].shape == ObstacleShape::sampled ? std::sqrt(T(D)) : T(1);
    const T way = surface(poses[k], to_body(poses[k], middle), normal) - a.rounding;
    if (way <= slope * (radius + margin)) parts.near |= uint64_t(1) << k;
    if (way <= slope * radius) parts.touching |= uint64_t(1) << k;
  }
  if (!parts.touching) parts.near = 0;
  return parts;
}

template <class T, int D>
MPM_HD NodeTouch<T, D> touch_of_parts(const ContactArguments<T, D>& a, const ObstaclePose<T, D>* poses,
                                      const NearParts& parts, const Vector<T, D>& position) {
  NearestSurface<T, D> nearest(a, position);
  uint64_t left = parts.touching, others = parts.near & ~parts.touching;
  MPM_LOOP while (left) {
    nearest(lowest_bit(left), poses[lowest_bit(left)]);
    left &= left - 1;
    if (!left && nearest.is_inside()) left = others, others = 0;
  }
  return nearest.found(parts.walled);
}

// The contact of a node that meets part k alone.
template <class T, int D>
MPM_HD void meet_alone(const ContactArguments<T, D>& a, const ObstaclePose<T, D>* poses, int k,
                       const Vector<T, D>& position, NodeContact<T, D>& contact) {
  contact.position = position;
  MPM_UNROLL for (int i = 0; i < D; i++)
    contact.sign[i] = T(1);
  contact.add(k, nearest_face(a, poses[k], to_body(poses[k], position)), position);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
