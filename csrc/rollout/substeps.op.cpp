#include <atomic>

#include "common/signals.h"
#include "rollout/recorded.h"
#include "rollout/replay.h"
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "rollout/own_particles.h"
#else
#include "rollout/merged.h"
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

#if MPM_BACKEND == MPM_BACKEND_IS_cuda
// To a kernel of many substeps: those of scenes that have their own.
template <class T, int D, class Arguments>
void give_clocks(const Substeps<T, D>& s, Arguments& a) {
  if (!s.scene_time.defined()) return;
  a.scene_time = static_cast<double*>(s.scene_time.data_ptr());
  a.scene_dt = static_cast<const T*>(s.in.scene_dt->data_ptr());
}

// n substeps, after the activation of the first one, of particles that move in place. That one follows so many substeps
// of the call, and begins at a time.
template <class T, int D>
void take_resident(Substeps<T, D>& s, int64_t n, int64_t after, double time, const int* activated, int* status,
                   backend::Stream stream) {
  const SubstepsInputs& in = s.in;
  const int64_t P = in.x.size(0), rows = (P + 64 * in.scenes) * kMostResidentRow;
  const Tensor row_memory = empty(in.x, {rows}, ScalarType::Byte);
  // A scene that grows takes new ones each time; all of them together, twice what they should want.
  const int64_t spare = std::min<int64_t>(2 * int64_t(s.activation.max_blocks), s.update.block_count);
  const Tensor block_memory = empty(in.x, {spare * kMostResidentBlock}, ScalarType::Byte);
  Tensor trouble = empty_int(in.x, {1 + in.scenes * int64_t(sizeof(SceneTrouble) / sizeof(int))});
  backend::clear(trouble, stream);
  int* const first = static_cast<int*>(trouble.data_ptr());
  ResidentArguments<T, D> a{s.p2g, s.advance, s.update, s.contact, s.obstacles, int(in.scenes), n, time, in.dt};
  a.contact.activations = nullptr;
  a.contact.row += after * a.contact.step_stride;
  give_clocks(s, a);
  a.rows = static_cast<char*>(row_memory.data_ptr());
  a.blocks = static_cast<char*>(block_memory.data_ptr());
  a.spare_blocks = int(spare);
  a.blocks_taken = first;
  a.trouble = reinterpret_cast<SceneTrouble*>(first + 1);
  s.calls[0].law->template kernels<T, D>().resident(s.laws[0], a, stream);
  backend::resident_status({int(in.scenes), s.activation.max_blocks, n, a.trouble, activated, status, s.activation.id,
                            s.activation.id_stride},
                           stream);
}
#endif

#if MPM_BACKEND == MPM_BACKEND_IS_cuda
std::atomic<bool> loops_are_refused = CUDART_VERSION < 13000;
#endif

#if MPM_BACKEND == MPM_BACKEND_IS_cuda && CUDART_VERSION >= 13000
// Substeps from the second on until the last alone is left, of particles that move in place. The status of the first is
// in `status`, and is that of all of them in the end. False where the device takes no such graph: none, where processes
// share it by MPS.
template <class T, int D>
bool take_persistent(Substeps<T, D>& s, int* activated, int* status, backend::Stream stream) {
  const SubstepsInputs& in = s.in;
  PersistentArguments<T, D> a{{s.update, s.contact, s.obstacles, s.activation.max_blocks}, s.p2g, s.late, s.advance};
  const int64_t rows = s.pool.nodes.size(0);
  Tensor more = empty(in.x, {2 * rows, 1 + D}, s.pool.nodes.scalar_type());
  backend::clear(more, stream);
  a.nodes[0] = static_cast<T*>(s.pool.nodes.data_ptr());
  a.nodes[1] = static_cast<T*>(more.data_ptr());
  a.nodes[2] = static_cast<T*>(torch::stable::narrow(more, 0, rows, rows).data_ptr());
  a.steps = int(in.n - 2);
  if (s.contact.step_time) a.step_time = s.contact.step_time + 1;
  a.contact.step_time = nullptr;
  a.contact.activations = nullptr;
  a.contact.row += a.contact.step_stride;
  give_clocks(s, a);
  Tensor steps_so_far = empty_int(in.x, {1}), arrived = empty(in.x, {2}, ScalarType::Long);
  backend::clear(steps_so_far, stream);
  a.steps_so_far = static_cast<int*>(steps_so_far.data_ptr());
  a.arrived = static_cast<unsigned long long*>(arrived.data_ptr());
  a.drift = s.advance.drift;
  a.activated = activated;
  a.status = status;
  s.activation.drift = a.drift;
  s.activation.previous_status = status;
  s.activation.status = activated;
  static std::atomic<int> works_on = -1;  // a device that has taken one
  int device = 0;
  cudaGetDevice(&device);
  const auto launch = [&](cudaStream_t on, unsigned long long condition) {
    a.loop = condition;
    s.find_blocks(on);
    backend::clear(arrived, on);
    s.calls[0].law->template kernels<T, D>().persistent(s.laws[0], a, on);
  };
  try {
    if (works_on == device) launch(stream, 0);  // so that the device is at work while the host makes the graph
    repeat(stream, launch, [&] { return on_host(a.steps_so_far, 1, stream)[0] < a.steps; });
    works_on = device;
  } catch (const std::exception&) {
    if (works_on == device) throw;
    cudaGetLastError();  // nothing was launched
    loops_are_refused = true;
  }
  return !loops_are_refused;
}
#endif

using Results = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// Everything that the adjoint reads is kept. Nothing where there is no room, and it has to be told when that was.
template <class T, int D>
std::optional<Results> take_recorded(const SubstepsInputs& in, backend::Stream stream) {
  Recorded<T, D> r(in, {}, stream);
  schedule_of_latest = schedule_of(in.schedule, r.steps.facts);
  bool room = false;
  with_team(in.x.size(0) * in.n, [&] { room = r.take(); });
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

// As they were given, where the first activation finds no room.
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
Results take_steps(const SubstepsInputs& in, backend::Stream stream) {
  Substeps<T, D> s(in);
  s.facts.records = false;  // or they would be recorded
  const bool sorts = (schedule_of_latest = schedule_of(in.schedule, s.facts)) == kSortedCpu;
  const Tensor history = packed_history(in.x, in.history, s.columns);
  Tensor status[] = {empty_int(in.x, {1 + in.scenes, kStatusSize}), empty_int(in.x, {1 + in.scenes, kStatusSize})};
  Tensor impulse, time;
  if (has(in.impulse)) s.add_impulses_to(impulse = copy_of(*in.impulse));
  if (has(in.scene_time)) s.count_scene_times(time = copy_of(*in.scene_time));
  if (sorts && OwnParticles<T, D>::may_last(in)) s.make_margin();
  s.make_pool(stream);
  OwnParticles<T, D> particles(s, history, sorts, stream);
  const int* before = s.previous_status;
  int64_t step = 0, last = 0;  // the last status
  with_team(in.x.size(0) * in.n, [&] {
    while (step < in.n) {
      int* const now = static_cast<int*>(status[last = step % 2].data_ptr());
      if (!particles.step(before, now, in.n - 1 - step)) break;  // and the status tells
      before = now;
      step++;
      after_substeps(in.x.size(0), 1, stream);
    }
    particles.give_back();
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
    dispatch(x, [&]<class T, int D>() { recorded = take_recorded<T, D>(in, device.stream()); });
    if (recorded) return *recorded;
  }
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
  Results results;
  dispatch(x, [&]<class T, int D>() { results = take_steps<T, D>(in, device.stream()); });
  return results;
#else
  const int64_t P = x.size(0), D_ = x.size(1), n = in.n;
  Tensor x_[] = {empty_particles(x, {P, D_}), Tensor()};
  Tensor F_[] = {result(x, has(in.F), {P, D_, D_}), Tensor()};
  Tensor J_[] = {result(x, has(in.J), {P}), Tensor()};
  Tensor v_ = empty_particles(x, {P, D_}), C_ = result(x, in.wants_C, {P, D_, D_}), history_;
  Tensor residual_ = result(x, has(in.residual), {P, D_});  // which G2P alone reads
  Tensor status[] = {empty_int(x, {1 + in.scenes, kStatusSize}), empty_int(x, {1 + in.scenes, kStatusSize})};
  Tensor impulse_, time_;
  int last = 0;  // of the two buffers, that of the last step
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
    s.facts.captured = is_recorded(stream);
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
      // The last one has an activation of its own, so that the status tells how many blocks there are by then.
      int* const activated = static_cast<int*>(status[1].data_ptr());
      int* const now = static_cast<int*>(status[0].data_ptr());
      double last_time = in.time;
      for (int64_t k = 1; k < n; k++) last_time += in.dt;
      s.activate(before, activated, stream);
      take_resident(s, n - 1, 0, in.time, activated, now, stream);
      s.activate(now, activated, stream);
      take_resident(s, 1, n - 1, last_time, activated, now, stream);
      after_substeps(P, n, stream);
      return;
    }
    if (n > 1) s.let_activations_last(stream);
    s.fuse(false);
    s.make_pool(stream);
    s.count_time(before, stream);
    if (schedule == kFusedG2P2G) return Merged<T, D>(s, buffers(0), status, stream).take_all(from, before);
    const bool late = s.moves_late();  // then F and J stay where they are
    x_[1] = result(x, n > 1, {P, D});
    F_[1] = late ? F_[0] : result(x, has(in.F) && (n > 1 || s.plastic), {P, D, D});
    J_[1] = late ? J_[0] : result(x, has(in.J) && n > 1, {P});
    if (s.plastic && has(in.F) && !late) {  // which laws change where it stands
      torch::stable::copy_(F_[1], *in.F);
      from.F = field<const T>(F_[1]);
    }
    bool first = true;
    // A substep that reads and writes these buffers in turn, into the first or the second.
    const auto take = [&](int into, bool last, backend::Stream on) {
      int* const now = static_cast<int*>(status[into].data_ptr());
      s.take_turn(into, last);
      s.read(from, field<T>(F_[1 - into]));
      const Particles<T> to = buffers(into);
      s.write(to);
      if (late) s.move_late(to, !first, last);
      s.activate(before, now, on);
      s.move(on);
      before = now;
      first = false;
      // From here on the call reads what it has written.
      from = constant(to);
    };
    int64_t step = 0;
#if CUDART_VERSION >= 13000
    if (schedule == kPersistent) {
      s.activation.most_of_item = persistent_item<D>(in.x.size(0));
      take(0, false, stream);
      const Particles<T> in_place = buffers(0);
      s.read(from, in_place.F);
      s.write(in_place);
      s.move_late(in_place, true, false);
      step = 1;
      if (take_persistent(s, static_cast<int*>(status[1].data_ptr()), static_cast<int*>(status[0].data_ptr()),
                          stream)) {
        take(last = 1, true, stream);
        after_substeps(P, n, stream);
        return;
      }
      if (in.schedule == kChoose) schedule_of_latest = kPerStep;  // of the rest
      s.facts.graph_loops = !loops_are_refused;
      schedule_of(in.schedule, s.facts);  // which is an error if it was asked for
    }
#endif
    while (step < n) {
      last = int(step % 2);
      take(last, step + 1 == n, stream);
      after_substeps(P, 1, stream);
      if (++step == 2) {
        const auto two = [&](backend::Stream on) { take(0, false, on), take(1, false, on); };
        step += 2 * replay((n - step - 1) / 2, stream, two, [&] { after_substeps(P, 2, stream); });
      }
    }
  });
  return {x_[last], v_, C_, F_[last], J_[last], history_, status[last], impulse_, time_, residual_, Tensor()};
#endif
}

Results substeps(MPM_SUBSTEPS_PARAMETERS) { return run(SubstepsInputs{MPM_SUBSTEPS_ARGUMENTS}); }

// By which the latest call on the device of a tensor went, of this thread.
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
// Whether the device is not known to refuse CUDA graphs with loops.
extern "C" __attribute__((visibility("default"))) int torch_mpm_graph_loops() { return !mpm::loops_are_refused; }
#endif
