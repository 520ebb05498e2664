#include "transfer/advance.h"
#include "transfer/gather.cpu.h"

// G2P with the end of the step, so that v and C need not be read again.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// The fields of the particles, by rows.
template <class T, int D>
struct AdvancedRows {
  FieldRows<const T, D> x;
  FieldRows<const T, D * D> F;
  FieldRows<const T, 1> J;
  FieldRows<T, D> v, x_next;
  FieldRows<T, D * D> affine, F_next;
  FieldRows<T, 1> J_next;

  explicit AdvancedRows(const G2PAdvanceArguments<T, D>& a)
      : x(a.gather.x),
        F(a.F, D),
        J(a.J),
        v(a.gather.value),
        x_next(a.x_next),
        affine(a.gather.moment, D),
        F_next(a.F_next, D),
        J_next(a.J_next) {}
};

// What a step changes of a pack of particles.
template <class P, int D>
struct Advanced {
  Vector<P, D> x, v;
  Matrix<P, D> affine, F;
  P J;
};

// The particles of a Group or a Run as they are; zero for absent fields.
template <class T, int D, class G>
MPM_HD void read(Advanced<Lanes<T>, D>& p, const AdvancedRows<T, D>& rows, const G& g) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    p.x[i] = load_row(rows.x.row[i], rows.x.stride, g);
  MPM_UNROLL for (int k = 0; k < D * D; k++)
    p.F[k / D][k % D] = rows.F ? load_row(rows.F.row[k], rows.F.stride, g) : Lanes<T>(0);
  p.J = rows.J ? load_row(rows.J.row[0], rows.J.stride, g) : Lanes<T>(0);
}

template <class T, int D, class G>
MPM_HD void write(const Advanced<Lanes<T>, D>& p, const AdvancedRows<T, D>& rows, const G& g) {
  MPM_UNROLL for (int i = 0; i < D; i++) {
    store_row(p.v[i], rows.v.row[i], rows.v.stride, g);
    store_row(p.x[i], rows.x_next.row[i], rows.x_next.stride, g);
  }
  if (rows.affine) MPM_UNROLL
    for (int k = 0; k < D * D; k++) store_row(p.affine[k / D][k % D], rows.affine.row[k], rows.affine.stride, g);
  if (rows.F) MPM_UNROLL
    for (int k = 0; k < D * D; k++) store_row(p.F[k / D][k % D], rows.F_next.row[k], rows.F_next.stride, g);
  if (rows.J) store_row(p.J, rows.J_next.row[0], rows.J_next.stride, g);
}

template <int Order, bool Gradient, class T, int D>
void g2p_advance_with(const G2PAdvanceArguments<T, D>& a) {
  using P = Lanes<T>;
  const GatherArguments<T, D>& in = a.gather;
  const Geometry<T, D>& geometry = in.topology.geometry;
  const P scale(in.moment_scale * double(geometry.dx)), inverse_dx(geometry.inverse_dx);
  const AdvancedRows<T, D> rows(a);
  const bool direct = unit_stride(in.x, a.F, a.J, in.value, a.x_next, in.moment, a.F_next, a.J_next);
  gather_groups<Order>(in.topology, in.x, in.nodes, 0, D, [&](const Group& g, const P f[D], int scene, const T* tile) {
    const P dt(T(a.dt) * (a.scene_dt.pointer ? a.scene_dt.pointer[scene * a.scene_dt.stride[0]] : T(1)));
    Advanced<P, D> p;
    Matrix<P, D> L;
    Sums<P, D> s[D];
    gather_channels<Order, D, true, Gradient, T, D>(f, tile, s);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      p.v[i] = s[i].value;
      MPM_UNROLL for (int j = 0; j < D; j++) {
        p.affine[i][j] = scale * s[i].moment[j];
        L[i][j] = Gradient ? inverse_dx * s[i].gradient[j] : p.affine[i][j];
      }
    }
    // One arithmetic for both, so that rounding does not depend on what is consecutive.
    const bool run = direct && g.consecutive;
    run ? read(p, rows, Run{g.id[0]}) : read(p, rows, g);
    p.x = advance_position(p.x, p.v, dt);
    if (rows.F) p.F = advance_deformation(p.F, L, dt);
    if (rows.J) p.J = advance_volume_ratio(p.J, L, dt);
    run ? write(p, rows, Run{g.id[0]}) : write(p, rows, g);
  });
}

template <int Order, class T, int D>
void g2p_advance(const G2PAdvanceArguments<T, D>& a) {
  if (a.form == StressForm::gradient)
    g2p_advance_with<Order, true>(a);
  else
    g2p_advance_with<Order, false>(a);
  for_outside(a.gather.topology, [&](int64_t p) {
    const Vector<T, D> x = load_vector<D>(One<T>{p}, a.gather.x);
    const T rest = is_finite<D>(x.e) ? T(0) : T(a.gather.lost);
    for (int i = 0; i < D; i++) {
      at(a.gather.value, p, i) = rest;
      at(a.x_next, p, i) = x[i];
      for (int j = 0; j < D; j++) {
        if (a.gather.moment.pointer) at(a.gather.moment, p, i, j) = rest;
        if (a.F.pointer) at(a.F_next, p, i, j) = at(a.F, p, i, j);
      }
    }
    if (a.J.pointer) at(a.J_next, p) = at(a.J, p);
  });
}

MPM_INSTANTIATE_ORDERS(g2p_advance, G2PAdvanceArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
