#pragma once

#include "cpu/chunk.h"
#include "cpu/tile.h"
#include "transfer/arguments.h"

// Contributions of particles to their nodes, in the form of the sums of scatter.h and gather.h:
//   node k += N_k (value + slope · k) + gradient · ∇N_k,
// with k counted from the base node, and distances in cells.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class P, int D>
struct Contribution {
  P value[kChannels], slope[D][kChannels], gradient[D][kChannels];
};

template <class T, int D, class G>
MPM_HD Matrix<Pack<T, G::kSize>, D> load_matrix_or_zero(const Field<const T>& f, const G& g) {
  using P = Pack<T, G::kSize>;
  if (!f.pointer) return zero_matrix<P, D>();
  Matrix<P, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) r[i][j] = load(f, g, i, j);
  return r;
}

// Inputs of a GroupOf or RunOf particles.
template <class T, int D, class G>
MPM_HD ParticleMomentum<Pack<T, G::kSize>, D> load_momentum(const P2GArguments<T, D>& a, const G& g, int scene) {
  using P = Pack<T, G::kSize>;
  ParticleMomentum<P, D> p;
  p.mass = load(a.mass, g);
  p.affine = load_matrix_or_zero<T, D>(a.affine, g);
  p.stress = load_matrix_or_zero<T, D>(a.stress, g);
  p.volume = a.stress.pointer ? load(a.volume, g) : P(0);
  p.dt = P(time_step(a.scene_dt, a.dt, scene));
  MPM_UNROLL for (int i = 0; i < D; i++)
    p.velocity[i] = load(a.velocity, g, i);
  return p;
}

// With the form and the present fields known at compile time, all of it stays in registers; absent fields are zero.
template <int Order, bool Slope, bool Gradient, class T, class P, int D>
MPM_HD Contribution<P, D> momentum_contribution(const Geometry<T, D>& geometry, const ParticleMomentum<P, D>& p,
                                                const P f[D]) {
  constexpr StressForm form = Gradient ? StressForm::gradient : StressForm::mls;
  const NodeMomentum<P, D> n = to_nodes<Order>(p, form, Slope, Slope, P(geometry.dx), P(geometry.inverse_dx));
  Contribution<P, D> contribution;
  MPM_UNROLL for (int c = 0; c < kChannels; c++) {
    const bool momentum = c >= 1 && c <= D;
    const int i = momentum ? c - 1 : 0;
    contribution.value[c] = c == 0 ? n.mass : momentum ? n.momentum[i] : P(0);
    MPM_UNROLL for (int d = 0; d < D; d++) {
      contribution.slope[d][c] = momentum ? n.moment[i][d] : P(0);
      contribution.gradient[d][c] = momentum ? n.gradient[i][d] : P(0);
      if (Slope && momentum) contribution.value[c] = contribution.value[c] - n.moment[i][d] * f[d];
    }
  }
  return contribution;
}

// Channels first, ..., first + count - 1 of the features of ScatterArguments or PositionGradientArguments.
template <bool Slope, bool Gradient, class T, int D, class Arguments, int N>
MPM_HD Contribution<Pack<T, N>, D> feature_contribution(const Arguments& a, int first, int count, const GroupOf<N>& g,
                                                        const Pack<T, N> f[D]) {
  using P = Pack<T, N>;
  const Geometry<T, D>& geometry = a.topology.geometry;
  const P scale(a.moment_scale * double(geometry.dx)), inverse_dx(geometry.inverse_dx);
  Contribution<P, D> contribution;
  MPM_UNROLL for (int c = 0; c < kChannels; c++) {
    contribution.value[c] = c < count ? load(a.value, g, first + c) : P(0);
    MPM_UNROLL for (int d = 0; d < D; d++) {
      contribution.slope[d][c] =
          Slope && a.moment.pointer && c < count ? scale * load(a.moment, g, first + c, d) : P(0);
      contribution.gradient[d][c] = Gradient && c < count ? inverse_dx * load(a.gradient, g, first + c, d) : P(0);
      if (Slope) contribution.value[c] = contribution.value[c] - contribution.slope[d][c] * f[d];
    }
  }
  return contribution;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
