#include "transfer/scatter.cpu.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <int Order, bool Slope, bool Gradient, class T, int D>
void p2g_with(const P2GArguments<T, D>& a) {
  const bool direct = unit_stride(a.mass, a.velocity, a.affine, a.stress, a.volume);
  scatter_channels<Order, Slope, Gradient>(
      a.topology, a.x, a.nodes, 0, 1 + D,
      [&]<int N>(const GroupOf<N>& g, const Pack<T, N> f[D], int scene) __attribute__((always_inline)) {
        // One contribution for both, so that rounding does not depend on contiguity.
        const bool run = direct && g.consecutive;
        const auto p = run ? load_momentum(a, RunOf<N>{g.id[0]}, scene) : load_momentum(a, g, scene);
        return momentum_contribution<Order, Slope, Gradient>(a.topology.geometry, p, f);
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
  scatter_channels<Order, Slope, Gradient>(a.topology, a.x, a.nodes, first, count,
                                           [&]<int N>(const GroupOf<N>& g, const Pack<T, N> f[D], int) {
                                             return feature_contribution<Slope, Gradient, T, D>(a, first, count, g, f);
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

MPM_INSTANTIATE_ORDERS(p2g, P2GArguments)
MPM_INSTANTIATE_ORDERS(scatter, ScatterArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
