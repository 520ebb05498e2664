#include <utility>

#include "common/signals.h"
#include "common/team.h"
#include "rollout/recorded.h"
#include "rollout/schedules/heat_at_rest.op.h"
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "rollout/schedules/sorted_cpu.op.h"
#else
#include "rollout/schedules/cuda_call.op.h"
#endif

// n steps of a simulation in one call.
namespace mpm {
namespace {

thread_local int64_t schedule_of_latest = kChoose;  // of this backend

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
  const auto of_particles = [&](const Tensor& from) {
    Tensor to = empty_particles(in.x, sizes_of(from));
    torch::stable::copy_(to, from);
    return to;
  };
  const auto copy = [&](bool wanted, const auto& record, auto view) {
    return wanted ? of_particles((record.*view)(last)) : absent();
  };
  using R = Record<T>;
  return Results{copy(true, r.x, &R::vector),
                 copy(true, r.v, &R::vector),
                 copy(in.wants_C, r.C, &R::matrix),
                 copy(has(in.F), r.F, &R::matrix),
                 copy(has(in.J), r.J, &R::scalar),
                 copy(r.steps.columns > 0, r.history, &R::vector),
                 status,
                 absent(),
                 has(in.scene_time) ? r.scene_time_after() : absent(),
                 copy(has(in.residual), r.residual, &R::vector),
                 r.heat ? of_particles(r.heat->state()) : absent(),
                 r.heat ? r.heat->status : absent(),
                 r.memory()};
}

#if MPM_BACKEND == MPM_BACKEND_IS_cpu

// Results with the given particles, if the pool has no room for the first activation.
template <class T, int D>
Results no_step(const SubstepsInputs& in, const SortedCpu<T, D>& particles, const Tensor& history, const Tensor& status,
                const Tensor& impulse, const Tensor& time) {
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
          particles.heat ? particles.heat->state() : absent(),
          particles.heat ? particles.heat->status : absent(),
          absent()};
}

template <class T, int D>
Results run_steps(const SubstepsInputs& in, backend::Stream stream) {
  Substeps<T, D> s(in);
  s.facts.records = false;  // this call does not record
  const bool sorts = (schedule_of_latest = schedule_of(in.schedule, s.facts)) == kSortedCpu;
  const Tensor history = packed_history(in.x, in.history, s.columns);
  Tensor status[] = {empty_int(in.x, {1 + in.scenes, kStatusSize}), empty_int(in.x, {1 + in.scenes, kStatusSize})};
  Tensor impulse = absent(), time = absent();
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
  if (step == 0) return no_step<T, D>(in, particles, history, status[0], impulse, time);
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
          particles.heat ? particles.heat->state() : absent(),
          particles.heat ? particles.heat->status : absent(),
          absent()};
}

#else

template <class T, int D>
Results run_steps(const SubstepsInputs& in, backend::Stream stream) {
  CudaCall<T, D> call(in, stream);
  schedule_of_latest = call.schedule();
  call.run();
  schedule_of_latest = call.schedule();
  return call.results();
}

#endif

Results run(const SubstepsInputs& in) {
  const Tensor& x = in.x;
  check_positions(x);
  const DeviceScope device(x);
  std::optional<Results> results;
  if (in.laws.empty()) {
    STD_TORCH_CHECK(!in.heat.empty(), "laws must not be empty without heat");
    schedule_of_latest = kPerStep;
    dispatch(x, [&]<class T, int D>() { results = HeatAtRest<T, D>(in, device.stream()).run(); });
    return *std::move(results);
  }
  if (in.records && !has(in.impulse) && x.size(0) > 0)
    dispatch(x, [&]<class T, int D>() { results = run_recorded<T, D>(in, device.stream()); });
  if (!results) dispatch(x, [&]<class T, int D>() { results = run_steps<T, D>(in, device.stream()); });
  return *std::move(results);
}

Results substeps(MPM_SUBSTEPS_PARAMETERS) { return run(SubstepsInputs{MPM_SUBSTEPS_ARGUMENTS}); }

// The same with free bodies; the last two results are their rows and their report, see csrc/bodies/bodies.op.h.
using BodiesResults = decltype(std::tuple_cat(Results(), std::tuple<Tensor, Tensor>()));

BodiesResults substeps_with_bodies(MPM_BODIES_PARAMETERS, MPM_SUBSTEPS_PARAMETERS) {
  BodiesOfCall given{{bodies, body_shape, body_sizes, body_contact, body_owner, body_joint, max_iterations, tolerance}};
  SubstepsInputs in{MPM_SUBSTEPS_ARGUMENTS};
  in.bodies = &given;
  Results results = run(in);
  return std::tuple_cat(std::move(results), std::tuple(given.rows, given.report));
}

// Schedule of the latest call of this thread on the device of a tensor.
int64_t latest_schedule(const Tensor&) { return schedule_of_latest; }

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#define MPM_SUBSTEPS_RESULTS                                                                                       \
  "Tensor x, Tensor v, Tensor C, Tensor F, Tensor J, Tensor history, Tensor status, Tensor impulse, Tensor time, " \
  "Tensor residual, Tensor heat, Tensor heat_status, Tensor record"
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("substeps(" MPM_SUBSTEPS_SCHEMA ") -> (" MPM_SUBSTEPS_RESULTS ")");
  m.def("substeps_with_bodies(" MPM_BODIES_SCHEMA ", " MPM_SUBSTEPS_SCHEMA ") -> (" MPM_SUBSTEPS_RESULTS
        ", Tensor rows, Tensor report)");
  m.def("latest_schedule(Tensor like) -> int");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("substeps", TORCH_BOX(&mpm::substeps));
  m.impl("substeps_with_bodies", TORCH_BOX(&mpm::substeps_with_bodies));
  m.impl("latest_schedule", TORCH_BOX(&mpm::latest_schedule));
}

#if MPM_BACKEND == MPM_BACKEND_IS_cuda
// Whether no device has refused CUDA graphs with loops.
extern "C" __attribute__((visibility("default"))) int torch_mpm_graph_loops() { return !mpm::loops_are_refused; }
#endif
