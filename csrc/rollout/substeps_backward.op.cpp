#include "rollout/kernels.h"
#include "rollout/substeps.h"

// The adjoint of n steps in one call. The steps are taken once more, and what each of them reads is recorded; then the
// adjoint kernels go through them from the last to the first. The active blocks and nodes of each step are kept as well
// where they take less memory than its particles, and made once more elsewhere. Where sums have a fixed order, on the
// CPU and in deterministic grids, the second time is the first bit by bit. Elsewhere it differs by rounding, and the
// gradient is that of the second time.
namespace mpm {
namespace {

// A field of the particles at many steps, structures of arrays one after another.
template <class T>
class Record {
 public:
  Record() = default;  // of an absent field
  Record(const Tensor& x, int64_t steps, int64_t rows = 1, int64_t columns = 1)
      : shape_{x.size(0), rows, columns},
        pitch_(particle_pitch(x, x.size(0))),
        tensor_(empty(x, {steps, rows * columns, pitch_})) {}

  Field<T> operator[](int64_t step) const {
    if (!tensor_.defined()) return {};
    return {pointer(step), {1, shape_[2] * pitch_, pitch_}};
  }

  // The same as a tensor [P, rows, columns], which must not outlive this.
  Tensor view(int64_t step) const {
    return torch::stable::from_blob(pointer(step), shape_, Shape{1, shape_[2] * pitch_, pitch_}, tensor_.device(),
                                    tensor_.scalar_type());
  }

  void clear() { torch::stable::zero_(tensor_); }

 private:
  T* pointer(int64_t step) const { return static_cast<T*>(tensor_.data_ptr()) + step * tensor_.stride(0); }

  Shape shape_;
  int64_t pitch_ = 0;
  Tensor tensor_;
};

// Per particle; undefined where there is none.
struct Adjoints {
  Tensor x, v, C, F, J, history, mass, volume, parameters;  // the last [P, n], of all laws

  std::vector<Tensor*> all() { return {&x, &v, &C, &F, &J, &history, &mass, &volume, &parameters}; }
};

// Bits of `needs`, in the order of the returned tensors after those of the state.
enum Need : int64_t { kMass = 1, kVolume = 2, kParameters_ = 4, kGravity = 8 };

template <class T, int D>
class SubstepsBackward {
 public:
  // `grad_impulse` is the adjoint of the impulses at the end, or nothing.
  SubstepsBackward(const SubstepsInputs& in, const OptionalTensor& grad_impulse, int64_t needs, backend::Stream stream);

  int64_t columns() const { return s_.columns; }  // of the history of all laws
  int64_t blocks() const { return s_.update.block_count; }

  // The adjoints of the state at the end become those of the state at the beginning, and the others are added up.
  void run(Adjoints& adjoints, const Tensor& gravity) {
    record();
    nodes_ = empty(in_.x, {s_.pool.nodes.size(0), 1 + D});
    if (gravity.defined()) change_ = empty(in_.x, {s_.activation.max_blocks, D});
    for (int64_t i = in_.n - 1; i >= 0; i--) {
      if (i + 1 < in_.n) return_to(i);
      set_time(i);
      leave_advance(i, adjoints);
      leave_grid(adjoints, gravity);
      leave_laws(adjoints);
    }
  }

 private:
  Particles<const T> state(int64_t i) const {
    if (i == 0) return first_;
    const int64_t k = i - 1;
    return {constant(x_[k]), constant(v_[k]), constant(C_[k]), constant(F_[k]), constant(J_[k]), constant(history_[k])};
  }

  // Of obstacles. On CUDA the statuses count it.
  void set_time(int64_t i) {
    if (MPM_BACKEND == MPM_BACKEND_IS_cpu) s_.contact.time = time_[i];
    if (scene_times_.defined()) s_.contact.scene_time = scene_time(i);
  }

  int* status(int64_t i) const { return static_cast<int*>(status_.data_ptr()) + i * status_.stride(0); }

  void read(int64_t i) {
    s_.read(state(i), mapped_[i]);
    for (LawUpdateArguments<T, D>& law : s_.laws) law.stress = stress_[i];
    s_.p2g.stress = constant(stress_[i]);
  }

  // The active blocks of a step.
  void activate(int64_t i) {
    STD_TORCH_CHECK(s_.activate(i == 0 ? nullptr : status(i - 1), status(i), stream_),
                    "max_blocks must be as many as the steps need, got ", in_.max_blocks);
  }

  void record() {
    for (int64_t i = 0; i < in_.n; i++) {
      if (keeps_grids_ && i > 0) s_.make_pool(stream_);
      read(i);
      set_time(i);
      activate(i);
      s_.write({x_[i], v_[i], C_[i], F_[i], J_[i], history_[i]});
      if (has(in_.material)) keep_others(i);
      s_.move(stream_);
      if (!keeps_grids_) continue;
      s_.pool.active.workspace = Tensor();
      grids_.push_back({s_.activation, s_.pool});
    }
  }

  // Everything as it was after the grid update of a step.
  void return_to(int64_t i) {
    read(i);
    if (keeps_grids_) {
      grids_.pop_back();  // of the step after it
      s_.activation = grids_.back().activation;
      s_.pool = grids_.back().pool;
      s_.use_pool();
      if (MPM_BACKEND != MPM_BACKEND_IS_cpu) s_.contact.activations = status(i) + kActivations;
    } else {
      set_time(i);
      activate(i);
      s_.move_grid(stream_);
    }
  }

  // What the laws of a mixture write for their particles alone.
  void keep_others(int64_t i) {
    if (s_.plastic) {
      Tensor mapped = mapped_.view(i);
      torch::stable::copy_(mapped, i == 0 ? in_.F.value() : F_.view(i - 1));
    }
    if (s_.columns > 0) {
      Tensor after = history_.view(i);
      torch::stable::copy_(after, i == 0 ? torch::stable::unsqueeze(first_history_, 2) : history_.view(i - 1));
    }
  }

  // Blocks and nodes of a step, for its adjoint.
  struct Grid {
    ActivateArguments<T, D> activation;
    Pool<T, D> pool;
  };

  bool grid_is_small() const;
  void make_records();
  void make_terms(int64_t needs);
  void leave_advance(int64_t i, Adjoints& adjoints);
  void leave_grid(Adjoints& adjoints, const Tensor& gravity);
  void leave_laws(Adjoints& adjoints);

  // total += term, for all that each of the terms has.
  void add(Adjoints& total, const std::vector<Adjoints*>& terms) {
    AccumulateArguments<T, D> a;
    const std::vector<Tensor*> sums = total.all();
    for (Adjoints* term : terms) {
      const std::vector<Tensor*> tensors = term->all();
      for (size_t k = 0; k < sums.size(); k++) {
        if (!tensors[k]->defined()) continue;
        int64_t size = 1;  // with the gaps between rows
        for (int64_t i = 0; i < sums[k]->dim(); i++) size += (sums[k]->size(i) - 1) * sums[k]->stride(i);
        a.add(static_cast<T*>(sums[k]->data_ptr()), static_cast<const T*>(tensors[k]->data_ptr()), size);
      }
    }
    backend::accumulate(a, stream_);
  }

  T* scene_time(int64_t i) const { return static_cast<T*>(scene_times_.data_ptr()) + i * in_.scenes; }

  // The times of each scene at all steps.
  void make_scene_times() {
    scene_times_ = empty(in_.x, {in_.n, in_.scenes});
    s_.contact.times = int(in_.scenes);
    for (int64_t i = 0; i < in_.n; i++) {
      Tensor now = torch::stable::select(scene_times_, 0, i);
      torch::stable::copy_(now, i == 0 ? *in_.scene_time : torch::stable::select(scene_times_, 0, i - 1));
      if (i > 0) s_.add_dt(scene_time(i), stream_);
    }
  }

  // The adjoint of the impulses on some boundaries.
  ImpulseArguments<D> impulses(int64_t first, int64_t count) const {
    return impulse_gradient<D>(in_.lattice, *grad_impulse_, first, count, s_.impulse_shape(), in_.x);
  }

  const SubstepsInputs& in_;
  OptionalTensor grad_impulse_;
  backend::Stream stream_;
  Substeps<T, D> s_;
  bool mls_;  // F and J move with the affine field, which is recorded then
  bool keeps_grids_;
  std::vector<Grid> grids_;
  std::vector<double> time_;
  Tensor first_history_, status_, scene_times_;
  Particles<const T> first_;
  Record<T> x_, v_, C_, F_, J_, history_, stress_, mapped_;
  Adjoints by_advance_, by_g2p_, by_p2g_, by_laws_;
  Tensor gradient_;  // the velocity gradient that moves F and J where that is not the affine field, or its adjoint
  Tensor nodes_, change_;  // adjoints on the nodes [N, 1 + D], and of the velocity change by gravity, by slots
};

template <class T, int D>
SubstepsBackward<T, D>::SubstepsBackward(const SubstepsInputs& in, const OptionalTensor& grad_impulse, int64_t needs,
                                         backend::Stream stream)
    : in_(in),
      grad_impulse_(grad_impulse),
      stream_(stream),
      s_(in),
      mls_(s_.p2g.form == StressForm::mls),
      time_{in.time} {
  while (int64_t(time_.size()) < in.n) time_.push_back(time_.back() + in.dt);
  first_history_ = packed_history(in.x, in.history, s_.columns);
  first_ = given_particles<T, D>(in, first_history_);
  s_.make_pool(stream);
  s_.count_time(nullptr, stream_);
  if (has(in.scene_time)) make_scene_times();
  keeps_grids_ = grid_is_small();
  make_records();
  make_terms(needs);
}

// Whether the grid of a step takes at most half of what the particles do; torch_mpm/rollouts.py counts on it.
template <class T, int D>
bool SubstepsBackward<T, D>::grid_is_small() const {
  const Pool<T, D>& pool = s_.pool;
  int64_t bytes = 0;
  for (const Tensor* t : {&pool.active.table, &pool.active.block, &pool.active.offsets, &pool.active.index,
                          &pool.active.schedule, &pool.nodes, &pool.updated, &pool.velocity})
    if (t->defined()) bytes += t->numel() * t->element_size();
  return 2 * bytes <= in_.x.size(0) * (2 * D + 4 * D * D) * int64_t(sizeof(T));
}

template <class T, int D>
void SubstepsBackward<T, D>::make_records() {
  const Tensor& x = in_.x;
  const int64_t n = in_.n;
  status_ = empty_int(x, {n, 1 + in_.scenes, kStatusSize});
  x_ = Record<T>(x, n, D);
  v_ = Record<T>(x, n, D);
  if (mls_ || in_.wants_C) C_ = Record<T>(x, n, D, D);
  if (has(in_.F)) F_ = Record<T>(x, n, D, D);
  if (has(in_.J)) J_ = Record<T>(x, n);
  if (s_.columns > 0) history_ = Record<T>(x, n, s_.columns);
  stress_ = Record<T>(x, n, D, D);
  if (s_.plastic) mapped_ = Record<T>(x, n, D, D);
  if (has(in_.material)) stress_.clear();  // of particles without a law
}

// What each kind of kernel adds to the adjoints.
template <class T, int D>
void SubstepsBackward<T, D>::make_terms(int64_t needs) {
  const Tensor& x = in_.x;
  const int64_t P = x.size(0);
  by_advance_.v = empty_particles(x, {P, D});
  Tensor& moving = mls_ ? by_advance_.C : gradient_;
  moving = empty_particles(x, {P, D, D});
  by_g2p_.x = empty_particles(x, {P, D});
  by_p2g_.x = empty_particles(x, {P, D});
  by_p2g_.mass = result(x, needs & kMass, {P});
  by_p2g_.volume = result(x, needs & kVolume, {P});
  bool viscous = false, elastic = false, fluid = false;
  for (const LawCall& call : s_.calls) {
    const LawInfo& info = call.law->info;
    viscous |= info.viscous;
    elastic |= info.field == Deformation::gradient && !info.plastic;
    fluid |= info.field == Deformation::volume_ratio;
  }
  by_laws_.C = result(x, viscous, {P, D, D});
  by_laws_.F = result(x, elastic, {P, D, D});
  by_laws_.J = result(x, fluid, {P});
  by_laws_.parameters = result(x, needs & kParameters_, {P, int64_t(in_.parameters.size())});
  if (!has(in_.material)) return;
  for (Tensor* term : by_laws_.all())  // of the particles of other laws
    if (term->defined()) torch::stable::zero_(*term);
}

// From x, F and J at the end of a step to F and J after the laws, and to the motion of the particles.
template <class T, int D>
void SubstepsBackward<T, D>::leave_advance(int64_t i, Adjoints& adjoints) {
  if (!mls_) {
    GatherArguments<T, D> g = s_.advance.gather;
    g.value = g.moment = {};
    g.gradient = field<T>(gradient_);
    g.lost = 0;
    backend::gather(in_.lattice.order(), g, stream_);
  }
  AdvanceBackwardArguments<T, D> a;
  a.forward.particles = in_.x.size(0);
  a.forward.x = s_.p2g.x;
  a.forward.velocity = constant(v_[i]);
  a.forward.affine = mls_ ? constant(C_[i]) : field<const T>(gradient_);
  a.forward.F = s_.advance.F;
  a.forward.J = s_.advance.J;
  a.forward.dt = in_.dt;
  set_scene(a.forward, in_.scene, in_.x);
  a.forward.scene_dt = s_.p2g.scene_dt;
  a.forward.scenes = in_.scenes;
  a.grad_x = field<const T>(adjoints.x);
  a.grad_F = field<const T>(adjoints.F);
  a.grad_J = field<const T>(adjoints.J);
  a.velocity = field<T>(by_advance_.v);
  a.affine = field<T>(mls_ ? by_advance_.C : gradient_);
  a.F = field<T>(adjoints.F);
  a.J = field<T>(adjoints.J);
  backend::advance_backward(a, stream_);
  add(adjoints, {&by_advance_});
}

// Through G2P, obstacles, grid update and P2G. Node tensors that no one reads any more take the adjoints.
template <class T, int D>
void SubstepsBackward<T, D>::leave_grid(Adjoints& adjoints, const Tensor& gravity) {
  const int64_t order = in_.lattice.order();
  T* const nodes = static_cast<T*>(nodes_.data_ptr());
  ScatterArguments<T, D> motion;
  motion.topology = s_.p2g.topology;
  motion.x = s_.p2g.x;
  motion.value = field<const T>(adjoints.v);
  if (mls_ || in_.wants_C) motion.moment = field<const T>(adjoints.C);
  motion.gradient = field<const T>(gradient_);
  motion.moment_scale = in_.lattice.inverse_inertia();
  motion.deterministic = in_.lattice.deterministic();
  motion.nodes = {nodes + 1, 1 + D, D};
  backend::clear(nodes_, stream_);
  backend::scatter(order, motion, stream_);
  backend::position_gradient(
      order,
      PositionGradientArguments<T, D>{motion.topology, motion.x, motion.value, motion.moment, motion.gradient,
                                      s_.advance.gather.nodes, motion.moment_scale, field<T>(by_g2p_.x)},
      stream_);

  GridUpdateBackwardArguments<T, D> update;
  update.forward = s_.update;
  update.grad_updated = reinterpret_cast<const NodeRow<T, D>*>(nodes);
  if (s_.obstacles) {
    ContactArguments<T, D> contact = s_.contact;
    contact.grad = nodes + 1;
    contact.grad_stride = 1 + D;
    if (has(grad_impulse_)) {
      const T* const mass = reinterpret_cast<const T*>(s_.update.updated);
      backend::contact_impulses_backward(
          ContactImpulsesArguments<T, D>{contact, mass, 1 + D, impulses(0, int64_t(in_.shape.size()))}, stream_);
    } else {
      backend::contact_backward(contact, stream_);
    }
    update.grad_updated = reinterpret_cast<const NodeRow<T, D>*>(contact.result);
  }
  update.grad_nodes = s_.update.updated;
  if (gravity.defined()) update.change = static_cast<Vector<T, D>*>(change_.data_ptr());
  if (has(grad_impulse_) && !in_.wall_kind.empty())
    backend::wall_impulses_backward(
        WallImpulsesBackwardArguments<T, D>{update, impulses(int64_t(in_.shape.size()), 2 * D)}, stream_);
  else
    backend::grid_update_backward(update, stream_);
  if (gravity.defined())
    backend::accumulate_slots(
        AccumulateSlotsArguments<T, D>{s_.update.max_blocks, s_.update.block_count, s_.update.block,
                                       static_cast<const T*>(change_.data_ptr()), static_cast<T*>(gravity.data_ptr())},
        stream_);

  P2GBackwardArguments<T, D> p2g;
  p2g.forward = s_.p2g;
  p2g.grad_nodes = {reinterpret_cast<const T*>(update.grad_nodes), 1 + D, 1 + D};
  p2g.x = field<T>(by_p2g_.x);
  p2g.mass = field<T>(by_p2g_.mass);
  p2g.velocity = field<T>(adjoints.v);
  if (s_.p2g.affine.pointer)
    p2g.affine = field<T>(adjoints.C);
  else
    torch::stable::zero_(adjoints.C);
  p2g.stress = field<T>(s_.stress);
  p2g.volume = field<T>(by_p2g_.volume);
  backend::p2g_backward(order, p2g, stream_);
}

// From F after the laws, their stress and history to F and history before. A law changes the adjoints of what it maps
// where they stand; what it only reads gets a term more.
template <class T, int D>
void SubstepsBackward<T, D>::leave_laws(Adjoints& adjoints) {
  int64_t parameter = 0;
  for (size_t k = 0; k < s_.calls.size(); k++) {
    const LawCall& call = s_.calls[k];
    const LawInfo& info = call.law->info;
    LawBackwardArguments<T, D> a;
    a.law = s_.laws[k].law;
    a.grad_stress = field<const T>(s_.stress);
    if (info.plastic) a.grad_state = field<const T>(adjoints.F);
    a.state = field<T>(info.plastic ? adjoints.F : info.field == Deformation::volume_ratio ? by_laws_.J : by_laws_.F);
    if (info.viscous) a.C = field<T>(by_laws_.C);
    if (!call.history.empty()) {
      a.grad_history = variable<const T, D>(field<const T>(adjoints.history), call.first_column, false);
      a.history = variable<T, D>(field<T>(adjoints.history), call.first_column, false);
    }
    if (by_laws_.parameters.defined()) a.parameters = variable<T, D>(field<T>(by_laws_.parameters), parameter, false);
    parameter += int64_t(call.parameters.size());
    call.law->template kernels<T, D>().update_backward(a, stream_);
  }
  add(adjoints, {&by_g2p_, &by_p2g_, &by_laws_});
}

// Zero where there is no gradient.
void set(Tensor& adjoint, const OptionalTensor& grad, const char* name, const Tensor& x) {
  if (!adjoint.defined()) return;
  if (!has(grad)) {
    torch::stable::zero_(adjoint);
    return;
  }
  Shape shape(adjoint.dim());
  for (size_t i = 0; i < shape.size(); i++) shape[i] = adjoint.size(int64_t(i));
  check_shape(*grad, name, shape);
  check_like(*grad, name, x);
  torch::stable::copy_(adjoint, *grad);
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> substeps_backward(
    const OptionalTensor& grad_x, const OptionalTensor& grad_v, const OptionalTensor& grad_C,
    const OptionalTensor& grad_F, const OptionalTensor& grad_J, const OptionalTensor& grad_history,
    const OptionalTensor& grad_impulse, int64_t needs, MPM_SUBSTEPS_PARAMETERS) {
  const SubstepsInputs in{MPM_SUBSTEPS_ARGUMENTS};
  check_positions(x);
  const int64_t P = x.size(0);
  Adjoints adjoints;
  Tensor gravity_sum;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    SubstepsBackward<T, D> backward(in, grad_impulse, needs, device.stream());
    adjoints.x = empty_particles(x, {P, D});
    adjoints.v = empty_particles(x, {P, D});
    adjoints.C = empty_particles(x, {P, D, D});
    adjoints.F = result(x, has(F), {P, D, D});
    adjoints.J = result(x, has(J), {P});
    adjoints.history = result(x, backward.columns() > 0, {P, backward.columns()});
    adjoints.mass = result(x, needs & kMass, {P});
    adjoints.volume = result(x, needs & kVolume, {P});
    adjoints.parameters = result(x, needs & kParameters_, {P, int64_t(parameters.size())});
    set(adjoints.x, grad_x, "grad_x", x);
    set(adjoints.v, grad_v, "grad_v", x);
    set(adjoints.C, grad_C, "grad_C", x);
    set(adjoints.F, grad_F, "grad_F", x);
    set(adjoints.J, grad_J, "grad_J", x);
    set(adjoints.history, grad_history, "grad_history", x);
    for (Tensor* sum : {&adjoints.mass, &adjoints.volume, &adjoints.parameters}) set(*sum, {}, "", x);
    if ((needs & kGravity) && has(gravity)) gravity_sum = zeros(x, {backward.blocks(), D});
    if (P > 0) backward.run(adjoints, gravity_sum);
  });
  if (!has(C)) adjoints.C = Tensor();
  return {adjoints.x,       adjoints.v,    adjoints.C,      adjoints.F,          adjoints.J,
          adjoints.history, adjoints.mass, adjoints.volume, adjoints.parameters, gravity_sum};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "substeps_backward(Tensor? grad_x, Tensor? grad_v, Tensor? grad_C, Tensor? grad_F, Tensor? grad_J, "
      "Tensor? grad_history, Tensor? grad_impulse, int needs, " MPM_SUBSTEPS_SCHEMA
      ") -> (Tensor x, Tensor v, Tensor C, Tensor F, Tensor J, Tensor history, Tensor mass, Tensor volume, "
      "Tensor parameters, Tensor gravity)");
}
#endif

MPM_LIBRARY_IMPL(m) { m.impl("substeps_backward", TORCH_BOX(&mpm::substeps_backward)); }
