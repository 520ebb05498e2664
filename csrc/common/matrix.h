#pragma once

#include "common/elementary.h"

// Vectors and square matrices of D = 2 or 3 over any scalar: float, double, a dual number or a pack of lanes.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
struct Vector {
  T e[D];
  MPM_HD T& operator[](int i) { return e[i]; }
  MPM_HD const T& operator[](int i) const { return e[i]; }
};

template <class T, int D>
struct Matrix {
  T e[D][D];
  MPM_HD T* operator[](int i) { return e[i]; }
  MPM_HD const T* operator[](int i) const { return e[i]; }
};

template <class T, int D>
MPM_HD Vector<T, D> zero_vector() {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = T(0);
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> zero_matrix() {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = T(0);
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> identity() {
  Matrix<T, D> r = zero_matrix<T, D>();
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i][i] = T(1);
  return r;
}

template <class T, int D>
MPM_HD Vector<T, D> operator+(const Vector<T, D>& a, const Vector<T, D>& b) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = a[i] + b[i];
  return r;
}

template <class T, int D>
MPM_HD Vector<T, D> operator*(const T& s, const Vector<T, D>& a) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = s * a[i];
  return r;
}

template <class T, int D>
MPM_HD T dot(const Vector<T, D>& a, const Vector<T, D>& b) {
  T r = a[0] * b[0];
  MPM_UNROLL for (int i = 1; i < D; i++)
    r = r + a[i] * b[i];
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> operator+(const Matrix<T, D>& a, const Matrix<T, D>& b) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = a[i][j] + b[i][j];
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> operator-(const Matrix<T, D>& a, const Matrix<T, D>& b) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = a[i][j] - b[i][j];
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> operator*(const T& s, const Matrix<T, D>& a) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = s * a[i][j];
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> operator*(const Matrix<T, D>& a, const Matrix<T, D>& b) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) {
      T s = a[i][0] * b[0][j];
      MPM_UNROLL for (int k = 1; k < D; k++)
        s = s + a[i][k] * b[k][j];
      r[i][j] = s;
    }
  return r;
}

template <class T, int D>
MPM_HD Vector<T, D> operator*(const Matrix<T, D>& a, const Vector<T, D>& b) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    T s = a[i][0] * b[0];
    MPM_UNROLL for (int k = 1; k < D; k++)
      s = s + a[i][k] * b[k];
    r[i] = s;
  }
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> outer(const Vector<T, D>& a, const Vector<T, D>& b) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = a[i] * b[j];
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> transpose(const Matrix<T, D>& a) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = a[j][i];
  return r;
}

template <class T, int D>
MPM_HD T trace(const Matrix<T, D>& a) {
  T r = a[0][0];
  MPM_UNROLL for (int i = 1; i < D; i++)
    r = r + a[i][i];
  return r;
}

// A : B, the sum of products of entries.
template <class T, int D>
MPM_HD T contract(const Matrix<T, D>& a, const Matrix<T, D>& b) {
  T r = a[0][0] * b[0][0];
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++)
      if (i + j) r = r + a[i][j] * b[i][j];
  return r;
}

// Cofactor matrix: d det(a) / da, and a⁻ᵀ det(a); defined for singular a.
template <class T>
MPM_HD Matrix<T, 2> cofactor(const Matrix<T, 2>& a) {
  Matrix<T, 2> r;
  r[0][0] = a[1][1];
  r[0][1] = T(0) - a[1][0];
  r[1][0] = T(0) - a[0][1];
  r[1][1] = a[0][0];
  return r;
}

template <class T>
MPM_HD Matrix<T, 3> cofactor(const Matrix<T, 3>& a) {
  Matrix<T, 3> r;
  MPM_UNROLL for (int i = 0; i < 3; i++) MPM_UNROLL
    for (int j = 0; j < 3; j++) {
      const int p = (i + 1) % 3, q = (i + 2) % 3, s = (j + 1) % 3, t = (j + 2) % 3;
      r[i][j] = a[p][s] * a[q][t] - a[p][t] * a[q][s];
    }
  return r;
}

template <class T, int D>
MPM_HD T determinant(const Matrix<T, D>& a) {
  const Matrix<T, D> c = cofactor(a);
  T r = a[0][0] * c[0][0];
  MPM_UNROLL for (int j = 1; j < D; j++)
    r = r + a[0][j] * c[0][j];
  return r;
}

template <class T, int D>
MPM_HD Matrix<T, D> symmetric_part(const Matrix<T, D>& a) {
  return T(0.5) * (a + transpose(a));
}

template <class T, int D>
MPM_HD Matrix<T, D> skew_part(const Matrix<T, D>& a) {
  return T(0.5) * (a - transpose(a));
}

template <class Mask, class T, int D>
MPM_HD Vector<T, D> select(const Mask& mask, const Vector<T, D>& a, const Vector<T, D>& b) {
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = select(mask, a[i], b[i]);
  return r;
}

template <class Mask, class T, int D>
MPM_HD Matrix<T, D> select(const Mask& mask, const Matrix<T, D>& a, const Matrix<T, D>& b) {
  Matrix<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = select(mask, a[i][j], b[i][j]);
  return r;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
