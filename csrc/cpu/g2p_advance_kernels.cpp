#include "cpu/gather.h"
#include "cpu/kernels.h"
#include "kinematics/advance.h"

// G2P with the end of the step, so that v and C need not be read again.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <int Order, bool Gradient, class T, int D>
void g2p_advance_with(const G2PAdvanceArguments<T, D>& a) {
  using P = Lanes<T>;
  const GatherArguments<T, D>& in = a.gather;
  const Geometry<T, D>& geometry = in.topology.geometry;
  const P scale(in.moment_scale * double(geometry.dx)), inverse_dx(geometry.inverse_dx);
  gather_groups<Order, Gradient ? 1 : 0>(
      in.topology, in.x, in.nodes, 0, D, [&](const Group& g, const Weights<Order, P, D>& w, int scene, const T* tile) {
    const P dt(T(a.dt) * (a.scene_dt.pointer ? a.scene_dt.pointer[scene * a.scene_dt.stride[0]] : T(1)));
    Vector<P, D> x, v;
    Matrix<P, D> L;
  MPM_UNROLL
        for (int i = 0; i < D; i++) {
          const Sums<P, D> s = gather_channel<Order, true, Gradient>(w, tile + i);
          x[i] = load(in.x, g, i);
          v[i] = s.value;
          MPM_UNROLL
          for (int j = 0; j < D; j++) {
            const P affine = scale * s.moment[j];
            L[i][j] = Gradient ? inverse_dx * s.gradient[j] : affine;
            if (in.moment.pointer) store(affine, in.moment, g, i, j);
          }
        }
        x = advance_position(x, v, dt);
        MPM_UNROLL
        for (int i = 0; i < D; i++) {
          store(v[i], in.value, g, i);
          store(x[i], a.x_next, g, i);
        }
        if (a.F.pointer) {
          Matrix<P, D> F;
          MPM_UNROLL
          for (int i = 0; i < D; i++)
            MPM_UNROLL
          for (int j = 0; j < D; j++) F[i][j] = load(a.F, g, i, j);
          F = advance_deformation(F, L, dt);
          MPM_UNROLL
          for (int i = 0; i < D; i++)
            MPM_UNROLL
          for (int j = 0; j < D; j++) store(F[i][j], a.F_next, g, i, j);
        }
        if (a.J.pointer) store(advance_volume_ratio(load(a.J, g), L, dt), a.J_next, g);
      });
}

template <int Order, class T, int D>
void g2p_advance(const G2PAdvanceArguments<T, D>& a) {
  if (a.form == StressForm::gradient)
    g2p_advance_with<Order, true>(a);
  else
    g2p_advance_with<Order, false>(a);
  for_outside(a.gather.topology, [&](int64_t p) {
    for (int i = 0; i < D; i++) {
      at(a.gather.value, p, i) = 0;
      at(a.x_next, p, i) = at(a.gather.x, p, i);
      for (int j = 0; j < D; j++) {
        if (a.gather.moment.pointer) at(a.gather.moment, p, i, j) = 0;
        if (a.F.pointer) at(a.F_next, p, i, j) = at(a.F, p, i, j);
      }
    }
    if (a.J.pointer) at(a.J_next, p) = at(a.J, p);
  });
}

MPM_CPU_INSTANTIATE(g2p_advance, G2PAdvanceArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
