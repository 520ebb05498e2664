#include "common/signals.h"
#include "rollout/recorded.h"
#include "rollout/replay.h"
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "rollout/schedules/sorted_cpu.op.h"
#else
#include "rollout/schedules/block_per_scene.op.h"
#include "rollout/schedules/fused_g2p2g.op.h"
#include "rollout/schedules/persistent.op.h"
#endif

// n steps of a simulation in one call.
namespace mpm {
namespace {

thread_local int64_t schedule_of_latest = kChoose;  // of this backend

Tensor copy_of(const Tensor& t) {
  Tensor copy = empty(t, sizes_of(t));
  torch::stable::copy_(copy, t);
  return copy;
}

using Results = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// Computes the steps with a record of the inputs of the adjoint. Empty if the pool has no room: then the steps are
// repeated without a record, and the status reports the activation.
template <class T, int D>
std::optional<Results> run_recorded(const SubstepsInputs& in, backend::Stream stream) {
  Recorded<T, D> r(in, {}, stream);
  schedule_of_latest = schedule_of(in.schedule, r.steps.facts);
  bool room = false;
  with_team(in.x.size(0) * in.n, [&] { room = r.run(); });
  if (!room) return {};
  const int64_t last = in.n - 1;
  const Tensor status = copy_of(r.status_tensor(last));
  const auto copy = [&](bool wanted, const auto& record, auto view) {
    if (!wanted) return Tensor();
    const Tensor from = (record.*view)(last);
    Tensor to = empty_particles(in.x, sizes_of(from));
    torch::stable::copy_(to, from);
    return to;
  };
  using R = Record<T>;
  return Results{copy(true, r.x, &R::vector),
                 copy(true, r.v, &R::vector),
                 copy(in.wants_C, r.C, &R::matrix),
                 copy(has(in.F), r.F, &R::matrix),
                 copy(has(in.J), r.J, &R::scalar),
                 copy(r.steps.columns > 0, r.history, &R::vector),
                 status,
                 Tensor(),
                 has(in.scene_time) ? r.scene_time_after() : Tensor(),
                 copy(has(in.residual), r.residual, &R::vector),
                 r.memory()};
}

#if MPM_BACKEND == MPM_BACKEND_IS_cpu

// Results with the given particles, if the pool has no room for the first activation.
template <class T, int D>
Results no_step(const SubstepsInputs& in, const Tensor& history, const Tensor& status, const Tensor& impulse,
                const Tensor& time) {
  const auto copy = [&](const OptionalTensor& t, bool wanted, const Shape& shape) {
    Tensor r = result(in.x, wanted, shape);
    if (wanted) has(t) ? torch::stable::copy_(r, *t) : torch::stable::zero_(r);
    return r;
  };
  const int64_t P = in.x.size(0);
  return {copy(in.x, true, {P, D}),
          copy(in.v, true, {P, D}),
          copy(in.C, in.wants_C, {P, D, D}),
          copy(in.F, has(in.F), {P, D, D}),
          copy(in.J, has(in.J), {P}),
          history,
          status,
          impulse,
          time,
          copy(in.residual, has(in.residual), {P, D}),
          Tensor()};
}

template <class T, int D>
Results run_steps(const SubstepsInputs& in, backend::Stream stream) {
  Substeps<T, D> s(in);
  s.facts.records = false;  // this call does not record
  const bool sorts = (schedule_of_latest = schedule_of(in.schedule, s.facts)) == kSortedCpu;
  const Tensor history = packed_history(in.x, in.history, s.columns);
  Tensor status[] = {empty_int(in.x, {1 + in.scenes, kStatusSize}), empty_int(in.x, {1 + in.scenes, kStatusSize})};
  Tensor impulse, time;
  if (has(in.impulse)) s.add_impulses_to(impulse = copy_of(*in.impulse));
  if (has(in.scene_time)) s.count_scene_times(time = copy_of(*in.scene_time));
  if (sorts && SortedCpu<T, D>::may_last(in)) s.make_margin();
  s.make_pool(stream);
  SortedCpu<T, D> particles(s, history, sorts, stream);
  const int* before = s.previous_status;
  int64_t step = 0, last = 0;  // index of the last status
  with_team(in.x.size(0) * in.n, [&] {
    while (step < in.n) {
      int* const now = static_cast<int*>(status[last = step % 2].data_ptr());
      if (!particles.step(before, now, in.n - 1 - step)) break;  // reported in the status
      before = now;
      step++;
      after_substeps(in.x.size(0), 1, stream);
    }
    particles.restore_order();
  });
  if (step == 0) return no_step<T, D>(in, history, status[0], impulse, time);
  return {particles.x.tensor(),
          particles.v.tensor(),
          particles.C.tensor(),
          particles.F.tensor(),
          particles.J.tensor(),
          particles.history.tensor(),
          status[last],
          impulse,
          time,
          particles.residual.tensor(),
          Tensor()};
}

#endif

Results run(const SubstepsInputs& in) {
  const Tensor& x = in.x;
  check_positions(x);
  const DeviceScope device(x);
  if (in.records && !has(in.impulse) && x.size(0) > 0) {
    std::optional<Results> recorded;
    dispatch(x, [&]<class T, int D>() { recorded = run_recorded<T, D>(in, device.stream()); });
    if (recorded) return *recorded;
  }
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
  Results results;
  dispatch(x, [&]<class T, int D>() { results = run_steps<T, D>(in, device.stream()); });
  return results;
#else
  const int64_t P = x.size(0), D_ = x.size(1), n = in.n;
  Tensor x_[] = {empty_particles(x, {P, D_}), Tensor()};
  Tensor F_[] = {result(x, has(in.F), {P, D_, D_}), Tensor()};
  Tensor J_[] = {result(x, has(in.J), {P}), Tensor()};
  Tensor v_ = empty_particles(x, {P, D_}), C_ = result(x, in.wants_C, {P, D_, D_}), history_;
  Tensor residual_ = result(x, has(in.residual), {P, D_});  // read by G2P only
  Tensor status[] = {empty_int(x, {1 + in.scenes, kStatusSize}), empty_int(x, {1 + in.scenes, kStatusSize})};
  Tensor impulse_, time_;
  int last = 0;  // index of the buffer with the results of the last step
  const auto start_in_results = [&] {
    torch::stable::copy_(x_[0], x);
    torch::stable::copy_(v_, in.v);
    if (has(in.F)) torch::stable::copy_(F_[0], *in.F);
    if (has(in.J)) torch::stable::copy_(J_[0], *in.J);
    if (has(in.residual)) torch::stable::copy_(residual_, *in.residual);
    if (in.wants_C) has(in.C) ? torch::stable::copy_(C_, *in.C) : torch::stable::zero_(C_);
  };
  dispatch(x, [&]<class T, int D>() {
    const backend::Stream stream = device.stream();
    Substeps<T, D> s(in);
    history_ = packed_history(x, in.history, s.columns);
    const int* before = s.previous_status;

    Particles<const T> from = given_particles<T, D>(in, history_);
    const auto buffers = [&](int k) -> Particles<T> {
      return {field<T>(x_[k]), field<T>(v_),        field<T>(C_),      field<T>(F_[k]),
              field<T>(J_[k]), field<T>(residual_), field<T>(history_)};
    };
    if (has(in.impulse)) {
      impulse_ = copy_of(*in.impulse);
      s.add_impulses_to(impulse_);
    }
    if (has(in.scene_time)) {
      time_ = copy_of(*in.scene_time);
      s.count_scene_times(time_);
    }
    s.facts.captured = is_captured(stream);
    s.facts.graph_loops = !loops_are_refused;
    const Schedule schedule = schedule_of(in.schedule, s.facts);
    schedule_of_latest = schedule;
    if (schedule == kBlockPerScene) {
      start_in_results();
      s.forget_stress();
      s.make_pool(stream);
      const Particles<T> in_place = buffers(0);
      s.read(constant(in_place), in_place.F);
      s.write(in_place);
      // The last substep has its own activation, whose status counts the blocks at the end.
      int* const activated = static_cast<int*>(status[1].data_ptr());
      int* const now = static_cast<int*>(status[0].data_ptr());
      double last_time = in.time;
      for (int64_t k = 1; k < n; k++) last_time += in.dt;
      s.activate(before, activated, stream);
      run_scenes(s, n - 1, 0, in.time, activated, now, stream);
      s.activate(now, activated, stream);
      run_scenes(s, 1, n - 1, last_time, activated, now, stream);
      after_substeps(P, n, stream);
      return;
    }
    if (n > 1) s.let_activations_last(stream);
    s.fuse(false);
    s.make_pool(stream);
    s.count_time(before, stream);
    if (schedule == kFusedG2P2G) return FusedG2P2G<T, D>(s, buffers(0), status, stream).run(from, before);
    const bool late = s.moves_late();  // then F and J are updated in place
    x_[1] = result(x, n > 1, {P, D});
    F_[1] = late ? F_[0] : result(x, has(in.F) && (n > 1 || s.plastic), {P, D, D});
    J_[1] = late ? J_[0] : result(x, has(in.J) && n > 1, {P});
    if (s.plastic && has(in.F) && !late) {  // laws change it in place
      torch::stable::copy_(F_[1], *in.F);
      from.F = field<const T>(F_[1]);
    }
    bool first = true;
    // One substep from one of the two buffers into the other.
    const auto substep = [&](int into, bool last, backend::Stream on) {
      int* const now = static_cast<int*>(status[into].data_ptr());
      s.swap_buffers(into, last);
      s.read(from, field<T>(F_[1 - into]));
      const Particles<T> to = buffers(into);
      s.write(to);
      if (late) s.move_late(to, !first, last);
      s.activate(before, now, on);
      s.move(on);
      before = now;
      first = false;
      // The next substep reads these results.
      from = constant(to);
    };
    int64_t step = 0;
#if CUDART_VERSION >= 13000
    if (schedule == kPersistent) {
      s.activation.most_of_item = persistent_item<D>(in.x.size(0));
      substep(0, false, stream);
      const Particles<T> in_place = buffers(0);
      s.read(from, in_place.F);
      s.write(in_place);
      s.move_late(in_place, true, false);
      step = 1;
      if (run_persistent(s, static_cast<int*>(status[1].data_ptr()), static_cast<int*>(status[0].data_ptr()), stream)) {
        substep(last = 1, true, stream);
        after_substeps(P, n, stream);
        return;
      }
      if (in.schedule == kChoose) schedule_of_latest = kPerStep;  // for the remaining substeps
      s.facts.graph_loops = !loops_are_refused;
      schedule_of(in.schedule, s.facts);  // an error if it was requested
    }
#endif
    while (step < n) {
      last = int(step % 2);
      substep(last, step + 1 == n, stream);
      after_substeps(P, 1, stream);
      if (++step == 2) {
        const auto two = [&](backend::Stream on) { substep(0, false, on), substep(1, false, on); };
        step += 2 * replay((n - step - 1) / 2, stream, two, [&] { after_substeps(P, 2, stream); });
      }
    }
  });
  return {x_[last], v_, C_, F_[last], J_[last], history_, status[last], impulse_, time_, residual_, Tensor()};
#endif
}

Results substeps(MPM_SUBSTEPS_PARAMETERS) { return run(SubstepsInputs{MPM_SUBSTEPS_ARGUMENTS}); }

// Schedule of the latest call of this thread on the device of a tensor.
int64_t latest_schedule(const Tensor&) { return schedule_of_latest; }

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("substeps(" MPM_SUBSTEPS_SCHEMA
        ") -> (Tensor x, Tensor v, Tensor C, Tensor F, Tensor J, Tensor history, Tensor status, Tensor "
        "impulse, Tensor time, Tensor residual, Tensor record)");
  m.def("latest_schedule(Tensor like) -> int");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("substeps", TORCH_BOX(&mpm::substeps));
  m.impl("latest_schedule", TORCH_BOX(&mpm::latest_schedule));
}

#if MPM_BACKEND == MPM_BACKEND_IS_cuda
// Whether no device has refused CUDA graphs with loops.
extern "C" __attribute__((visibility("default"))) int torch_mpm_graph_loops() { return !mpm::loops_are_refused; }
#endif
