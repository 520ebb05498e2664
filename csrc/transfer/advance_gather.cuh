#pragma once

#include "transfer/advance.h"
#include "transfer/gather.cuh"

namespace mpm::cuda {

// G2P with the end of the step, so that v and C need not be read again. Where it is not to Move F and J, P2G does.
template <int Order_, class T_, int D_, bool Gradient, bool Drifts, bool Moves = true>
struct AdvanceGather {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = D;
  static constexpr bool drifts = Drifts;
  static constexpr int resident = Gradient ? 4 : Moves ? 5 : 6;
  using Shape = SumShape<Order, T, D, K, 0, true, Gradient, SlopeForm::none>;
  struct Loaded {
    mpm::Vector<T, D> x;
    Matrix<T, D> F;
    T J, dt;
  };
  using Result = Sums<Shape>;
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  Columns<const T, D * D> F;
  Columns<const T, 1> J;
  Columns<T, D> x_next, velocity;
  Columns<T, D * D> affine, F_next;
  Columns<T, 1> J_next;
  Field<const T> scene_dt;
  T dt, moment_scale, gradient_scale;  // from cells
  T lost;
  Drift* drift;

  explicit AdvanceGather(const G2PAdvanceArguments<T, D>& a)
      : topology(a.gather.topology),
        nodes(a.gather.nodes),
        position(a.gather.x),
        F(a.F, D),
        J(a.J),
        x_next(a.x_next),
        velocity(a.gather.value),
        affine(a.gather.moment, D),
        F_next(a.F_next, D),
        J_next(a.J_next),
        scene_dt(a.scene_dt),
        dt(T(a.dt)),
        moment_scale(T(a.gather.moment_scale * double(topology.geometry.dx))),
        gradient_scale(topology.geometry.inverse_dx),
        lost(T(a.gather.lost)),
        drift(a.drift) {}

  __device__ Loaded load(int p, int scene) const {
    Loaded l = at(read_vector(position, p), scene);
    if constexpr (!Moves) return l;
    l.J = J.present() ? J.at(p) : T(0);
#pragma unroll
    for (int i = 0; i < D; i++)
#pragma unroll
      for (int j = 0; j < D; j++) l.F[i][j] = F.present() ? F.at(p, i * D + j) : T(0);
    return l;
  }
  // Of a particle at x whose F and J are left alone.
  __device__ Loaded at(const mpm::Vector<T, D>& x, int scene) const {
    Loaded l;
    l.x = x;
    l.dt = scene_dt.pointer ? dt * scene_dt.pointer[scene * scene_dt.stride[0]] : dt;
    return l;
  }
  template <class Support>
  __device__ Result compute(const Loaded&, const Weights<Order, T, D>& w, const Support& support) const {
    const T constant[K] = {}, linear[K][D] = {};
    Result s;
    sum_axis<Shape, 0>(support, support.rows, 0, w, constant, linear, s);
    return s;
  }
  // Returns where the particle goes.
  __device__ mpm::Vector<T, D> write(int p, const Loaded& l, const Result& s) const {
    mpm::Vector<T, D> v;
    Matrix<T, D> L;
#pragma unroll
    for (int i = 0; i < D; i++) {
      v[i] = s.value[i];
      velocity.at(p, i) = v[i];
#pragma unroll
      for (int j = 0; j < D; j++) {
        const T C = moment_scale * s.moment[i][j];
        L[i][j] = Gradient ? gradient_scale * s.gradient[i][j] : C;
        affine.write(p, i * D + j, C);
      }
    }
    const mpm::Vector<T, D> x = advance_position(l.x, v, l.dt);
#pragma unroll
    for (int i = 0; i < D; i++) x_next.at(p, i) = x[i];
    if constexpr (!Moves) return x;
    const Matrix<T, D> deformed = advance_deformation(l.F, L, l.dt);
#pragma unroll
    for (int i = 0; i < D; i++)
#pragma unroll
      for (int j = 0; j < D; j++) F_next.write(p, i * D + j, deformed[i][j]);
    J_next.write(p, 0, advance_volume_ratio(l.J, L, l.dt));
    return x;
  }
  __device__ void leave_out(int p) const {
    const mpm::Vector<T, D> x = read_vector(position, p);
    const T rest = is_finite<D>(x.e) ? T(0) : lost;
#pragma unroll
    for (int i = 0; i < D; i++) {
      velocity.at(p, i) = rest;
      x_next.at(p, i) = x[i];
    }
#pragma unroll
    for (int k = 0; k < D * D; k++) {
      affine.write(p, k, rest);
      if (Moves && F.present()) F_next.at(p, k) = F.at(p, k);
    }
    if (Moves && J.present()) J_next.at(p) = J.at(p);
  }
};

}  // namespace mpm::cuda
