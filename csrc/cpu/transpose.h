#pragma once

#include <utility>

#include "cpu/chunk.h"

// From one pack per field to one row of fields per particle.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Lanes whose number lacks the bit `Step` from a, or that have it if High, each beside the same one of b.
template <int Step, bool High, class V, int... Lane>
MPM_HD V exchange(const V& a, const V& b, std::integer_sequence<int, Lane...>) {
  constexpr int N = sizeof...(Lane);
  constexpr auto source = [](int lane) { return (lane & Step ? N : 0) + (High ? lane | Step : lane & ~Step); };
  return __builtin_shufflevector(a, b, source(Lane)...);
}

// One round of a transposition: lanes and packs whose numbers differ in the bit `Step` are exchanged.
template <int Step, class T, int N>
MPM_HD void exchange_all(Pack<T, N> r[8]) {
  constexpr auto all = std::make_integer_sequence<int, N>();
  MPM_UNROLL for (int i = 0; i < 8; i++) {
    if (i & Step) continue;
    const auto a = r[i].part[0], b = r[i + Step].part[0];
    r[i].part[0] = exchange<Step, false>(a, b, all);
    r[i + Step].part[0] = exchange<Step, true>(a, b, all);
  }
}

// Transposes 8 packs of 8 lanes, or the two halves of 8 packs of 16 lanes separately.
template <class T, int N>
MPM_HD void transpose(Pack<T, N> r[8]) {
  exchange_all<1>(r);
  exchange_all<2>(r);
  exchange_all<4>(r);
}

// The first or second 8 lanes.
template <class T, int N>
MPM_HD void store_half(const Pack<T, N>& v, int half, T* to) {
  if constexpr (N == 8) {
    v.store(to);
  } else {
    const auto eight = half ? __builtin_shufflevector(v.part[0], v.part[0], 8, 9, 10, 11, 12, 13, 14, 15)
                            : __builtin_shufflevector(v.part[0], v.part[0], 0, 1, 2, 3, 4, 5, 6, 7);
    __builtin_memcpy(to, &eight, sizeof(eight));
  }
}

// Stores lane l of field k at to[l * stride + k]; Fields is a multiple of 8.
template <int Fields, class T, int N>
MPM_HD void store_transposed(Pack<T, N> field[Fields], T* to, int stride) {
  MPM_UNROLL for (int first = 0; first < Fields; first += 8) {
    if constexpr (Pack<T, N>::kParts == 1) {
      transpose(field + first);
      MPM_UNROLL for (int l = 0; l < N; l++)
        store_half(field[first + l % 8], l / 8, to + l * stride + first);
    } else {
      T lanes[8][N];
      MPM_UNROLL for (int k = 0; k < 8; k++)
        field[first + k].store(lanes[k]);
      for (int l = 0; l < N; l++)
        for (int k = 0; k < 8; k++) to[l * stride + first + k] = lanes[k][l];
    }
  }
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
