#pragma once

#include "cuda/side_stream.h"
#include "rollout/heat_steps.h"
#include "rollout/schedules/block_per_scene.op.h"
#include "rollout/schedules/fused_g2p2g.op.h"
#include "rollout/schedules/persistent.op.h"
#include "rollout/schedules/replay_pairs.op.h"
#include "rollout/thermal_laws.op.h"

// A call of many substeps on CUDA without a record: its results, and a function for each schedule.
namespace mpm {

template <class T, int D>
class CudaCall {
 public:
  CudaCall(const SubstepsInputs& inputs, backend::Stream stream)
      : in_(inputs),
        stream_(stream),
        x_{empty_particles(in_.x, {P(), D}), Tensor()},
        F_{result(in_.x, has(in_.F), {P(), D, D}), Tensor()},
        J_{result(in_.x, has(in_.J), {P()}), Tensor()},
        v_(empty_particles(in_.x, {P(), D})),
        C_(result(in_.x, in_.wants_C, {P(), D, D})),
        residual_(result(in_.x, has(in_.residual), {P(), D})),
        status_{empty_int(in_.x, {1 + in_.scenes, kStatusSize}), empty_int(in_.x, {1 + in_.scenes, kStatusSize})},
        s_(in_) {
    history_ = packed_history(in_.x, in_.history, s_.columns);
    before_ = s_.previous_status;
    from_ = given_particles<T, D>(in_, history_);
    if (has(in_.impulse)) s_.add_impulses_to(impulse_ = copy_of(*in_.impulse));
    if (has(in_.scene_time)) s_.count_scene_times(time_ = copy_of(*in_.scene_time));
    s_.facts.captured = is_captured(stream_);
    s_.facts.graph_loops = !loops_are_refused;
    schedule_ = schedule_of(in_.schedule, s_.facts);
    if (HeatSteps<T, D>::wanted(in_)) heat_.emplace(s_), heat_->leave_no_record();
    if (ThermalLaws<T, D>::wanted(s_)) thermal_.emplace(s_, heat_ ? &*heat_ : nullptr);
  }

  // The schedule of the call; after run(), that of its last substeps.
  Schedule schedule() const { return schedule_; }

  void run() {
    if (schedule_ == kBlockPerScene) return run_block_per_scene();
    if (in_.n > 1) s_.let_activations_last(stream_);
    fuse_laws();
    s_.make_pool(stream_);
    s_.count_time(before_, stream_);
    if (schedule_ == kFusedG2P2G) return FusedG2P2G<T, D>(s_, buffers(0), status_, stream_).run(from_, before_);
    make_buffers();
    if (schedule_ == kPersistent && run_persistent_substeps()) return;
    run_per_step();
  }

  Results results() const {
    return {x_[last_],      v_,       C_,    F_[last_], J_[last_], history_,
            status_[last_], impulse_, time_, residual_, heat(),    heat_ ? heat_->status : Tensor(),
            Tensor()};
  }

 private:
  const SubstepsInputs& in_;
  const backend::Stream stream_;
  Tensor x_[2], F_[2], J_[2];  // buffers that substeps read and write in turn
  Tensor v_, C_, residual_;    // read by G2P only
  Tensor status_[2], history_, impulse_, time_;
  Substeps<T, D> s_;
  std::optional<HeatSteps<T, D>> heat_;
  std::optional<ThermalLaws<T, D>> thermal_;
  Schedule schedule_;
  Particles<const T> from_;      // inputs of the next substep
  const int* before_ = nullptr;  // status before it
  bool late_ = false;            // whether F and J are updated in place
  bool laws_move_ = false;       // whether laws of temperature do that, before they are evaluated
  bool goes_ahead_ = false;      // whether P2G runs beside the solve of heat of the substep before
  int64_t step_ = 0;             // computed substeps
  int last_ = 0;                 // index of the buffer with the results of the last one

  int64_t P() const { return in_.x.size(0); }

  Tensor heat() const { return heat_ ? heat_->state() : Tensor(); }

  int* status(int k) { return static_cast<int*>(status_[k].data_ptr()); }

  Particles<T> buffers(int k) {
    return {field<T>(x_[k]), field<T>(v_),        field<T>(C_),      field<T>(F_[k]),
            field<T>(J_[k]), field<T>(residual_), field<T>(history_)};
  }

  // Substeps in place, from copies of the given particles.
  void run_block_per_scene() {
    start_in_results();
    s_.forget_stress();
    s_.make_pool(stream_);
    const Particles<T> in_place = buffers(0);
    s_.read(constant(in_place), in_place.F);
    s_.write(in_place);
    // The last substep has its own activation, whose status counts the blocks at the end.
    double last_time = in_.time;
    for (int64_t k = 1; k < in_.n; k++) last_time += in_.dt;
    s_.activate(before_, status(1), stream_);
    run_scenes(s_, in_.n - 1, 0, in_.time, status(1), status(0), stream_);
    s_.activate(status(0), status(1), stream_);
    run_scenes(s_, 1, in_.n - 1, last_time, status(1), status(0), stream_);
    after_substeps(P(), in_.n, stream_);
  }

  void start_in_results() {
    torch::stable::copy_(x_[0], in_.x);
    torch::stable::copy_(v_, in_.v);
    if (has(in_.F)) torch::stable::copy_(F_[0], *in_.F);
    if (has(in_.J)) torch::stable::copy_(J_[0], *in_.J);
    if (has(in_.residual)) torch::stable::copy_(residual_, *in_.residual);
    if (in_.wants_C) has(in_.C) ? torch::stable::copy_(C_, *in_.C) : torch::stable::zero_(C_);
  }

  // Lets P2G evaluate the laws where it can. Laws of temperature need an activation that lasts and APIC there, because
  // P2G updates F and J by the affine field.
  void fuse_laws() {
    s_.thermal.given = thermal_ && thermal_->fit_p2g() && s_.displacements.defined() && in_.apic;
    s_.laws_are_apart = (thermal_ && !s_.thermal.given) || (heat_ && heat_->heats_by_laws());
    s_.fuse(false);
    if (!thermal_ || s_.fused) return;
    s_.thermal.given = false;
    thermal_->separate();
  }

  // The second buffers, for schedules with a substep at a time.
  void make_buffers() {
    const bool several = in_.n > 1;
    laws_move_ = thermal_ && !s_.fused && thermal_->may_move() && s_.displacements.defined() && in_.apic &&
                 s_.facts.quadratic && s_.facts.float32;
    late_ = laws_move_ || s_.thermal.given || s_.moves_late();
    x_[1] = result(in_.x, several, {P(), D});
    F_[1] = late_ ? F_[0] : result(in_.x, has(in_.F) && (several || s_.plastic), {P(), D, D});
    J_[1] = late_ ? J_[0] : result(in_.x, has(in_.J) && (several || s_.melts), {P()});
    if (s_.plastic && has(in_.F) && !late_) {  // laws change it in place
      torch::stable::copy_(F_[1], *in_.F);
      from_.F = field<const T>(F_[1]);
    }
    if (s_.melts && !late_) {
      torch::stable::copy_(J_[1], *in_.J);
      from_.J = field<const T>(J_[1]);
    }
  }

  // Sets the particles of a substep from one of the two buffers into the other.
  void set_particles(int into, bool has_left, bool last) {
    s_.read(from_, field<T>(F_[1 - into]));
    s_.write(buffers(into));
    if (laws_move_) return s_.defer(buffers(into), last);
    if (!late_) return;
    s_.move_late(buffers(into), has_left, last);
    if (s_.thermal.given) return thermal_->enter_p2g(field<T>(J_[into]), has_left, heat_->volumes());
    if (heat_ && has_left) s_.late.volume = heat_->volumes();
  }

  // One substep from one of the two buffers into the other.
  void substep(int into, bool last, backend::Stream on) {
    s_.swap_buffers(into, last);
    set_particles(into, step_ > 0, last);
    const Particles<T> to = buffers(into);
    if (heat_ && heat_->heats_by_laws()) s_.dissipate(heat_->dissipated());
    if (thermal_ && !s_.fused) thermal_->read(field<T>(F_[1 - into]), field<T>(J_[1 - into]));
    if (laws_move_) thermal_->move_late(to, step_ > 0, heat_->volumes());
    s_.activate(before_, status(into), on);
    if (heat_ && heat_->begins()) heat_->begin(from_.F, from_.J, s_.p2g.volume, on);
    thermal_ && !s_.fused ? thermal_->run(on) : s_.run_laws(on);
    if (heat_) heat_->join_g2p(from_.x, s_.p2g.mass, constant(to.C), on);
    if (s_.p2g_is_ahead) s_.p2g.work = {s_.counters, s_.activation.out_of_block_cost, false};
    s_.move(on);
    s_.p2g.work = {};
    // Not in the first substep, whose solve may request an activation at once, nor before the last one, which has an
    // activation of its own.
    s_.p2g_is_ahead = goes_ahead_ && step_ > 0 && step_ + 2 < in_.n;
    if (s_.p2g_is_ahead) {
      const SideStream::Fork side(on);
      conduct(to, on);
      from_ = constant(to);
      begin_next(1 - into, side.stream());
    } else if (heat_) {
      conduct(to, on);
    }
    s_.end_time(on);
    before_ = status(into);
    from_ = constant(to);
  }

  // Heat of the substep to the particles `to`.
  void conduct(const Particles<T>& to, backend::Stream on) {
    const Field<const int> scene{s_.activation.scene, {s_.activation.scene_stride}};
    heat_->store_volumes(constant(to.F), constant(to.J), s_.p2g.volume);
    heat_->run(from_.x, s_.p2g.mass, s_.p2g.volume, constant(to.C), scene, on);
  }

  // P2G of the next substep, where the activation lasts.
  void begin_next(int into, backend::Stream on) {
    set_particles(into, true, false);
    s_.p2g.work = {s_.counters_of(into), s_.activation.out_of_block_cost, true};
    s_.fused_kernels.p2g(s_.laws[0], {}, s_.late, s_.p2g, s_.reorder, on);
    s_.p2g.work = {};
  }

  // The first substep, those that last in activations, and the last one. False, after the first one, if the device
  // refuses graphs with loops.
  bool run_persistent_substeps() {
#if CUDART_VERSION >= 13000
    s_.activation.most_of_item = persistent_item<D>(P());
    substep(0, false, stream_);
    step_ = 1;
    const Particles<T> in_place = buffers(0);
    s_.read(from_, in_place.F);
    s_.write(in_place);
    s_.move_late(in_place, true, false);
    if (run_persistent(s_, status(1), status(0), stream_)) {
      substep(last_ = 1, true, stream_);
      after_substeps(P(), in_.n, stream_);
      return true;
    }
    if (in_.schedule == kChoose) schedule_ = kPerStep;
    s_.facts.graph_loops = !loops_are_refused;
    schedule_of(in_.schedule, s_.facts);  // an error if it was requested
#endif
    return false;
  }

  // Computes the substeps from `step_` on. CUDA graphs repeat pairs of them.
  void run_per_step() {
    // Laws of temperature read the result of the solve.
    goes_ahead_ = heat_ && s_.fused && !thermal_ && s_.displacements.defined() && s_.next.emptied &&
                  !s_.facts.captured && P() <= kMostParticlesAhead;
    const int64_t after = goes_ahead_ ? 2 : 1;  // substeps that have no P2G ahead of the next one
    while (step_ < in_.n) {
      last_ = int(step_ % 2);
      substep(last_, step_ + 1 == in_.n, stream_);
      after_substeps(P(), 1, stream_);
      if (++step_ == 2) {
        const auto two = [&](backend::Stream on) { substep(0, false, on), substep(1, false, on); };
        step_ += replay_pairs(in_.n - step_ - after, P(), stream_, two);
      }
    }
  }
};

}  // namespace mpm
