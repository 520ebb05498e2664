#include "cpu/kernels.h"
#include "cpu/scatter.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// The inputs of a group of particles.
template <class T, int D>
MPM_HD ParticleMomentum<Lanes<T>, D> load_momentum(const P2GArguments<T, D>& a, const Group& g, int scene) {
  ParticleMomentum<Lanes<T>, D> p;
  p.mass = load(a.mass, g);
  p.affine = p.stress = zero_matrix<Lanes<T>, D>();
  p.volume = a.stress.pointer ? load(a.volume, g) : Lanes<T>(0);
  p.dt = Lanes<T>(T(a.dt) * (a.scene_dt.pointer ? a.scene_dt.pointer[scene * a.scene_dt.stride[0]] : T(1)));
  MPM_UNROLL
  for (int i = 0; i < D; i++) {
    p.velocity[i] = load(a.velocity, g, i);
    MPM_UNROLL
    for (int j = 0; j < D; j++) {
      if (a.affine.pointer) p.affine[i][j] = load(a.affine, g, i, j);
      if (a.stress.pointer) p.stress[i][j] = load(a.stress, g, i, j);
    }
  }
  return p;
}

template <int Order, bool Slope, bool Gradient, class T, int D>
void p2g_with(const P2GArguments<T, D>& a) {
  using P = Lanes<T>;
  const Geometry<T, D>& geometry = a.topology.geometry;
  scatter_channels<Order, Slope, Gradient>(
      a.topology, a.x, a.nodes, 0, 1 + D, [&](const Group& g, const P f[D], int scene, Gift<P, D>& gift) {
        const NodeMomentum<P, D> n = to_nodes<Order>(load_momentum(a, g, scene), a.form, a.affine.pointer,
                                                     a.stress.pointer, P(geometry.dx), P(geometry.inverse_dx));
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
      });
}

template <int Order, class T, int D>
void p2g(const P2GArguments<T, D>& a) {
  if (a.stress.pointer && a.form == StressForm::gradient)
    p2g_with<Order, true, true>(a);
  else if (a.affine.pointer || a.stress.pointer)
    p2g_with<Order, true, false>(a);
  else
    p2g_with<Order, false, false>(a);
}

template <int Order, bool Slope, bool Gradient, class T, int D>
void scatter_with(const ScatterArguments<T, D>& a, int first, int count) {
  using P = Lanes<T>;
  const Geometry<T, D>& geometry = a.topology.geometry;
  const P scale(a.moment_scale * double(geometry.dx)), inverse_dx(geometry.inverse_dx);
  scatter_channels<Order, Slope, Gradient>(
      a.topology, a.x, a.nodes, first, count, [&](const Group& g, const P f[D], int, Gift<P, D>& gift) {
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
      });
}

template <int Order, class T, int D>
void scatter(const ScatterArguments<T, D>& a) {
  for (int first = 0; first < a.nodes.channels; first += kChannels) {
    const int rest = a.nodes.channels - first, count = rest < kChannels ? rest : kChannels;
    if (a.gradient.pointer)
      scatter_with<Order, true, true>(a, first, count);
    else if (a.moment.pointer)
      scatter_with<Order, true, false>(a, first, count);
    else
      scatter_with<Order, false, false>(a, first, count);
  }
}

MPM_CPU_INSTANTIATE(p2g, P2GArguments)
MPM_CPU_INSTANTIATE(scatter, ScatterArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
