#pragma once

#include "grid/contact.h"
#include "grid/grid_update.h"

// Impulses on the walls of the domain, and on obstacles: the physics is that of the grid update and of contact.
namespace mpm {

template <class T, int D>
struct WallImpulsesArguments {
  GridUpdateArguments<T, D> update;  // its `updated` unused
  ImpulseArguments<D> impulse;       // of the 2 D faces
};

template <class T, int D>
struct WallImpulsesBackwardArguments {
  GridUpdateBackwardArguments<T, D> update;
  ImpulseArguments<D> impulse;
};

// Backward, the first column of `contact.result` is the adjoint of the mass.
template <class T, int D>
struct ContactImpulsesArguments {
  ContactArguments<T, D> contact;
  const T* mass = nullptr;  // of node i at mass + i * mass_stride
  int64_t mass_stride = 0;
  ImpulseArguments<D> impulse;
};

inline namespace TORCH_MPM_ISA {

// put(scene, face, sum) is called for each face that a slot touches, with the sum over the nodes lane, lane + Lanes,
// ...
template <int Lanes, class T, int D, class Put>
MPM_HD void slot_wall_impulses(const WallImpulsesArguments<T, D>& a, int slot, int lane, Put&& put) {
  const Walls<T, D>& walls = a.update.walls;
  const SlotUpdate<T, D> s = slot_update(a.update, slot);
  if (!s.active || s.scene >= a.impulse.scenes) return;
  for (int face = 0; face < 2 * D; face++) {
    if (!near_wall(walls, s.corner, face) && !near_mirror(walls, s.corner, face)) continue;
    ImpulseSum<D> sum;
    for (int local = lane; local < kBlockNodes<D>; local += Lanes) {
      const NodeRow<T, D> row = a.update.nodes[int64_t(slot) * kBlockNodes<D> + local];
      sum.add(lattice_position(a.impulse, lattice_node<D>(s.corner, local)),
              wall_impulse(a.update, s, local, row, face));
    }
    put(s.scene, face, sum);
  }
}

// The same for obstacles, of velocities before contact.
template <int Lanes, class T, int D, class Put>
MPM_HD void slot_contact_impulses(const ContactImpulsesArguments<T, D>& a, int slot, int lane, Put&& put) {
  const ContactArguments<T, D>& c = a.contact;
  const SlotPoses<T, D> poses(c, slot);
  const ContactSlot<T, D>& s = poses.s;
  const bool acts = s.near && s.scene < a.impulse.scenes;
  const int64_t first = int64_t(slot) * kBlockNodes<D>;
  constexpr int count = kBlockNodes<D> / Lanes;
  TakenVelocities<T, D> taken[count];
  for (int n = 0; n < count; n++) {
    const int local = lane + n * Lanes;
    NodeContact<T, D> contact;
    find_contact(acts && a.mass[(first + local) * a.mass_stride] != T(0), poses, node_position(c, s.corner, local),
                 contact);
    if (any_of_warp(contact.count > 0)) {
      find_taken(contact.count > 0, poses, contact, load_node<T, D>(c.velocity, c.stride, first + local), taken[n]);
      join_warp();
    }
  }
  for (uint64_t left = acts ? s.near : 0; left; left &= left - 1) {
    const int k = lowest_bit(left);
    ImpulseSum<D> sum;
    for (int n = 0; n < count; n++) {
      const int local = lane + n * Lanes;
      for (int i = 0; i < taken[n].count; i++)
        if (taken[n].obstacle[i] == k)
          sum.add(lattice_position(a.impulse, lattice_node<D>(s.corner, local)),
                  a.mass[(first + local) * a.mass_stride] * taken[n].taken[i]);
    }
    put(s.scene, k, sum);
  }
}

// Of rows of the nodes, for the adjoint of the grid update.
template <class T, int D>
struct ImpulsesOfRows {
  const WallImpulsesBackwardArguments<T, D>& a;
  MPM_HD NodeImpulses<T, D> operator()(int scene, int64_t row) const {
    return {a.impulse, scene, a.update.forward.nodes[row].mass};
  }
};

// For the adjoint of contact.
template <class T, int D>
struct ImpulsesOfNodes {
  const ContactImpulsesArguments<T, D>& a;
  MPM_HD NodeImpulses<T, D> operator()(int scene, int64_t node) const {
    return {a.impulse, scene, a.mass[node * a.mass_stride]};
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
