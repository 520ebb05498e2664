#include "transfer/gather.cpu.h"

// Adjoint of P2G.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Adjoints of x, mass and volume.
constexpr bool is_sum(int field) { return field == 0 || field == 1 || field == 5; }

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
          const Contribution<P, D> contribution =
              momentum_contribution<Order, Moment, Gradient>(in.topology.geometry, p, f);
          add_position_gradient<Order, 1 + D, Moment, Gradient>(w, contribution, tile, gathered, x);
          MPM_UNROLL for (int i = 0; i < D; i++)
            x[i] = inverse_dx * x[i];
        }
        for_wanted(adjoint<Order>(p, sum, in.form, in.affine.pointer, in.stress.pointer, dx, inverse_dx), x,
                   [&](int field, const P& v, int i, int j) {
                     const Field<T>& to = wanted[field];
                     if (!to.pointer) return;
                     if (a.adds && is_sum(field))
                       store_exactly(load(constant(to), g, i, j) + v, to, g, i, j);
                     else
                       store(v, to, g, i, j);
                   });
      });
}

template <int Order, class T, int D>
void position_gradient(const PositionGradientArguments<T, D>&);

template <int Order, class T, int D>
void p2g_backward(const P2GBackwardArguments<T, D>& a) {
  const P2GArguments<T, D>& in = a.forward;
  if (a.motion.nodes.pointer) position_gradient<Order>(a.motion);
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
      if (wanted[field].pointer && !(a.adds && is_sum(field))) at(wanted[field], p, i, j) = v;
    });
  });
}

MPM_INSTANTIATE_ORDERS(p2g_backward, P2GBackwardArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
