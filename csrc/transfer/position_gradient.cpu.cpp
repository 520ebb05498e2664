#include "transfer/gather.cpu.h"

// Position gradient of scatter and gather.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Adds the contribution of channels first, ..., first + count - 1 to the position gradient.
template <int Order, bool Slope, bool Gradient, class T, int D>
void position_gradient_with(const PositionGradientArguments<T, D>& a, int first, int count) {
  using P = Lanes<T>;
  const P inverse_dx(a.topology.geometry.inverse_dx);
  const Field<const T> before = constant(a.position_gradient);
  gather_groups<Order>(a.topology, a.x, a.nodes, first, count, [&](const Group& g, const P f[D], int, const T* tile) {
    P gathered[kChannels], x[D];
    if (Slope) {
      Sums<P, D> s[kChannels];
      gather_channels<Order, kChannels, false, false, T, D>(f, tile, s);
      MPM_UNROLL for (int c = 0; c < kChannels; c++)
        gathered[c] = s[c].value;
    }
    MPM_UNROLL for (int i = 0; i < D; i++)
      x[i] = P(0);
    const Weights<Order, P, D> w(f, Gradient ? 2 : 1);
    const Contribution<P, D> contribution = feature_contribution<Slope, Gradient, T, D>(a, first, count, g, f);
    add_position_gradient<Order, kChannels, Slope, Gradient>(w, contribution, tile, gathered, x);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      x[i] = inverse_dx * x[i];
      if (first == 0 && !a.adds)
        store(x[i], a.position_gradient, g, i);
      else
        store_exactly(load(before, g, i) + x[i], a.position_gradient, g, i);
    }
  });
}

template <int Order, class T, int D>
void position_gradient(const PositionGradientArguments<T, D>& a) {
  const auto zero = [&](int64_t p) {
    for (int i = 0; i < D; i++) at(a.position_gradient, p, i) = 0;
  };
  if (a.nodes.channels == 0 && !a.adds)
    for (int64_t p = 0; p < a.topology.particles; p++) zero(p);
  for (int first = 0; first < a.nodes.channels; first += kChannels) {
    const int rest = a.nodes.channels - first, count = rest < kChannels ? rest : kChannels;
    if (a.gradient.pointer)
      position_gradient_with<Order, true, true>(a, first, count);
    else if (a.moment.pointer)
      position_gradient_with<Order, true, false>(a, first, count);
    else
      position_gradient_with<Order, false, false>(a, first, count);
  }
  if (!a.adds) for_outside(a.topology, zero);
}

MPM_INSTANTIATE_ORDERS(position_gradient, PositionGradientArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
