#pragma once

#include "common/fields.h"
#include "common/matrix.h"

// Access of a kernel body to its particles: `One` is the particle of a CUDA thread; cpu/lanes.h has the particles in
// the lanes of a pack.
namespace mpm {

// Subset of the particles: those of one material, or all.
struct Members {
  const int* material = nullptr;  // [P], or null for all
  int64_t stride = 0;
  int member = 0;

  MPM_HD bool has(int64_t p) const { return !material || material[p * stride] == member; }
};

inline namespace TORCH_MPM_ISA {

template <class T>
struct One {
  using Value = T;
  int64_t p;

  MPM_HD T load(const T* pointer, int64_t stride) const { return pointer[p * stride]; }
  // A value that is often the same for all particles; its stride is then 0.
  MPM_HD T load_shared(const T* pointer, int64_t stride) const { return load(pointer, stride); }
  MPM_HD void store(T* pointer, int64_t stride, const T& value) const { pointer[p * stride] = value; }
  // f(particle) for each particle.
  template <class F>
  MPM_HD T each(const F& f) const {
    return f(p);
  }
  MPM_HD void store_integer(int* pointer, const T& value) const { pointer[p] = int(value); }
};

// Stored values are added to the present ones.
template <class At>
struct Adding : At {
  MPM_HD explicit Adding(const At& at) : At(at) {}
  template <class T>
  MPM_HD void store(T* pointer, int64_t stride, const typename At::Value& value) const {
    At::store(pointer, stride, At::load(pointer, stride) + value);
  }
};

template <class At, class T>
MPM_HD typename At::Value load_scalar(const At& at, const Field<const T>& f) {
  return at.load(f.pointer, f.stride[0]);
}

template <class At, class T>
MPM_HD void store_scalar(const At& at, const Field<T>& f, const typename At::Value& a) {
  at.store(f.pointer, f.stride[0], a);
}

template <int D, class At, class T>
MPM_HD Vector<typename At::Value, D> load_vector(const At& at, const Field<const T>& f) {
  Vector<typename At::Value, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = at.load(f.pointer + i * f.stride[1], f.stride[0]);
  return r;
}

template <int D, class At, class T>
MPM_HD void store_vector(const At& at, const Field<T>& f, const Vector<typename At::Value, D>& a) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    at.store(f.pointer + i * f.stride[1], f.stride[0], a[i]);
}

// All entries are loaded before any is stored. A compiler keeps the order of a store and a load that may be of the same
// memory, so that otherwise each entry takes the time of an access.
template <int D, class At, class T>
MPM_HD void store_vector(const Adding<At>& at, const Field<T>& f, const Vector<typename At::Value, D>& a) {
  const At& plain = at;
  store_vector<D>(plain, f, load_vector<D>(plain, constant(f)) + a);
}

template <int D, class At, class T>
MPM_HD Matrix<typename At::Value, D> load_matrix(const At& at, const Field<const T>& f) {
  Matrix<typename At::Value, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = at.load(f.pointer + i * f.stride[1] + j * f.stride[2], f.stride[0]);
  return r;
}

template <int D, class At, class T>
MPM_HD void store_matrix(const At& at, const Field<T>& f, const Matrix<typename At::Value, D>& a) {
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) at.store(f.pointer + i * f.stride[1] + j * f.stride[2], f.stride[0], a[i][j]);
}

template <int D, class At, class T>
MPM_HD void store_matrix(const Adding<At>& at, const Field<T>& f, const Matrix<typename At::Value, D>& a) {
  const At& plain = at;
  store_matrix<D>(plain, f, load_matrix<D>(plain, constant(f)) + a);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
