#include "transfer/gather.cpu.h"
#include "transfer/advance.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <int Order, bool Moment, bool Gradient, class T, int D>
void gather_with(const GatherArguments<T, D>& a, int first, int count) {
  using P = Lanes<T>;
  const Geometry<T, D>& geometry = a.topology.geometry;
  const P scale(a.moment_scale * double(geometry.dx)), inverse_dx(geometry.inverse_dx);
  gather_groups<Order>(a.topology, a.x, a.nodes, first, count, [&](const Group& g, const P f[D], int, const T* tile) {
    for (int c = 0; c < count; c++) {
      Sums<P, D> s;
      gather_channels<Order, 1, Moment, Gradient, T, D>(f, tile + c, &s);
      if (a.value.pointer) store(s.value, a.value, g, first + c);
      MPM_UNROLL for (int d = 0; d < D; d++) {
        if (Moment) store(scale * s.moment[d], a.moment, g, first + c, d);
        if (Gradient) store(inverse_dx * s.gradient[d], a.gradient, g, first + c, d);
      }
    }
  });
}

template <int Order, class T, int D>
void gather(const GatherArguments<T, D>& a) {
  for (int first = 0; first < a.nodes.channels; first += kChannels) {
    const int rest = a.nodes.channels - first, count = rest < kChannels ? rest : kChannels;
    if (a.gradient.pointer && a.moment.pointer)
      gather_with<Order, true, true>(a, first, count);
    else if (a.gradient.pointer)
      gather_with<Order, false, true>(a, first, count);
    else if (a.moment.pointer)
      gather_with<Order, true, false>(a, first, count);
    else
      gather_with<Order, false, false>(a, first, count);
  }
  for_outside(a.topology, [&](int64_t p) {
    const T nothing = is_finite<D>(load_vector<D>(One<T>{p}, a.x).e) ? T(0) : T(a.lost);
    for (int c = 0; c < a.nodes.channels; c++) {
      if (a.value.pointer) at(a.value, p, c) = nothing;
      for (int d = 0; d < D; d++) {
        if (a.moment.pointer) at(a.moment, p, c, d) = nothing;
        if (a.gradient.pointer) at(a.gradient, p, c, d) = nothing;
      }
    }
  });
}

MPM_INSTANTIATE_ORDERS(gather, GatherArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
