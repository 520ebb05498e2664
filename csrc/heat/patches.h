#pragma once

#include <cstdint>

#include "common/host_device.h"

// Additive Schwarz on overlapping patches of 2^D nodes: z_i = Σ_o (B_o R_o r)_i with the inverse B_o of a small matrix.
namespace mpm {

template <int D>
constexpr int kCorners = 1 << D;

// A patch has the number of its first node.
template <class T, int D>
struct PatchArguments {
  int64_t count = 0;             // nodes and patches
  const T* inverse = nullptr;    // B [count, 2^D, 2^D]
  const int* rows = nullptr;     // [count, 2^D] nodes of a patch, -1 where none
  const int* patches = nullptr;  // [count, 2^D] patches that a node is corner k of, -1 where none
  const T* r = nullptr;          // [count]
  T* solved = nullptr;           // B_o R_o r [count, 2^D]
  T* sum = nullptr;              // z [count]
};

inline namespace TORCH_MPM_ISA {

template <class T, int D>
MPM_HD void solve_corner(const PatchArguments<T, D>& a, int64_t o, int k) {
  T sum = T(0);
  MPM_UNROLL for (int j = 0; j < kCorners<D>; j++) {
    const int i = a.rows[o * kCorners<D> + j];
    if (i >= 0 && i < a.count) sum += a.inverse[(o * kCorners<D> + k) * kCorners<D> + j] * a.r[i];
  }
  a.solved[o * kCorners<D> + k] = sum;
}

template <class T, int D>
MPM_HD void sum_corners(const PatchArguments<T, D>& a, int64_t i) {
  T sum = T(0);
  MPM_UNROLL for (int k = 0; k < kCorners<D>; k++) {
    const int o = a.patches[i * kCorners<D> + k];
    if (o >= 0 && o < a.count) sum += a.solved[int64_t(o) * kCorners<D> + k];
  }
  a.sum[i] = sum;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
