#include "transfer/gather.cpu.h"

// The adjoint of P2G, and the position gradient of scatter and gather.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class P, int D, class Store>
MPM_HD void for_wanted(const ParticleMomentum<P, D>& grad, const P x[D], const Store& store) {
  store(0, grad.mass, 0, 0);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    store(1, x[i], i, 0);
    store(2, grad.velocity[i], i, 0);
    MPM_UNROLL for (int j = 0; j < D; j++) {
      store(3, grad.affine[i][j], i, j);
      store(4, grad.stress[i][j], i, j);
    }
  }
  store(5, grad.volume, 0, 0);
  store(6, grad.dt, 0, 0);
}

template <int Order, bool Moment, bool Gradient, class T, int D>
void p2g_backward_with(const P2GBackwardArguments<T, D>& a, const Field<T> wanted[7]) {
  using P = Lanes<T>;
  const P2GArguments<T, D>& in = a.forward;
  const P dx(in.topology.geometry.dx), inverse_dx(in.topology.geometry.inverse_dx);
  gather_groups<Order>(
      in.topology, in.x, a.grad_nodes, 0, 1 + D, [&](const Group& g, const P f[D], int scene, const T* tile) {
        const ParticleMomentum<P, D> p = load_momentum(in, g, scene);
        NodeMomentum<P, D> sum;
        P gathered[kChannels], x[D];
        Sums<P, D> s[1 + D];
        gather_channels<Order, 1 + D, Moment, Gradient, T, D>(f, tile, s);
        sum.mass = gathered[0] = s[0].value;
        MPM_UNROLL for (int i = 0; i < D; i++) {
          sum.momentum[i] = gathered[1 + i] = s[1 + i].value;
          MPM_UNROLL for (int j = 0; j < D; j++) {
            sum.moment[i][j] = Moment ? s[1 + i].moment[j] : P(0);
            sum.gradient[i][j] = Gradient ? s[1 + i].gradient[j] : P(0);
          }
        }
        MPM_UNROLL for (int i = 0; i < D; i++)
          x[i] = P(0);
        if (a.x.pointer) {
          const Weights<Order, P, D> w(f, Gradient ? 2 : 1);
          const Gift<P, D> gift = gift_of_momentum<Order, Moment>(in, p, f);
          add_position_gradient<Order, 1 + D, Moment, Gradient>(w, gift, tile, gathered, x);
          MPM_UNROLL for (int i = 0; i < D; i++)
            x[i] = inverse_dx * x[i];
        }
        for_wanted(adjoint<Order>(p, sum, in.form, in.affine.pointer, in.stress.pointer, dx, inverse_dx), x,
                   [&](int field, const P& v, int i, int j) {
                     if (wanted[field].pointer) store(v, wanted[field], g, i, j);
                   });
      });
}

template <int Order, class T, int D>
void p2g_backward(const P2GBackwardArguments<T, D>& a) {
  const P2GArguments<T, D>& in = a.forward;
  const Field<T> wanted[] = {a.mass, a.x, a.velocity, a.affine, a.stress, a.volume, a.dt};  // as in for_wanted
  if (in.stress.pointer && in.form == StressForm::gradient)
    p2g_backward_with<Order, true, true>(a, wanted);
  else if (in.affine.pointer || in.stress.pointer)
    p2g_backward_with<Order, true, false>(a, wanted);
  else
    p2g_backward_with<Order, false, false>(a, wanted);
  const ParticleMomentum<T, D> zero = {};
  const T zero_x[D] = {};
  for_outside(in.topology, [&](int64_t p) {
    for_wanted(zero, zero_x, [&](int field, const T& v, int i, int j) {
      if (wanted[field].pointer) at(wanted[field], p, i, j) = v;
    });
  });
}

// Adds to the position gradient what channels first, ..., first + count - 1 contribute.
template <int Order, bool Slope, bool Gradient, class T, int D>
void position_gradient_with(const PositionGradientArguments<T, D>& a, int first, int count) {
  using P = Lanes<T>;
  const P inverse_dx(a.topology.geometry.inverse_dx);
  const Field<const T> before = {a.position_gradient.pointer,
                                 {a.position_gradient.stride[0], a.position_gradient.stride[1], 0}};
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
    const Gift<P, D> gift = gift_of_features<Slope, Gradient, T, D>(a, first, count, g, f);
    add_position_gradient<Order, kChannels, Slope, Gradient>(w, gift, tile, gathered, x);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      x[i] = inverse_dx * x[i];
      if (first == 0)
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
  if (a.nodes.channels == 0)
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
  for_outside(a.topology, zero);
}

MPM_INSTANTIATE_ORDERS(p2g_backward, P2GBackwardArguments)
MPM_INSTANTIATE_ORDERS(position_gradient, PositionGradientArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
