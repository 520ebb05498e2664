#pragma once

#include "common/dual.h"
#include "common/matrix.h"

namespace mpm {

enum class Contact : int { open = 0, sticky = 1, slip = 2, separate = 3, mirror = 4 };

inline namespace TORCH_MPM_ISA {

// A velocity u relative to a surface whose unit normal points into the material, split for contact.
template <class T, int D>
struct ContactSplit {
  T approach;  // speed into the surface; negative when moving away
  Vector<T, D> tangential;
  T speed;  // |tangential|
  T kept;   // remaining fraction of the tangential velocity after friction
};

// Whether friction has an effect: it is not zero, or its derivative at zero is wanted.
template <class T>
MPM_HD bool has_friction(const T& friction) {
  return friction > T(0);
}
template <class T>
MPM_HD bool has_friction(const Dual<T>& friction) {
  return friction.value > T(0) || friction.derivative != T(0);
}

// Coulomb friction removes at most `friction` times the normal velocity that the contact removes. It acts under
// pressure only: a slip surface that holds back material moving away has no friction.
template <class T, int D>
MPM_HD ContactSplit<T, D> split_contact(const Vector<T, D>& u, const Vector<T, D>& normal, const T& friction) {
  ContactSplit<T, D> s;
  s.approach = T(0) - dot(u, normal);
  s.tangential = u + s.approach * normal;
  s.speed = T(0);
  s.kept = T(1);
  if (has_friction(friction) && s.approach > T(0)) {
    s.speed = sqrt(dot(s.tangential, s.tangential));
    const T lost = friction * s.approach;
    s.kept = lost < s.speed ? T(1) - lost / s.speed : T(0);
  }
  return s;
}

// Relative velocity after contact. Sticky removes all of it, slip its normal component, separate the normal component
// only where it points into the surface.
template <class T, int D>
MPM_HD Vector<T, D> contact_velocity(Contact kind, const Vector<T, D>& u, const Vector<T, D>& normal,
                                     const T& friction) {
  if (kind == Contact::sticky) return zero_vector<T, D>();
  const ContactSplit<T, D> s = split_contact(u, normal, friction);
  if (kind == Contact::open || (kind == Contact::separate && !(s.approach > T(0)))) return u;
  return s.kept * s.tangential;
}

// Adjoint of u from the adjoint of contact_velocity.
template <class T, int D>
MPM_HD Vector<T, D> contact_adjoint(Contact kind, const Vector<T, D>& u, const Vector<T, D>& normal, const T& friction,
                                    const Vector<T, D>& grad) {
  if (kind == Contact::sticky) return zero_vector<T, D>();
  const ContactSplit<T, D> s = split_contact(u, normal, friction);
  if (kind == Contact::open || (kind == Contact::separate && !(s.approach > T(0)))) return grad;
  Vector<T, D> tangential = s.kept * grad;
  T approach = T(0);
  if (s.speed > T(0) && s.kept > T(0)) {  // sliding: kept = 1 - friction approach / speed
    const Vector<T, D> direction = (T(1) / s.speed) * s.tangential;
    const T along = dot(grad, direction);
    tangential = tangential + (along * (T(1) - s.kept)) * direction;
    approach = T(0) - friction * along;
  }
  return tangential + (T(0) - dot(tangential, normal) - approach) * normal;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
