#pragma once

#include "common/signals.h"
#include "rollout/heat_steps.h"
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
#include "rollout/schedules/replay_pairs.op.h"
#endif

// Steps of the heat of a body at rest, a call without laws: one activation serves them all, and no node moves.
// Obstacles rest, too, and act at all times.
namespace mpm {

template <class T, int D>
class HeatAtRest {
 public:
  HeatAtRest(const SubstepsInputs& inputs, backend::Stream stream)
      : in_(inputs),
        stream_(stream),
        s_(in_),
        heat_(s_),
        particles_(given_particles<T, D>(in_, absent())),
        status_(empty_int(in_.x, {1 + in_.scenes, kStatusSize})),
        velocity_gradient_(empty_particles(in_.x, {P(), D, D})) {
    STD_TORCH_CHECK(in_.resident && !in_.records,
                    "a body at rest has no gradients: records must be false, and resident true");
    for (size_t k = 0; k < in_.end.size(); k++)
      STD_TORCH_CHECK(in_.start[k] <= in_.time && in_.end[k] == HUGE_VAL,
                      "obstacles of a body at rest must act at all times");
    torch::stable::zero_(velocity_gradient_);
    heat_.leave_no_record();
    if (has(in_.scene_time)) s_.count_scene_times(time_ = copy_of(*in_.scene_time));
    if (MPM_BACKEND == MPM_BACKEND_IS_cpu) s_.activation.used_slots = &s_.used_slots;
  }

  // Without room for the blocks of the particles, which the status reports, nothing changes.
  Results run() {
    s_.make_pool(stream_);
    s_.count_time(s_.previous_status, stream_);
    s_.activation.x = particles_.x;
    int* const status = static_cast<int*>(status_.data_ptr());
    if (s_.activate(s_.previous_status, status, stream_)) with_team(P() * in_.n, [&] { run_steps(); });
    return {copy_of(in_.x), copy_of(in_.v), copy(in_.C),        copy(in_.F),   copy(in_.J),  absent(), status_,
            absent(),       time_,          copy(in_.residual), heat_.state(), heat_.status, absent()};
  }

 private:
  const SubstepsInputs& in_;
  const backend::Stream stream_;
  Substeps<T, D> s_;
  HeatSteps<T, D> heat_;
  const Particles<const T> particles_;
  Tensor status_, velocity_gradient_;
  Tensor time_ = absent();

  int64_t P() const { return in_.x.size(0); }
  static Tensor copy(const OptionalTensor& t) { return has(t) ? copy_of(*t) : absent(); }

  void step(backend::Stream on) {
    const Field<const T>& rest = s_.p2g.volume;
    if (heat_.begins()) heat_.begin(particles_.F, particles_.J, rest, on);
    if (MPM_BACKEND != MPM_BACKEND_IS_cpu) heat_.store_volumes(particles_.F, particles_.J, rest);
    const Field<const int> scene{s_.activation.scene, {s_.activation.scene_stride}};
    heat_.run(particles_.x, s_.p2g.mass, rest, field<const T>(velocity_gradient_), scene, on);
    s_.end_time(on);
  }

  // On CUDA graphs repeat pairs of steps.
  void run_steps() {
    for (int64_t done = 0; done < in_.n;) {
      step(stream_);
      after_substeps(P(), 1, stream_);
      done++;
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
      if (done != 2) continue;
      const auto two = [&](backend::Stream on) { step(on), step(on); };
      done += replay_pairs(in_.n - done, P(), stream_, two);
#endif
    }
  }
};

}  // namespace mpm
