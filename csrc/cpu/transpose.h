#pragma once

#include "cpu/chunk.h"

// From one pack per field to one row of fields per particle.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Transposes 8 packs of 8 lanes in registers: three rounds that exchange halves, quarters and neighbours.
template <class T>
MPM_HD void transpose(Lanes<T> r[kLanes]) {
  typedef typename PackShape<T, kLanes>::Value V;
  V t[8], u[8];
  MPM_UNROLL
  for (int i = 0; i < 8; i += 2) {
    t[i] = __builtin_shufflevector(r[i].part[0], r[i + 1].part[0], 0, 8, 2, 10, 4, 12, 6, 14);
    t[i + 1] = __builtin_shufflevector(r[i].part[0], r[i + 1].part[0], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  MPM_UNROLL
  for (int k = 0; k < 4; k++) {
    const int i = k / 2 * 4 + k % 2;
    u[i] = __builtin_shufflevector(t[i], t[i + 2], 0, 1, 8, 9, 4, 5, 12, 13);
    u[i + 2] = __builtin_shufflevector(t[i], t[i + 2], 2, 3, 10, 11, 6, 7, 14, 15);
  }
  MPM_UNROLL
  for (int i = 0; i < 4; i++) {
    r[i].part[0] = __builtin_shufflevector(u[i], u[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    r[i + 4].part[0] = __builtin_shufflevector(u[i], u[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
}

// Lane l of field k to to[l * stride + k]; Fields is a multiple of kLanes.
template <int Fields, class T>
MPM_HD void store_transposed(Lanes<T> field[Fields], T* to, int stride) {
  MPM_UNROLL
  for (int first = 0; first < Fields; first += kLanes) {
    if constexpr (Lanes<T>::kParts == 1) {
      transpose<T>(field + first);
      MPM_UNROLL
      for (int l = 0; l < kLanes; l++) field[first + l].store(to + l * stride + first);
    } else {
      T lanes[kLanes][kLanes];
      MPM_UNROLL
      for (int k = 0; k < kLanes; k++) field[first + k].store(lanes[k]);
      for (int l = 0; l < kLanes; l++)
        for (int k = 0; k < kLanes; k++) to[l * stride + first + k] = lanes[k][l];
    }
  }
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
