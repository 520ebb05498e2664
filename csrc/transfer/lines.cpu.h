#pragma once

#include "transfer/gather.cpu.h"

// G2P of quadratic splines by polynomials along the last axis, which takes more than half of the work otherwise. For
// nodes g₀, g₁, g₂ and a particle at distance z from the second one, in cells, with
//   c = (g₀ − 2 g₁ + g₂) / 8,   b = (g₂ − g₀) / 8,   a = g₁ + c:
//   Σ N g = a + 4z (b + c z),   Σ N g r = b + c z (3 − 4z²),   Σ g ∂N = 4 (b + 2 c z).
// All particles of a cell share a, b and c.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// a, b and c of the cells of a base block, for kChannels channels.
template <class T, int D>
struct Lines {
  using From = Tile<2, T, D>;
  static constexpr int kCells = kBlockWidth * kChannels, kRow = 3 * kCells;
  alignas(64) T value[From::kRows * kRow];

  static constexpr int stride(int axis) {
    return axis == D - 1 ? kChannels : axis == D - 2 ? kRow : From::kWidth * kRow;
  }
  static int at(const int node[D]) {
    int r = 0;
    for (int i = 0; i < D; i++) r += node[i] * stride(i);
    return r;
  }

  void load_from(const From& tile) {
    using P = Pack<T, kCells>;
    for (int row = 0; row < From::kRows; row++) {
      const T* const nodes = tile.value + row * From::kRow;
      T* const to = value + row * kRow;
      const P g0 = P::load(nodes), g1 = P::load(nodes + kChannels), g2 = P::load(nodes + 2 * kChannels);
      const P c = P(0.125) * (g0 + g2) - P(0.25) * g1;
      (g1 + c).store(to);
      (P(0.125) * (g2 - g0)).store(to + kCells);
      c.store(to + 2 * kCells);
    }
  }
};

// Factors of b and c in these sums.
template <class P>
struct LastAxis {
  P z, four_z, moment, two_z;

  MPM_HD explicit LastAxis(const P& f)
      : z(f - P(1)), four_z(P(4) * z), moment(z * (P(3) - four_z * z)), two_z(P(2) * z) {}
};

// Two channels of each particle side by side.
template <class T>
using Pairs = Pack<T, 2 * kLanes>;
// Whether a register holds them, which halves the instructions.
#ifdef __AVX512F__
template <class T>
constexpr bool kHasPairs = sizeof(T) == 4;
#else
template <class T>
constexpr bool kHasPairs = false;
#endif

// A channel in all lanes, or it and the next one in pairs of lanes.
template <class T>
MPM_HD void spread_channel(const T* from, Lanes<T>& to) {
  to = Lanes<T>(from[0]);
}
#ifdef __AVX512F__
MPM_HD void spread_channel(const float* from, Pairs<float>& to) {
  long long pair;
  __builtin_memcpy(&pair, from, sizeof(pair));
  to.part[0] = _mm512_castsi512_ps(_mm512_set1_epi64(pair));  // one instruction, unlike a shuffle
}
#endif

// The same values for both channels; and those of one channel.
template <class T>
MPM_HD Pairs<T> for_both(const Lanes<T>& v) {
  Pairs<T> r;
  r.part[0] = __builtin_shufflevector(v.part[0], v.part[0], 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7);
  return r;
}
template <int Channel, class T>
MPM_HD Lanes<T> of_channel(const Pairs<T>& v) {
  constexpr int c = Channel;
  Lanes<T> r;
  r.part[0] = __builtin_shufflevector(v.part[0], v.part[0], c, 2 + c, 4 + c, 6 + c, 8 + c, 10 + c, 12 + c, 14 + c);
  return r;
}

// For one channel, or a pair of them; the moments are about the second nodes, except that of the last axis, which is
// about the particle.
template <int Axis, bool Gradient, class T, int D, class P>
MPM_HD Sums<P, D - Axis> sum_lines(const Weights<2, P, D>& s, const LastAxis<P>& last, const T* lines) {
  using L = Lines<T, D>;
  if constexpr (Axis + 1 < D) {
    return sum_axis<2, Axis, true, Gradient>(
        s, [&](int k) { return sum_lines<Axis + 1, Gradient>(s, last, lines + k * L::stride(Axis)); });
  } else {
    P a, b, c;
    spread_channel(lines, a);
    spread_channel(lines + L::kCells, b);
    spread_channel(lines + 2 * L::kCells, c);
    Sums<P, 1> r;
    r.value = fma(last.four_z, fma(c, last.z, b), a);
    r.moment[0] = fma(c, last.moment, b);
    if (Gradient) r.gradient[0] = P(4) * fma(c, last.two_z, b);
    return r;
  }
}

// As gather_channels, with moments; for `Channels` channels, or pairs of them.
template <int Channels, bool Gradient, class T, int D, class P>
MPM_HD void gather_lines(const P f[D], const T* lines, Sums<P, D> sums[Channels]) {
  const Weights<2, P, D> s(f, Gradient ? 1 : 0);
  const LastAxis<P> last(f[D - 1]);
  MPM_UNROLL for (int c = 0; c < Channels; c++) {
    sums[c] = sum_lines<0, Gradient, T, D>(s, last, lines + c);
    MPM_UNROLL for (int a = 0; a + 1 < D; a++)
      sums[c].moment[a] = sums[c].moment[a] - (f[a] - P(1)) * sums[c].value;
  }
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
