#pragma once

#include <cstdint>

#include "common/host_device.h"

// Quadratic and cubic B-spline weights of the nodes base, base + 1, ... in terms of f = X - base, the distance of the
// particle from its base node in cells (Steffen, Kirby and Berzins 2008).
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <int Order>
struct BSpline;

// f in [1/2, 3/2).
template <>
struct BSpline<2> {
  static constexpr int support = 3;
  static constexpr double base_offset = 0.5;    // base = floor(X - base_offset)
  static constexpr double inverse_inertia = 4;  // dx² D⁻¹, from D = Σ N_i r rᵀ = dx²/4 I

  template <class T>
  MPM_HD static void weights(const T& f, T w[3]) {
    const T a = T(1.5) - f, b = f - T(1), c = f - T(0.5);
    w[0] = T(0.5) * a * a;
    w[1] = T(0.75) - b * b;
    w[2] = T(0.5) * c * c;
  }
  template <class T>
  MPM_HD static void first_derivatives(const T& f, T w[3]) {
    w[0] = f - T(1.5);
    w[1] = T(2) - T(2) * f;
    w[2] = f - T(0.5);
  }
  template <class T>
  MPM_HD static void second_derivatives(const T&, T w[3]) {
    w[0] = T(1);
    w[1] = T(-2);
    w[2] = T(1);
  }
};

// f in [1, 2).
template <>
struct BSpline<3> {
  static constexpr int support = 4;
  static constexpr double base_offset = 1.0;
  static constexpr double inverse_inertia = 3;  // D = dx²/3 I

  template <class T>
  MPM_HD static void weights(const T& f, T w[4]) {
    const T a = T(2) - f, b = f - T(1);  // distances from the two nodes around the particle, a + b = 1
    w[0] = T(1.0 / 6) * a * a * a;
    w[1] = T(2.0 / 3) - b * b * (T(1) - T(0.5) * b);
    w[2] = T(2.0 / 3) - a * a * (T(1) - T(0.5) * a);
    w[3] = T(1.0 / 6) * b * b * b;
  }
  template <class T>
  MPM_HD static void first_derivatives(const T& f, T w[4]) {
    const T a = T(2) - f, b = f - T(1);
    w[0] = T(-0.5) * a * a;
    w[1] = b * (T(1.5) * b - T(2));
    w[2] = a * (T(2) - T(1.5) * a);
    w[3] = T(0.5) * b * b;
  }
  template <class T>
  MPM_HD static void second_derivatives(const T& f, T w[4]) {
    const T a = T(2) - f, b = f - T(1);
    w[0] = a;
    w[1] = T(3) * b - T(2);
    w[2] = T(3) * a - T(2);
    w[3] = b;
  }
};

inline double inverse_inertia(int64_t order) {
  return order == 2 ? BSpline<2>::inverse_inertia : BSpline<3>::inverse_inertia;
}

// Weight of one node, for a thread that adds to node k of every particle: c + d² (p + q d), d being the distance from a
// point of the spline.
template <int Order, class T>
struct NodeWeight;

template <class T>
struct NodeWeight<2, T> {
  T centre, constant, square;
  MPM_HD explicit NodeWeight(int k)
      : centre(T(1.5) - T(0.5) * T(k)), constant(k == 1 ? T(0.75) : T(0)), square(k == 1 ? T(-1) : T(0.5)) {}
  MPM_HD T at(const T& f) const {
    const T d = f - centre;
    return constant + square * d * d;
  }
  MPM_HD T slope(const T& f) const { return T(2) * square * (f - centre); }
};

template <class T>
struct NodeWeight<3, T> {
  T sign, constant, square, cube;
  MPM_HD explicit NodeWeight(int k)
      : sign(k % 2 == 0 ? T(-1) : T(1)),
        constant(k % 3 == 0 ? T(0) : T(2.0 / 3)),
        square(k % 3 == 0 ? T(0) : T(-1)),
        cube(k % 3 == 0 ? T(1.0 / 6) : T(0.5)) {}
  MPM_HD T distance(const T& f) const { return sign < T(0) ? T(2) - f : f - T(1); }
  MPM_HD T at(const T& f) const {
    const T d = distance(f);
    return constant + d * d * (square + cube * d);
  }
  MPM_HD T slope(const T& f) const {
    const T d = distance(f);
    return sign * d * (T(2) * square + T(3) * cube * d);
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
