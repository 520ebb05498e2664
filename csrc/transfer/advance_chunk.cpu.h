#pragma once

#include "transfer/advance.h"
#include "transfer/gather.cpu.h"

// End of a step for a chunk of particles, after the sums of G2P.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Fields of the particles, by rows.
template <class T, int D>
struct AdvancedRows {
  FieldRows<const T, D> x, residual;
  FieldRows<const T, D * D> F;
  FieldRows<const T, 1> J;
  FieldRows<T, D> v, x_next, residual_next;
  FieldRows<T, D * D> affine, F_next;
  FieldRows<T, 1> J_next;

  explicit AdvancedRows(const G2PAdvanceArguments<T, D>& a)
      : x(a.gather.x),
        residual(a.residual),
        F(a.F, D),
        J(a.J),
        v(a.gather.value),
        x_next(a.x_next),
        residual_next(a.residual_next),
        affine(a.gather.moment, D),
        F_next(a.F_next, D),
        J_next(a.J_next) {}

  // Prefetches the cache lines of a particle, where all strides are 1. GCC removes calls of functions that do only
  // this.
  MPM_HD void prefetch(int p) const {
    if (x.row[0] != x_next.row[0]) {
      prefetch<false>(x, p);
      prefetch<false>(F, p);
    }
    prefetch<true>(x_next, p);
    prefetch<true>(F_next, p);
    prefetch<true>(v, p);
    prefetch<true>(affine, p);
  }

 private:
  template <bool Writes, class E, int N>
  MPM_HD static void prefetch(const FieldRows<E, N>& f, int p) {
    if (!f) return;
    MPM_UNROLL for (int k = 0; k < N; k++)
      __builtin_prefetch(f.row[k] + p, Writes, 2);
  }
};

// Fields that a step changes, for a pack of particles.
template <class P, int D>
struct Advanced {
  Vector<P, D> x, v, residual;
  Matrix<P, D> affine, F;
  P J;
};

// Unchanged values of the particles of a group or a run; zero for absent fields.
template <class P, int D, class T, class G>
MPM_HD void read(Advanced<P, D>& p, const AdvancedRows<T, D>& rows, const G& g) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    p.x[i] = load_row(rows.x.row[i], rows.x.stride, g);
  MPM_UNROLL for (int i = 0; i < D; i++)
    p.residual[i] = rows.residual ? load_row(rows.residual.row[i], rows.residual.stride, g) : P(0);
  MPM_UNROLL for (int k = 0; k < D * D; k++)
    p.F[k / D][k % D] = rows.F ? load_row(rows.F.row[k], rows.F.stride, g) : P(0);
  p.J = rows.J ? load_row(rows.J.row[0], rows.J.stride, g) : P(0);
}

// The motion that `write_motion` has stored.
template <class P, int D, class T, class G>
MPM_HD void read_motion(Advanced<P, D>& p, const AdvancedRows<T, D>& rows, const G& g) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    p.v[i] = load_row(rows.v.row[i], rows.v.stride, g);
  MPM_UNROLL for (int k = 0; k < D * D; k++)
    p.affine[k / D][k % D] = load_row(rows.affine.row[k], rows.affine.stride, g);
}

template <class P, int D, class T, class G>
MPM_HD void write_motion(const Advanced<P, D>& p, const AdvancedRows<T, D>& rows, const G& g) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    store_row(p.v[i], rows.v.row[i], rows.v.stride, g);
  if (rows.affine) MPM_UNROLL
    for (int k = 0; k < D * D; k++) store_row(p.affine[k / D][k % D], rows.affine.row[k], rows.affine.stride, g);
}

template <class P, int D, class T, class G>
MPM_HD void write_moved(const Advanced<P, D>& p, const AdvancedRows<T, D>& rows, const G& g) {
  MPM_UNROLL for (int i = 0; i < D; i++)
    store_row(p.x[i], rows.x_next.row[i], rows.x_next.stride, g);
  if (rows.residual) MPM_UNROLL
    for (int i = 0; i < D; i++) store_row(p.residual[i], rows.residual_next.row[i], rows.residual_next.stride, g);
  if (rows.F) MPM_UNROLL
    for (int k = 0; k < D * D; k++) store_row(p.F[k / D][k % D], rows.F_next.row[k], rows.F_next.stride, g);
  if (rows.J) store_row(p.J, rows.J_next.row[0], rows.J_next.stride, g);
}

template <class P, int D, class T, class G>
MPM_HD void write(const Advanced<P, D>& p, const AdvancedRows<T, D>& rows, const G& g) {
  write_motion(p, rows, g);
  write_moved(p, rows, g);
}

// Update by the velocity of the particles and its gradient L.
template <class P, int D, class T>
MPM_HD void end_step(Advanced<P, D>& p, const Matrix<P, D>& L, const P& dt, const AdvancedRows<T, D>& rows) {
  p.x = rows.residual ? advance_position(p.x, p.v, dt, p.residual) : advance_position(p.x, p.v, dt);
  if (rows.F) p.F = advance_deformation(p.F, L, dt);
  if (rows.J) p.J = advance_volume_ratio(p.J, L, dt);
}

// Motion of the particles of a chunk in the order of cells: packs of a cell are seldom full, those of a chunk are.
template <bool Gradient, class T, int D>
struct Motion {
  static constexpr int kLine = kChunk + 16;  // not a power of two, with space for a whole register at the end
  alignas(64) T velocity[D][kLine], affine[D][D][kLine], gradient[Gradient ? D : 1][D][kLine];

  Motion() {}  // no initialisation

  MPM_HD void put(int i, const Sums<Lanes<T>, D> s[D]) {
    put_by([&](const Lanes<T>& v, T* row) { v.store(row + i); }, s);
  }

  // By store(values, row), for a group or a single particle.
  template <class F, class V>
  MPM_HD void put_by(const F& store, const Sums<V, D> s[D]) {
    MPM_UNROLL for (int c = 0; c < D; c++) {
      store(s[c].value, velocity[c]);
      MPM_UNROLL for (int a = 0; a < D; a++) {
        store(s[c].moment[a], affine[c][a]);
        if (Gradient) store(s[c].gradient[a], gradient[c][a]);
      }
    }
  }

  // Velocity, affine field and gradient of the velocity of the i-th particle and the following ones.
  template <class P>
  MPM_HD void get(int i, const P& scale, const P& inverse_dx, Advanced<P, D>& p, Matrix<P, D>& L) const {
    MPM_UNROLL for (int c = 0; c < D; c++) {
      p.v[c] = P::load(velocity[c] + i);
      MPM_UNROLL for (int k = 0; k < D; k++) {
        p.affine[c][k] = scale * P::load(affine[c][k] + i);
        L[c][k] = Gradient ? inverse_dx * P::load(gradient[Gradient ? c : 0][k] + i) : p.affine[c][k];
      }
    }
  }
};

// End of the step for particles that are not transferred.
template <class T, int D>
void skip_outside(const G2PAdvanceArguments<T, D>& a) {
  for_outside(a.gather.topology, [&](int64_t p) {
    const Vector<T, D> x = load_vector<D>(One<T>{p}, a.gather.x);
    const T rest = is_finite<D>(x.e) ? T(0) : T(a.gather.lost);
    for (int i = 0; i < D; i++) {
      at(a.gather.value, p, i) = rest;
      at(a.x_next, p, i) = x[i];
      if (a.residual.pointer) at(a.residual_next, p, i) = at(a.residual, p, i);
      for (int j = 0; j < D; j++) {
        if (a.gather.moment.pointer) at(a.gather.moment, p, i, j) = rest;
        if (a.F.pointer) at(a.F_next, p, i, j) = at(a.F, p, i, j);
      }
    }
    if (a.J.pointer) at(a.J_next, p) = at(a.J, p);
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
