#pragma once

#include "cpu/chunk.h"
#include "transfer/momentum.h"

// What particles give to their nodes, in the form that the sums of scatter.h and gather.h take:
//   node k += N_k (value + slope · k) + gradient · ∇N_k,
// with k counted from the base node, and distances in cells.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class P, int D>
struct Gift {
  P value[kChannels], slope[D][kChannels], gradient[D][kChannels];
};

template <class T, int D, class G>
MPM_HD Matrix<Lanes<T>, D> load_matrix(const Field<const T>& f, const G& g) {
  if (!f.pointer) return zero_matrix<Lanes<T>, D>();
  Matrix<Lanes<T>, D> r;
  MPM_UNROLL
  for (int i = 0; i < D; i++)
    MPM_UNROLL
  for (int j = 0; j < D; j++) r[i][j] = load(f, g, i, j);
  return r;
}

// The inputs of a group of particles, a Group or a Run.
template <class T, int D, class G>
MPM_HD ParticleMomentum<Lanes<T>, D> load_momentum(const P2GArguments<T, D>& a, const G& g, int scene) {
  ParticleMomentum<Lanes<T>, D> p;
  p.mass = load(a.mass, g);
  p.affine = load_matrix<T, D>(a.affine, g);
  p.stress = load_matrix<T, D>(a.stress, g);
  p.volume = a.stress.pointer ? load(a.volume, g) : Lanes<T>(0);
  p.dt = Lanes<T>(T(a.dt) * (a.scene_dt.pointer ? a.scene_dt.pointer[scene * a.scene_dt.stride[0]] : T(1)));
  MPM_UNROLL
  for (int i = 0; i < D; i++) p.velocity[i] = load(a.velocity, g, i);
  return p;
}

template <int Order, bool Slope, class T, int D>
MPM_HD Gift<Lanes<T>, D> gift_of_momentum(const P2GArguments<T, D>& a, const ParticleMomentum<Lanes<T>, D>& p,
                                          const Lanes<T> f[D]) {
  using P = Lanes<T>;
  const Geometry<T, D>& geometry = a.topology.geometry;
  const NodeMomentum<P, D> n =
      to_nodes<Order>(p, a.form, a.affine.pointer, a.stress.pointer, P(geometry.dx), P(geometry.inverse_dx));
  Gift<P, D> gift;
  MPM_UNROLL
  for (int c = 0; c < kChannels; c++) {
    const bool momentum = c >= 1 && c <= D;
    const int i = momentum ? c - 1 : 0;
    gift.value[c] = c == 0 ? n.mass : momentum ? n.momentum[i] : P(0);
    MPM_UNROLL
    for (int d = 0; d < D; d++) {
      gift.slope[d][c] = momentum ? n.moment[i][d] : P(0);
      gift.gradient[d][c] = momentum ? n.gradient[i][d] : P(0);
      if (Slope && momentum) gift.value[c] = gift.value[c] - n.moment[i][d] * f[d];
    }
  }
  return gift;
}

// Channels first, ..., first + count - 1 of the features of ScatterArguments or PositionGradientArguments.
template <bool Slope, bool Gradient, class T, int D, class Arguments>
MPM_HD Gift<Lanes<T>, D> gift_of_features(const Arguments& a, int first, int count, const Group& g,
                                          const Lanes<T> f[D]) {
  using P = Lanes<T>;
  const Geometry<T, D>& geometry = a.topology.geometry;
  const P scale(a.moment_scale * double(geometry.dx)), inverse_dx(geometry.inverse_dx);
  Gift<P, D> gift;
  MPM_UNROLL
  for (int c = 0; c < kChannels; c++) {
    gift.value[c] = c < count ? load(a.value, g, first + c) : P(0);
    MPM_UNROLL
    for (int d = 0; d < D; d++) {
      gift.slope[d][c] = Slope && a.moment.pointer && c < count ? scale * load(a.moment, g, first + c, d) : P(0);
      gift.gradient[d][c] = Gradient && c < count ? inverse_dx * load(a.gradient, g, first + c, d) : P(0);
      if (Slope) gift.value[c] = gift.value[c] - gift.slope[d][c] * f[d];
    }
  }
  return gift;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
