#pragma once

#include "rollout/schedules/replay_pairs.op.h"
#include "rollout/step_kernels.h"

// A call of many substeps on CUDA that owns its particles: G2P and the next P2G are one kernel while an activation
// lasts. Between substeps, if particles have moved too far for that:
//   G2P          of the substep before,
//   activation,
//   P2G          into the order of items;
// otherwise:
//   G2P2G.
// All four are launched, and each checks on the device whether it has work.
namespace mpm {

template <class T, int D>
class FusedG2P2G {
 public:
  // `s` has the kernels of a step; `results` receive the particles in their given order, status[0] the last status.
  FusedG2P2G(Substeps<T, D>& s, const Particles<T>& results, Tensor status[2], backend::Stream stream);

  void run(const Particles<const T>& given, const int* before);

 private:
  Substeps<T, D>& s_;
  const Particles<T> results_;
  int* const status_[2];
  const backend::Stream stream_;
  const int rows_;  // of a copy
  Tensor x_, F_, J_, residual_, history_, mass_, volume_, origin_, copy_, items_taken_, nowhere_;
  Particles<T> own_;

  int* status(int64_t step) { return status_[(s_.in.n - 1 - step) % 2]; }  // that of the last step is status_[0]
  Displacement* displacement(int64_t step) {
    return static_cast<Displacement*>(s_.displacements.data_ptr()) + step % 2;
  }
  Displacement* nowhere() { return static_cast<Displacement*>(nowhere_.data_ptr()); }

  void begin(const Particles<const T>& given, const int* before);
  void use_own();
  void run_substep(int64_t step, bool ends, backend::Stream stream);
  void update_grid(int64_t step, backend::Stream stream);
  void end();
};

template <class T, int D>
FusedG2P2G<T, D>::FusedG2P2G(Substeps<T, D>& s, const Particles<T>& results, Tensor status[2], backend::Stream stream)
    : s_(s),
      results_(results),
      status_{static_cast<int*>(status[0].data_ptr()), static_cast<int*>(status[1].data_ptr())},
      stream_(stream),
      rows_(int(s.in.x.size(0))) {
  const SubstepsInputs& in = s.in;
  const int64_t both = 2 * int64_t(rows_);
  x_ = empty_particles(in.x, {both, D});
  F_ = result(in.x, has(in.F), {both, D, D});
  J_ = result(in.x, has(in.J), {both});
  residual_ = result(in.x, has(in.residual), {both, D});
  history_ = result(in.x, s.columns > 0, {both, s.columns});
  mass_ = empty_particles(in.x, {both});
  volume_ = empty_particles(in.x, {both});
  origin_ = empty_int(in.x, {both});
  copy_ = empty_int(in.x, {1});
  items_taken_ = empty_int(in.x, {1});
  nowhere_ = empty_int(in.x, {int64_t(sizeof(Displacement) / sizeof(int))});
  torch::stable::zero_(copy_);
  torch::stable::zero_(nowhere_);
  own_ = {field<T>(x_), results.v, results.C, field<T>(F_), field<T>(J_), field<T>(residual_), field<T>(history_)};
}

template <class T, int D>
void FusedG2P2G<T, D>::run(const Particles<const T>& given, const int* before) {
  begin(given, before);
  use_own();
  const int64_t last = s_.in.n - 1;
  int64_t step = 1;
  run_substep(step++, false, stream_);
  const auto two = [&](backend::Stream on) { run_substep(step, false, on), run_substep(step + 1, false, on); };
  step += replay_pairs(last - step, rows_, stream_, two);
  for (; step <= last; step++) {
    run_substep(step, step == last, stream_);
    after_substeps(rows_, 1, stream_);
  }
  end();
}

// The first substep without its G2P, from given tensors.
template <class T, int D>
void FusedG2P2G<T, D>::begin(const Particles<const T>& given, const int* before) {
  s_.read(given, own_.F);
  s_.write(own_);
  s_.move_late(own_, false, false);
  ReorderOnScatter<T, D>& reorder = s_.reorder;
  reorder.rows = rows_;
  reorder.given = true;
  reorder.x = own_.x;
  reorder.mass = field<T>(mass_);
  reorder.volume = field<T>(volume_);
  reorder.residual = own_.residual;
  reorder.residual_before = given.residual;
  reorder.origin = static_cast<int*>(origin_.data_ptr());
  reorder.copy = static_cast<int*>(copy_.data_ptr());
  reorder.index = s_.activation.index;
  s_.activation.displacement = nullptr;
  s_.activation.next_displacement = displacement(0);
  s_.activate(before, status(0), stream_);
  s_.fused_kernels.p2g(s_.laws[0], {}, s_.late, s_.p2g, reorder, stream_);
  update_grid(0, stream_);
}

// Sets the fields that the kernels read and write from the second substep on.
template <class T, int D>
void FusedG2P2G<T, D>::use_own() {
  const Particles<const T> own = constant(own_);
  s_.read(own, own_.F);
  s_.move_late(own_, true, false);
  s_.p2g.mass = field<const T>(mass_);
  s_.p2g.volume = field<const T>(volume_);
  s_.reorder.given = false;
  s_.reorder.residual_before = own.residual;
  ActivateArguments<T, D>& activation = s_.activation;
  activation.origin = s_.reorder.origin;
  activation.copy = s_.reorder.copy;
  activation.copy_rows = rows_;
  RestoreOrder<T>& restore = s_.advance.own;
  restore.rows = rows_;
  restore.origin = s_.reorder.origin;
  restore.columns = int(s_.columns);
  restore.history = own.history;
  restore.history_next = results_.history;
}

// From the grid of the previous step to that of this one. The last step has a new activation, whose status counts the
// blocks at the end.
template <class T, int D>
void FusedG2P2G<T, D>::run_substep(int64_t step, bool ends, backend::Stream stream) {
  const Displacement* const before = displacement(step - 1);
  s_.advance.own.displacement = s_.reorder.displacement = s_.activation.displacement = ends ? nullptr : before;
  s_.activation.missed = before;
  s_.activation.next_displacement = displacement(step);
  s_.advance.displacement = nowhere();
  backend::g2p_advance(s_.in.lattice.order(), s_.advance, stream);
  s_.activate(status(step - 1), status(step), stream);
  s_.fused_kernels.p2g(s_.laws[0], {}, s_.late, s_.p2g, s_.reorder, stream);
  if (!ends) {
    G2P2GArguments<T, D> a{s_.p2g, s_.late, s_.advance, s_.reorder, s_.reorder.copy, s_.next.items_taken};
    a.advance.displacement = displacement(step);
    s_.fused_kernels.g2p2g(s_.laws[0], a, stream);
  }
  update_grid(step, stream);
}

template <class T, int D>
void FusedG2P2G<T, D>::update_grid(int64_t step, backend::Stream stream) {
  s_.next.displacement = s_.next.watched = displacement(step);
  s_.next.next_displacement = displacement(step + 1);
  s_.next.items_taken = static_cast<int*>(items_taken_.data_ptr());
  s_.move_nodes(stream);
  s_.end_time(stream);
}

// G2P of the last substep, into the results.
template <class T, int D>
void FusedG2P2G<T, D>::end() {
  G2PAdvanceArguments<T, D> a = s_.advance;
  a.late = false;
  a.own.displacement = nullptr;
  a.displacement = nowhere();
  a.x_next = results_.x;
  a.residual_next = results_.residual;
  a.F = constant(own_.F);
  a.J = constant(own_.J);
  a.F_next = results_.F;
  a.J_next = results_.J;
  backend::g2p_advance(s_.in.lattice.order(), a, stream_);
}

}  // namespace mpm
