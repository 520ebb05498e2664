#pragma once

#include "common/elementary.h"

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
MPM_HD Dual<T> sqrt(const Dual<T>& a) {
  const T root = sqrt(a.value);
  return {root, T(0.5) * a.derivative / root};
}

template <class T>
MPM_HD Dual<T> sin(const Dual<T>& a) {
  return {sin(a.value), cos(a.value) * a.derivative};
}

template <class T>
MPM_HD Dual<T> cos(const Dual<T>& a) {
  return {cos(a.value), T(0) - sin(a.value) * a.derivative};
}

// ln a; see common/elementary.h for its arguments.
template <class T>
MPM_HD Dual<T> log_1p(const Dual<T>& a, const Dual<T>& a_minus_1) {
  return {log_1p(a.value, a_minus_1.value), a.derivative / a.value};
}

template <class T>
MPM_HD Dual<T> abs(const Dual<T>& a) {
  return {abs(a.value), select(a.value < T(0), T(0) - a.derivative, a.derivative)};
}

// Comparisons are those of the values.
#define MPM_DUAL_COMPARISON(op)                                 \
  template <class T>                                            \
  MPM_HD auto operator op(const Dual<T>& a, const Dual<T>& b) { \
    return a.value op b.value;                                  \
  }
MPM_DUAL_COMPARISON(<)
MPM_DUAL_COMPARISON(>)
MPM_DUAL_COMPARISON(<=)
MPM_DUAL_COMPARISON(>=)
MPM_DUAL_COMPARISON(==)
#undef MPM_DUAL_COMPARISON

template <class Mask, class T>
MPM_HD Dual<T> select(const Mask& mask, const Dual<T>& a, const Dual<T>& b) {
  return {select(mask, a.value, b.value), select(mask, a.derivative, b.derivative)};
}

template <class T>
MPM_HD Dual<T> max(const Dual<T>& a, const Dual<T>& b) {
  return select(a > b, a, b);
}

template <class T>
MPM_HD T value_of(const Dual<T>& a) {
  return a.value;
}

// Scalar under a dual number, or the scalar itself; `lift` makes a constant of it.
template <class T>
struct Underlying {
  using type = T;
  MPM_HD static T lift(const T& value) { return value; }
};
template <class T>
struct Underlying<Dual<T>> {
  using type = T;
  MPM_HD static Dual<T> lift(const T& value) { return {value, T(0)}; }
};
template <class T>
using ValueOf = typename Underlying<T>::type;

template <class T>
MPM_HD T lift(const ValueOf<T>& value) {
  return Underlying<T>::lift(value);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
