#pragma once

#include "math/elementary.h"

// Dual numbers a + b ε with ε² = 0: evaluating f at value + derivative ε gives f and its directional derivative
// (forward-mode differentiation; Griewank and Walther 2008, chapter 3).
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T>
struct Dual {
  T value, derivative;
  Dual() = default;
  MPM_HD explicit Dual(double constant) : value(T(constant)), derivative(T(0)) {}
  MPM_HD Dual(const T& v, const T& d) : value(v), derivative(d) {}
};

template <class T>
MPM_HD Dual<T> operator+(const Dual<T>& a, const Dual<T>& b) {
  return {a.value + b.value, a.derivative + b.derivative};
}

template <class T>
MPM_HD Dual<T> operator-(const Dual<T>& a, const Dual<T>& b) {
  return {a.value - b.value, a.derivative - b.derivative};
}

template <class T>
MPM_HD Dual<T> operator*(const Dual<T>& a, const Dual<T>& b) {
  return {a.value * b.value, a.derivative * b.value + a.value * b.derivative};
}

template <class T>
MPM_HD Dual<T> operator/(const Dual<T>& a, const Dual<T>& b) {
  const T quotient = a.value / b.value;
  return {quotient, (a.derivative - quotient * b.derivative) / b.value};
}

template <class T>
MPM_HD Dual<T> expm1(const Dual<T>& a) {
  const T e = expm1(a.value);
  return {e, (e + T(1)) * a.derivative};
}

template <class T>
MPM_HD T value_of(const Dual<T>& a) {
  return a.value;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
