#pragma once

#include "common/lanes.h"
#include "common/svd.h"

// Arguments and bodies of the kernels of the decompositions: load matrices, decompose, store.
namespace mpm {

template <class T, int D>
struct SVDArguments {
  int64_t count = 0;
  Field<const T> F;      // [P, D, D]
  Field<T> U, sigma, V;  // [P, D, D], [P, D], [P, D, D]
};

template <class T, int D>
struct PolarArguments {
  int64_t count = 0;
  Field<const T> F;
  Field<T> R, S;  // [P, D, D]
};

inline namespace TORCH_MPM_ISA {

template <class At, class T, int D>
MPM_HD void svd_at(const SVDArguments<T, D>& a, const At& at) {
  const auto r = svd(load_matrix<D>(at, a.F));
  store_matrix<D>(at, a.U, r.U);
  MPM_UNROLL for (int i = 0; i < D; i++)
    at.store(a.sigma.pointer + i * a.sigma.stride[1], a.sigma.stride[0], r.sigma[i]);
  store_matrix<D>(at, a.V, r.V);
}

template <class At, class T, int D>
MPM_HD void polar_at(const PolarArguments<T, D>& a, const At& at) {
  const auto r = polar(load_matrix<D>(at, a.F));
  store_matrix<D>(at, a.R, r.R);
  store_matrix<D>(at, a.S, r.S);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
