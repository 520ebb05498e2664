#pragma once

#include "common/signals.h"
#include "rollout/arena.h"
#include "rollout/heat_steps.h"
#include "rollout/step_kernels.h"
#include "rollout/thermal_laws.op.h"

// n steps with a record of the inputs of their adjoints: the particles of each step with their heat, and its active
// blocks and nodes if these need less memory than the particles. Heat reads and writes the record in place.
namespace mpm {

// A field of the particles at many steps, as consecutive structures of arrays.
template <class T>
class Record {
 public:
  Record() = default;  // for an absent field
  Record(Arena& arena, const Tensor& x, int64_t steps, int64_t rows = 1, int64_t columns = 1)
      : x_(x),
        shape_{x.size(0), rows, columns},
        pitch_(particle_pitch(x, x.size(0))),
        size_(steps * rows * columns * pitch_),
        data_(arena.take<T>(size_)) {}

  Field<T> operator[](int64_t step) const {
    if (!data_) return {};
    return {pointer(step), {1, shape_[2] * pitch_, pitch_}};
  }

  // The same as a tensor, which must not outlive the memory.
  Tensor matrix(int64_t step) const { return view(step, shape_, {1, shape_[2] * pitch_, pitch_}); }
  Tensor vector(int64_t step) const { return view(step, {shape_[0], shape_[1]}, {1, pitch_}); }
  Tensor scalar(int64_t step) const { return view(step, {shape_[0]}, {1}); }

  void clear() {
    Tensor all = torch::stable::from_blob(data_, Shape{size_}, Shape{1}, x_.device(), x_.scalar_type());
    torch::stable::zero_(all);
  }

 private:
  T* pointer(int64_t step) const { return data_ + step * shape_[1] * shape_[2] * pitch_; }
  Tensor view(int64_t step, const Shape& shape, const Shape& strides) const {
    return torch::stable::from_blob(pointer(step), shape, strides, x_.device(), x_.scalar_type());
  }

  Tensor x_;
  Shape shape_;
  int64_t pitch_ = 0, size_ = 0;
  T* data_ = nullptr;
};

template <class T, int D>
class Recorded {
 public:
  Substeps<T, D> steps;
  std::optional<HeatSteps<T, D>> heat;
  std::optional<ThermalLaws<T, D>> thermal;
  Record<T> x, v, C, F, J, residual, history, stress;
  Record<T> mapped;       // F after the return maps
  Record<T> mapped_J;     // J after laws that melt
  Record<T> difference;   // of the stresses of the phases of laws that melt
  Record<T> heat_before;  // fields of HeatSteps before each step and after the last one
  Record<T> transfer;     // what the transfer of heat to the nodes stores at the particles

  // In `memory`, filled by an earlier `run`, or in new memory.
  Recorded(const SubstepsInputs& in, const OptionalTensor& memory, backend::Stream stream);

  // Computes all steps; false if the pool had no room and must not grow.
  bool run();

  // Restores the state after the grid update of step i, which is the last step, or precedes the step of the last call.
  // False as for `run`.
  bool return_to(int64_t i);

  Field<const int> scene_of_particles() const { return {steps.activation.scene, {steps.activation.scene_stride}}; }

  // Sets the inputs and the results of the laws of temperature of that step.
  void use_thermal_laws(int64_t i) { thermal->read(mapped[i], mapped_J[i], difference[i]); }

  // The node temperatures of that step, which are computed once more where the record does not have them.
  HeatSolution<T, D> conduct_again(int64_t i) {
    const Field<const T> affine = constant(C[i]);
    if (keeps_grids_) return heat->solution(state(i).x, steps.p2g.mass, affine);
    return heat->conduct(state(i).x, steps.p2g.mass, steps.p2g.volume, affine, scene_of_particles(), stream_);
  }

  // The whole record in one tensor; undefined if a pool has outgrown it.
  Tensor memory() const { return steps.activation.max_blocks == in_.max_blocks ? memory_ : Tensor(); }

  // Particles before a step, and the status after its activation.
  Particles<const T> state(int64_t i) const {
    if (i == 0) return first_;
    const int64_t k = i - 1;
    return {constant(x[k]), constant(v[k]),        constant(C[k]),      constant(F[k]),
            constant(J[k]), constant(residual[k]), constant(history[k])};
  }
  int* status(int64_t i) const { return status_ + (i + 1) * (1 + in_.scenes) * kStatusSize; }  // -1: before all
  Tensor status_tensor(int64_t i) const {
    return torch::stable::from_blob(status(i), Shape{1 + in_.scenes, kStatusSize}, Shape{kStatusSize, 1},
                                    in_.x.device(), ScalarType::Int);
  }

  // Times of scenes with separate clocks, after all steps.
  Tensor scene_time_after() const {
    Tensor after = empty(in_.x, {in_.scenes}, ScalarType::Double);
    torch::stable::copy_(after, torch::stable::select(scene_times_, 0, in_.n - 1));
    steps.advance_clocks(static_cast<double*>(after.data_ptr()), stream_);
    return after;
  }

 private:
  // Blocks and nodes of a step.
  struct Grid {
    ActivateArguments<T, D> activation;
    Pool<T, D> pool;
  };

  void lay_out(Arena& arena);
  Grid grid_in(Arena& arena, const Tensor& nodes) const;
  // Blocks and nodes of a step, made on demand: making those of many steps at once would delay the device.
  Grid grid(int64_t i) const {
    Arena arena = grids_;
    arena.skip(i * grid_size_);
    Grid grid = grid_in(arena, torch::stable::select(nodes_, 0, i));
    grid.pool.active.use(grid.activation, workspace_);
    return grid;
  }
  void use(const Grid& grid) {
    steps.activation = grid.activation;
    steps.pool = grid.pool;
    steps.use_pool();
  }

  void read(int64_t i) {
    steps.read(state(i), mapped[i]);
    if (steps.melts) steps.advance.J = constant(mapped_J[i]);
    for (LawUpdateArguments<T, D>& law : steps.laws) law.stress = stress[i];
    steps.p2g.stress = constant(stress[i]);
    if (heat) read_heat(i);
  }

  // Sets the memory of the heat of step i.
  void read_heat(int64_t i) {
    heat->use_fields(heat_before.vector(i), heat_before.vector(i + 1));
    if (!keeps_grids_) return heat->use_own_memory();
    Arena zero = zero_, rest = rest_;
    zero.skip(i * zero_size_);
    rest.skip(i * rest_size_);
    heat->use_memory(heat->lay_out(steps.activation.slots(), zero, rest), transfer.vector(i));
  }

  // Sets the time of obstacles. On CUDA the statuses count the steps.
  void set_time(int64_t i) {
    if (MPM_BACKEND == MPM_BACKEND_IS_cpu) {
      steps.contact.time = time_[i];
      steps.contact.row = first_row_ + i * steps.contact.step_stride;
    }
    if (scene_times_.defined()) steps.contact.scene_time = scene_time(i);
  }

  void begin_heat(int64_t i) {
    if (heat->begins()) heat->begin(state(i).F, state(i).J, steps.p2g.volume, stream_);
    if (heat->heats_by_laws()) steps.dissipate(heat->dissipated());
  }

  void conduct_heat(int64_t i) {
    heat->run(state(i).x, steps.p2g.mass, steps.p2g.volume, constant(C[i]), scene_of_particles(), stream_);
  }

  // Lets all steps share the pool, which has outgrown the record in the activation of step i.
  void leave_grids(int64_t i) {
    keeps_grids_ = steps.nodes_are_clear = false;
    if (heat) read_heat(i);
  }

  bool activate(int64_t i) { return steps.activate(i == 0 && !goes_on_ ? nullptr : status(i - 1), status(i), stream_); }

  // Copies the fields that a law of a mixture writes only for its own particles, and one that melts only for some.
  void keep_others(int64_t i) {
    if (steps.melts) {
      Tensor to = mapped_J.scalar(i);
      torch::stable::copy_(to, i == 0 ? in_.J.value() : J.scalar(i - 1));
    }
    if (steps.plastic) {
      Tensor to = mapped.matrix(i);
      torch::stable::copy_(to, i == 0 ? in_.F.value() : F.matrix(i - 1));
    }
    if (steps.columns > 0) {
      Tensor to = history.matrix(i);
      torch::stable::copy_(to, i == 0 ? torch::stable::unsqueeze(first_history_, 2) : history.matrix(i - 1));
    }
  }

  double* scene_time(int64_t i) const { return static_cast<double*>(scene_times_.data_ptr()) + i * in_.scenes; }

  // The times of each scene at all steps.
  void make_scene_times() {
    scene_times_ = empty(in_.x, {in_.n, in_.scenes}, ScalarType::Double);
    steps.contact.times = int(in_.scenes);
    for (int64_t i = 0; i < in_.n; i++) {
      Tensor now = torch::stable::select(scene_times_, 0, i);
      torch::stable::copy_(now, i == 0 ? *in_.scene_time : torch::stable::select(scene_times_, 0, i - 1));
      if (i > 0) steps.advance_clocks(scene_time(i), stream_);
    }
  }

  const SubstepsInputs& in_;
  backend::Stream stream_;
  Tensor first_history_, memory_, workspace_, scene_times_;
  Particles<const T> first_;
  std::vector<double> time_;
  const ObstacleRow<T, D>* first_row_;
  bool goes_on_;  // from a previous status
  bool keeps_grids_ = false, taken_ = false;
  Arena grids_, zero_, rest_;  // begin at the first step; the latter two for HeatSteps::lay_out
  int64_t grid_size_ = 0, zero_size_ = 0, rest_size_ = 0;
  Tensor nodes_, zero_of_heat_;  // of all grids
  int* status_ = nullptr;
};

template <class T, int D>
Recorded<T, D>::Recorded(const SubstepsInputs& in, const OptionalTensor& memory, backend::Stream stream)
    : steps(in),
      in_(in),
      stream_(stream),
      time_{in.time},
      first_row_(steps.contact.row),
      goes_on_(has(memory) || steps.previous_status) {
  while (int64_t(time_.size()) < in.n) time_.push_back(time_.back() + in.dt);
  first_history_ = packed_history(in.x, in.history, steps.columns);
  first_ = given_particles<T, D>(in, first_history_);
  if (HeatSteps<T, D>::wanted(in)) heat.emplace(steps);
  if (ThermalLaws<T, D>::wanted(steps)) {
    thermal.emplace(steps, heat ? &*heat : nullptr);
    thermal->separate();
  }
  steps.laws_are_apart = thermal || (heat && heat->heats_by_laws());
  steps.forget_stress();  // each step has its own stress
  steps.fuse(true);
  steps.activation.workspace_size = backend::activate_workspace(steps.activation, stream);
  Arena one, counted;
  grid_in(one, {});
  grid_size_ = one.size();
  one.template tensor<T>(in.x, Pool<T, D>::nodes_shape(steps.activation), in.x.scalar_type());
  if (heat) {
    Arena zero, rest;
    heat->lay_out(steps.activation.slots(), zero, rest);
    zero_size_ = zero.size();
    rest_size_ = rest.size();
    one.skip(zero_size_ + rest_size_);
  }
  // At most half of the memory of the particles; torch_mpm/rollouts/budget.py relies on it.
  keeps_grids_ = 2 * one.size() <= in.x.size(0) * (2 * D + 4 * D * D) * int64_t(sizeof(T));
  lay_out(counted);
  memory_ = has(memory) ? *memory : empty(in.x, {counted.size()}, ScalarType::Byte);
  check_shape(memory_, "record", {counted.size()});
  check_type(memory_, "record", ScalarType::Byte, in.x);
  STD_TORCH_CHECK(memory_.is_contiguous(), "record must be contiguous");
  Arena arena(memory_);
  lay_out(arena);
  if (keeps_grids_) {
    workspace_ = empty(in.x, {steps.activation.workspace_size}, ScalarType::Byte);
    use(grid(in.n - 1));
  } else {
    steps.make_pool(stream);
  }
  if (!has(memory)) {
    Tensor before = status_tensor(-1);
    if (steps.previous_status)
      torch::stable::copy_(before, *in.previous_status);
    else
      torch::stable::zero_(before);
    if (has(in.material)) stress.clear();  // of particles without a law
    if (heat) {
      Tensor first = heat_before.vector(0);
      torch::stable::copy_(first, heat->fields.tensor());
    }
  }
  steps.count_time(status(-1), stream_);
  if (has(in.scene_time)) make_scene_times();
}

template <class T, int D>
void Recorded<T, D>::lay_out(Arena& arena) {
  const Tensor& given = in_.x;
  const int64_t n = in_.n;
  const bool mls = steps.p2g.form == StressForm::mls;  // F and J move with the affine field, which is then recorded
  x = Record<T>(arena, given, n, D);
  v = Record<T>(arena, given, n, D);
  if (mls || in_.wants_C) C = Record<T>(arena, given, n, D, D);
  if (has(in_.F)) F = Record<T>(arena, given, n, D, D);
  if (has(in_.J)) J = Record<T>(arena, given, n);
  if (has(in_.residual)) residual = Record<T>(arena, given, n, D);
  if (steps.columns > 0) history = Record<T>(arena, given, n, steps.columns);
  stress = Record<T>(arena, given, n, D, D);
  if (steps.plastic) mapped = Record<T>(arena, given, n, D, D);
  if (steps.melts) mapped_J = Record<T>(arena, given, n);
  if (steps.melts) difference = Record<T>(arena, given, n, D, D);
  if (heat) heat_before = Record<T>(arena, given, n + 1, heat->columns_of_fields());
  status_ = arena.take<int>((1 + n) * (1 + in_.scenes) * kStatusSize);
  if (!keeps_grids_) return;
  const Shape nodes = Pool<T, D>::nodes_shape(steps.activation);
  nodes_ = arena.tensor<T>(given, {n, nodes[0], nodes[1]}, given.scalar_type());
  if (heat) {
    transfer = Record<T>(arena, given, n, heat->transfer_columns());
    zero_ = arena;
    zero_of_heat_ = arena.tensor<char>(given, {n, zero_size_}, ScalarType::Byte);
    rest_ = arena;
    arena.skip(n * rest_size_);
  }
  grids_ = arena;
  arena.skip(n * grid_size_);
}

template <class T, int D>
typename Recorded<T, D>::Grid Recorded<T, D>::grid_in(Arena& arena, const Tensor& nodes) const {
  Grid grid{steps.activation, {}};
  grid.pool.lay_out(
      nodes, grid.activation, steps.obstacles,
      [&](const Shape& shape) { return arena.tensor<int>(in_.x, shape, ScalarType::Int); },
      [&](const Shape& shape) { return arena.tensor<T>(in_.x, shape, in_.x.scalar_type()); });
  return grid;
}

template <class T, int D>
bool Recorded<T, D>::run() {
  if (keeps_grids_) backend::clear(nodes_, stream_);
  if (keeps_grids_ && heat) backend::clear(zero_of_heat_, stream_);
  for (int64_t i = 0; i < in_.n; i++) {
    steps.nodes_are_clear = keeps_grids_;
    if (keeps_grids_) {
      use(grid(i));
      if constexpr (MPM_BACKEND == MPM_BACKEND_IS_cpu) empty_table(steps.pool.active.table);
    }
    read(i);
    set_time(i);
    if (!activate(i)) return false;
    if (keeps_grids_ && !memory().defined()) leave_grids(i);
    steps.write({x[i], v[i], C[i], F[i], J[i], residual[i], history[i]});
    if (has(in_.material) || steps.melts) keep_others(i);
    if (heat) begin_heat(i);
    if (thermal) use_thermal_laws(i);
    thermal ? thermal->run(stream_) : steps.run_laws(stream_);
    if (heat) heat->join_g2p(state(i).x, steps.p2g.mass, constant(C[i]), stream_);
    steps.move(stream_);
    if (heat) conduct_heat(i);
    steps.end_time(stream_);
    after_substeps(in_.x.size(0), 1, stream_);
  }
  steps.with_heat = {};  // the backward pass has no G2P
  return taken_ = true;
}

template <class T, int D>
bool Recorded<T, D>::return_to(int64_t i) {
  if (keeps_grids_) use(grid(i));
  read(i);
  set_time(i);
  if (MPM_BACKEND != MPM_BACKEND_IS_cpu) steps.contact.activations = status(i) + kActivations;
  if (keeps_grids_ || (i + 1 == in_.n && taken_)) return true;
  if (!activate(i)) return false;
  steps.fused = steps.nodes_are_clear = false;  // the stress is recorded
  steps.move_grid(stream_);
  return true;
}

}  // namespace mpm
