#pragma once

#include "transfer/advance.h"
#include "transfer/gather.cuh"

namespace mpm::cuda {

template <class T, int D>
struct Motion {
  Vector<T, D> velocity;
  Matrix<T, D> affine;
};

// G2P with the end of the step, so that v and C need not be read again. Without Moves, P2G or laws update F and J.
template <int Order_, class T_, int D_, bool Gradient, bool Displaced, bool Moves = true>
struct AdvanceGather {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = D;
  static constexpr bool displaced = Displaced;
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
  Columns<const T, D> position, residual;
  Columns<const T, D * D> F;
  Columns<const T, 1> J;
  Columns<T, D> x_next, velocity, residual_next;
  Columns<T, D * D> affine, F_next;
  Columns<T, 1> J_next;
  Field<const T> scene_dt;
  T dt, moment_scale, gradient_scale;  // converts from cells
  T lost;
  Displacement* displacement;
  bool loads_ahead;

  explicit AdvanceGather(const G2PAdvanceArguments<T, D>& a)
      : topology(a.gather.topology),
        nodes(a.gather.nodes),
        position(a.gather.x),
        residual(a.residual),
        F(a.F, D),
        J(a.J),
        x_next(a.x_next),
        velocity(a.gather.value),
        residual_next(a.residual_next),
        affine(a.gather.moment, D),
        F_next(a.F_next, D),
        J_next(a.J_next),
        scene_dt(a.scene_dt),
        dt(T(a.dt)),
        moment_scale(T(a.gather.moment_scale * double(topology.geometry.dx))),
        gradient_scale(topology.geometry.inverse_dx),
        lost(T(a.gather.lost)),
        displacement(a.displacement),
        loads_ahead(a.loads_ahead) {}

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
  // For a particle at x with unchanged F and J.
  __device__ Loaded at(const mpm::Vector<T, D>& x, int scene) const {
    Loaded l;
    l.x = x;
    l.dt = scene_dt.pointer ? dt * scene_dt.pointer[scene * scene_dt.stride[0]] : dt;
    return l;
  }
  template <class Support>
  __device__ Result compute(const Loaded&, const Weights<Order, T, D>& w, const Support& support) const {
    return compute(w, support);
  }
  template <class Support>
  __device__ Result compute(const Weights<Order, T, D>& w, const Support& support) const {
    return sum_support<Shape>(support, w);
  }
  // The velocity and the affine field.
  __device__ Motion<T, D> motion(const Result& s) const {
    Motion<T, D> m;
#pragma unroll
    for (int i = 0; i < D; i++) {
      m.velocity[i] = s.value[i];
#pragma unroll
      for (int j = 0; j < D; j++) m.affine[i][j] = moment_scale * s.moment[i][j];
    }
    return m;
  }
  // Returns the new place of the particle.
  __device__ mpm::Vector<T, D> write(int p, const Loaded& l, const Result& s) const { return write(p, p, p, l, s); }
  // The motion is written to its own row, the other fields to row `to`.
  __device__ mpm::Vector<T, D> write(int p, int of_motion, int to, const Loaded& l, const Result& s) const {
    return write(p, of_motion, to, l, s, [](const Matrix<T, D>&, const T&) {});
  }
  // Calls also(F, J) with those after the step, where it moves them.
  template <class Also>
  __device__ mpm::Vector<T, D> write(int p, int of_motion, int to, const Loaded& l, const Result& s,
                                     const Also& also) const {
    const Motion<T, D> m = motion(s);
    Matrix<T, D> L;
#pragma unroll
    for (int i = 0; i < D; i++) {
      velocity.at(of_motion, i) = m.velocity[i];
#pragma unroll
      for (int j = 0; j < D; j++) {
        L[i][j] = Gradient ? gradient_scale * s.gradient[i][j] : m.affine[i][j];
        affine.write(of_motion, i * D + j, m.affine[i][j]);
      }
    }
    const mpm::Vector<T, D> x = advanced(p, to, l.x, m.velocity, l.dt);
#pragma unroll
    for (int i = 0; i < D; i++) x_next.at(to, i) = x[i];
    if constexpr (!Moves) return x;
    const Matrix<T, D> deformed = advance_deformation(l.F, L, l.dt);
#pragma unroll
    for (int i = 0; i < D; i++)
#pragma unroll
      for (int j = 0; j < D; j++) F_next.write(to, i * D + j, deformed[i][j]);
    const T ratio = advance_volume_ratio(l.J, L, l.dt);
    J_next.write(to, 0, ratio);
    also(deformed, ratio);
    return x;
  }
  // New position. Residuals are loaded here, where no other registers are in use, as most scenes have none.
  __device__ mpm::Vector<T, D> advanced(int p, int to, const mpm::Vector<T, D>& x, const mpm::Vector<T, D>& v,
                                        const T& time_step) const {
    if (!residual.present()) return advance_position(x, v, time_step);
    mpm::Vector<T, D> rest = read_vector(residual, p);
    const mpm::Vector<T, D> next = advance_position(x, v, time_step, rest);
#pragma unroll
    for (int i = 0; i < D; i++) residual_next.at(to, i) = rest[i];
    return next;
  }
  __device__ void skip(int p) const { skip(p, p, p); }
  __device__ void skip(int p, int of_motion, int to) const {
    const mpm::Vector<T, D> x = read_vector(position, p);
    const T rest = is_finite<D>(x.e) ? T(0) : lost;
#pragma unroll
    for (int i = 0; i < D; i++) {
      velocity.at(of_motion, i) = rest;
      x_next.at(to, i) = x[i];
      if (residual.present()) residual_next.at(to, i) = residual.at(p, i);
    }
#pragma unroll
    for (int k = 0; k < D * D; k++) {
      affine.write(of_motion, k, rest);
      if (Moves && F.present()) F_next.at(to, k) = F.at(p, k);
    }
    if (Moves && J.present()) J_next.at(to) = J.at(p);
  }
};

// For particles owned by the call: before a new activation, with F and J updated by P2G; or at the end, when all fields
// are written to their places in the given tensors.
template <class T, int D, bool Ends>
struct OwnAdvanceGather : AdvanceGather<2, T, D, false, true, Ends> {
  using Base = AdvanceGather<2, T, D, false, true, Ends>;
  RestoreOrder<T> own;

  explicit OwnAdvanceGather(const G2PAdvanceArguments<T, D>& a) : Base(a), own(a.own) {}

  bool is_mostly_idle() const { return own.is_mostly_idle(); }
  __device__ bool is_due() const { return own.is_due(Base::topology.particles); }
  __device__ mpm::Vector<T, D> write(int p, const typename Base::Loaded& l, const typename Base::Result& s) const {
    const int to = target(p);
    give_history(p, to);
    return Base::write(p, to, Ends ? to : p, l, s);
  }
  __device__ void skip(int p) const {
    const int to = target(p);
    give_history(p, to);
    Base::skip(p, to, Ends ? to : p);
  }

 private:
  __device__ int target(int p) const { return Ends ? own.origin[p] : own.place(p); }
  __device__ void give_history(int p, int to) const {
    if constexpr (Ends)
      for (int k = 0; k < own.columns; k++)
        own.history_next.pointer[to * own.history_next.stride[0] + k * own.history_next.stride[1]] =
            own.history.pointer[p * own.history.stride[0] + k * own.history.stride[1]];
  }
};

}  // namespace mpm::cuda
