#include "common/team.h"
#include "rollout/heat_backward.h"
#include "rollout/thermal_laws_backward.op.h"

// The adjoint of n steps in one call. The steps are recomputed with a record of the inputs of each, unless the forward
// pass has made the record; then the adjoint kernels process them from the last to the first. On deterministic CUDA
// grids the recomputed steps are bitwise those of the forward pass. Elsewhere they differ by rounding, and the gradient
// is that of the recomputed steps.
namespace mpm {
namespace {

// Adjoints per particle; absent ones are undefined.
struct Adjoints {
  Tensor x, v, C, F, J, history, mass, volume;
  Tensor parameters;             // [P, n], of all laws
  Tensor dt;                     // [P], with respect to dt * scene_dt, without gravity
  Tensor heat, heat_parameters;  // [P, m] in the order of the result, [P, kHeatParameters]
  Tensor heat_boundaries;        // [B, m], see HeatAdjoints
  Tensor tables;                 // [P, m], of the values of all tables
  Tensor heat_status;            // of the adjoint solves
};

// Bits of `needs`, in the order of the returned tensors after those of the state.
enum Need : int64_t {
  kMass = 1,
  kVolume = 2,
  kParameters_ = 4,
  kGravity = 8,
  kObstacles = 16,
  kTimeStep = 32,
  kHeatParameters_ = 64,
  kHeatBoundaries = 128,
  kTables = 256
};

// Adjoints summed over the grid, undefined if not wanted: of gravity, by blocks of the domain, and of the table of
// obstacles.
struct GridSums {
  Tensor gravity, obstacles;
};

template <class T, int D>
class SubstepsBackward {
 public:
  // `grad_impulse` is the adjoint of the final impulses, or nothing; `record` is that of the steps, or nothing.
  SubstepsBackward(const SubstepsInputs& in, const OptionalTensor& grad_impulse, const OptionalTensor& record,
                   int64_t needs, backend::Stream stream);

  int64_t columns() const { return s_.columns; }  // of the history of all laws
  int64_t blocks() const { return s_.update.block_count; }
  // Laws of temperature pass the adjoints of their parameters on.
  bool wants_parameters(int64_t needs) const {
    return (needs & kParameters_) || (r_.thermal && r_.thermal->has_parameters());
  }
  int64_t heat_columns() const { return r_.heat ? r_.heat->state_columns() : 0; }

  // The adjoints of the final state become those of the initial state; the others are accumulated.
  void run(Adjoints& adjoints, const GridSums& sums) {
    if (!recorded_) check_room(r_.run());
    const int64_t slots = s_.activation.slots(), rows = slots * kBlockNodes<D>;
    motions_ = cleared_at_once(rows * (1 + D) * int64_t(sizeof(T)), in_.n);
    motion_ = empty(in_.x, {motions_, rows, 1 + D});
    update_ = empty(in_.x, {rows, 1 + D});
    if (s_.obstacles) contact_ = empty(in_.x, {rows, 1 + D});
    if (sums.gravity.defined()) change_ = empty(in_.x, {slots, D});
    if (sums.obstacles.defined()) row_grad_ = empty(in_.x, {slots, s_.contact.obstacles, ObstacleRow<T, D>::width});
    if (s_.flips()) before_ = empty(in_.x, {3, rows, 1 + D});
    std::optional<HeatBackward<T, D>> heat;
    if (r_.heat) heat.emplace(r_, in_, stream_);
    if (r_.thermal) thermal_.emplace(r_, in_, stream_);
    for (int64_t i = in_.n - 1; i >= 0; i--) {
      check_room(r_.return_to(i));
      if (s_.flips()) keep_adjoint(adjoints);
      if (heat) heat->run(i, heat_adjoints(adjoints, sums));
      backward_advance(i, adjoints);
      backward_grid(i, adjoints, sums);
      if (s_.flips()) backward_kept(adjoints);
      const Tensor dissipated = heat ? heat->dissipated : absent();
      if (thermal_) thermal_->before_laws(i, thermal_adjoints(adjoints, dissipated));
      backward_laws(adjoints, dissipated);
      if (thermal_) thermal_->after_laws(i, thermal_adjoints(adjoints, dissipated));
      if (heat) add_terms({{adjoints.x, heat->x_term}, {adjoints.F, heat->F_term}, {adjoints.J, heat->J_term}});
      if (adjoints.dt.defined()) add_terms({{adjoints.dt, motion_dt_}, {adjoints.dt, stress_dt_}});
      after_substeps(in_.x.size(0), 1, stream_);
    }
  }

 private:
  // Those of the heat of a step, which adds to the adjoint of the velocity gradient after the step.
  static HeatAdjoints heat_adjoints(const Adjoints& a, const GridSums& sums) {
    return {a.heat, a.heat_parameters, a.C, a.mass, a.volume, a.dt, a.heat_boundaries, a.heat_status, sums.obstacles};
  }

  ThermalAdjoints thermal_adjoints(const Adjoints& a, const Tensor& dissipated) const {
    return {a.F, a.J, a.heat, stress_, dissipated, a.parameters, a.tables};
  }

  // The adjoints of the motion of the nodes in a step.
  T* motion_of(int64_t i) const { return static_cast<T*>(motion_.data_ptr()) + i % motions_ * motion_.stride(0); }

  void check_room(bool room) const {
    STD_TORCH_CHECK(room, "max_blocks must be as many as the steps need, got ", in_.max_blocks);
  }

  void make_terms(int64_t needs);
  void backward_advance(int64_t i, Adjoints& adjoints);
  AdvanceBackwardArguments<T, D> advance(int64_t i, Adjoints& adjoints) const;
  PositionGradientArguments<T, D> motion(const Adjoints& adjoints) const;
  void backward_grid(int64_t i, Adjoints& adjoints, const GridSums& sums);
  void backward_obstacles(int64_t i, const T* nodes, const GridSums& sums);
  void keep_adjoint(const Adjoints& adjoints);
  void backward_kept(Adjoints& adjoints);
  void backward_laws(Adjoints& adjoints, const Tensor& dissipated);

  // Adds to each sum its term of the same strides, if there is one.
  void add_terms(std::initializer_list<std::pair<Tensor, Tensor>> sums) {
    AccumulateArguments<T, D> a;
    for (const auto& [sum, term] : sums) {
      if (!term.defined()) continue;
      int64_t size = 1;  // with the gaps between rows
      for (int64_t i = 0; i < sum.dim(); i++) size += (sum.size(i) - 1) * sum.stride(i);
      a.add(static_cast<T*>(sum.data_ptr()), static_cast<const T*>(term.data_ptr()), size);
    }
    backend::accumulate(a, stream_);
  }

  // The adjoint of the impulses on `count` boundaries from `first` on.
  ImpulseArguments<D> impulses(int64_t first, int64_t count) const {
    return impulse_gradient<D>(in_.lattice, *grad_impulse_, first, count, s_.impulse_shape(), in_.x);
  }

  const SubstepsInputs& in_;
  OptionalTensor grad_impulse_;
  backend::Stream stream_;
  bool recorded_;
  Recorded<T, D> r_;
  Substeps<T, D>& s_;
  std::optional<ThermalLawsBackward<T, D>> thermal_;
  bool mls_;  // F and J move with the affine field
  Tensor stress_, F_term_, parameters_term_;
  Tensor motion_dt_, stress_dt_;  // of the end of a step, and of P2G [P]
  Tensor gradient_;  // velocity gradient that moves F and J, if that is not the affine field; or its adjoint
  int64_t motions_ = 1;
  // Adjoints on the nodes [N, 1 + D]: of their motion in several steps, before contact, and before the grid update; and
  // of the velocity change by gravity, by slots.
  Tensor motion_, contact_, update_, change_;
  Tensor row_grad_;  // of the table of obstacles, by slots
  // With FLIP, [3, N, 1 + D]: the node sums before the forces, the adjoints of their velocities, and the velocities;
  // per particle: the adjoint of the velocity that FLIP subtracts from G2P, and the terms of v and C from these nodes.
  Tensor before_, kept_, v_term_, C_term_;
};

template <class T, int D>
SubstepsBackward<T, D>::SubstepsBackward(const SubstepsInputs& in, const OptionalTensor& grad_impulse,
                                         const OptionalTensor& record, int64_t needs, backend::Stream stream)
    : in_(in),
      grad_impulse_(grad_impulse),
      stream_(stream),
      recorded_(has(record)),
      r_(in, record, stream),
      s_(r_.steps),
      mls_(s_.p2g.form == StressForm::mls) {
  make_terms(needs);
}

// Laws without a return map or history add to the adjoints; others write these terms.
template <class T, int D>
void SubstepsBackward<T, D>::make_terms(int64_t needs) {
  const Tensor& x = in_.x;
  const int64_t P = x.size(0);
  stress_ = empty_particles(x, {P, D, D});
  if (!mls_) gradient_ = empty_particles(x, {P, D, D});
  motion_dt_ = result(x, needs & kTimeStep, {P});
  stress_dt_ = result(x, needs & kTimeStep, {P});
  if (s_.flips()) {
    kept_ = empty_particles(x, {P, D});
    v_term_ = empty_particles(x, {P, D});
    if (in_.apic) C_term_ = empty_particles(x, {P, D, D});
  }
  bool history = false, changing = false;
  for (const LawCall& call : s_.calls) {
    const LawInfo& info = call.law->info;
    history |= !info.plastic && !info.history.empty();
    changing |= info.changes();
  }
  F_term_ = result(x, history, {P, D, D});
  parameters_term_ = result(x, changing && wants_parameters(needs), {P, int64_t(in_.parameters.size())});
  for (Tensor* term : {&F_term_, &parameters_term_})  // zero for the particles of other laws
    if (term->defined()) torch::stable::zero_(*term);
}

// Adjoint of the end of a step and of G2P: from x, F and J after the step to F and J after the laws, the motion of the
// particles, and that of the nodes.
template <class T, int D>
void SubstepsBackward<T, D>::backward_advance(int64_t i, Adjoints& adjoints) {
  if (!mls_) {
    GatherArguments<T, D> g = s_.advance.gather;
    g.value = g.moment = {};
    g.gradient = field<T>(gradient_);
    g.lost = 0;
    backend::gather(in_.lattice.order(), g, stream_);
  }
  if (i % motions_ == motions_ - 1 || i == in_.n - 1) backend::clear(motion_, stream_);
  G2PAdvanceBackwardArguments<T, D> a;
  a.advance = advance(i, adjoints);
  const PositionGradientArguments<T, D> of = motion(adjoints);
  a.scatter = {of.topology,
               of.x,
               of.value,
               of.moment,
               of.gradient,
               of.moment_scale,
               in_.lattice.deterministic(),
               {motion_of(i) + 1, 1 + D, D}};
  backend::g2p_advance_backward(in_.lattice.order(), a, stream_);
}

template <class T, int D>
AdvanceBackwardArguments<T, D> SubstepsBackward<T, D>::advance(int64_t i, Adjoints& adjoints) const {
  AdvanceBackwardArguments<T, D> a;
  a.forward.particles = in_.x.size(0);
  a.forward.x = s_.p2g.x;
  a.forward.velocity = constant(r_.v[i]);
  a.forward.affine = mls_ ? constant(r_.C[i]) : field<const T>(gradient_);
  a.forward.F = s_.advance.F;
  a.forward.J = s_.advance.J;
  a.forward.dt = in_.dt;
  set_scene(a.forward, in_.scene, in_.x);
  a.forward.scene_dt = s_.p2g.scene_dt;
  a.forward.scenes = in_.scenes;
  a.grad_x = field<const T>(adjoints.x);
  a.grad_F = field<const T>(adjoints.F);
  a.grad_J = field<const T>(adjoints.J);
  a.velocity = field<T>(adjoints.v);
  a.adds_velocity = true;
  a.affine = field<T>(mls_ ? adjoints.C : gradient_);
  a.adds_affine = mls_;
  a.F = field<T>(adjoints.F);
  a.J = field<T>(adjoints.J);
  a.dt = field<T>(motion_dt_);
  return a;
}

// Arguments of the adjoint of G2P, with its position gradient.
template <class T, int D>
PositionGradientArguments<T, D> SubstepsBackward<T, D>::motion(const Adjoints& adjoints) const {
  PositionGradientArguments<T, D> a;
  a.topology = s_.p2g.topology;
  a.x = s_.p2g.x;
  a.value = field<const T>(adjoints.v);
  if (mls_ || in_.wants_C) a.moment = field<const T>(adjoints.C);
  a.gradient = field<const T>(gradient_);
  a.nodes = s_.advance.gather.nodes;
  a.moment_scale = in_.lattice.inverse_inertia();
  a.position_gradient = field<T>(adjoints.x);
  a.adds = true;
  return a;
}

// Adjoint of contact: of the nodes before it, and of the table of obstacles.
template <class T, int D>
void SubstepsBackward<T, D>::backward_obstacles(int64_t i, const T* nodes, const GridSums& sums) {
  ContactArguments<T, D> contact = s_.contact;
  contact.grad = nodes + 1;
  contact.grad_stride = 1 + D;
  contact.result = static_cast<T*>(contact_.data_ptr());
  if (row_grad_.defined()) contact.row_grad = static_cast<T*>(row_grad_.data_ptr());
  if (has(grad_impulse_)) {
    const T* const mass = reinterpret_cast<const T*>(s_.update.updated);
    backend::contact_impulses_backward(
        ContactImpulsesArguments<T, D>{contact, mass, 1 + D, impulses(0, int64_t(in_.shape.size()))}, stream_);
  } else {
    backend::contact_backward(contact, stream_);
  }
  if (!row_grad_.defined()) return;
  const int columns = contact.obstacles * ObstacleRow<T, D>::width;
  T* const sum = static_cast<T*>(sums.obstacles.data_ptr()) + i * contact.step_stride * ObstacleRow<T, D>::width;
  backend::sum_slots(SumSlotsArguments<T, D>{{contact.max_blocks, s_.update.geometry.blocks_per_scene, contact.block,
                                              contact.rows, columns, contact.rows > 1, contact.row_grad, sum, columns}},
                     stream_);
}

// Adjoint of contact, grid update and P2G.
template <class T, int D>
void SubstepsBackward<T, D>::backward_grid(int64_t i, Adjoints& adjoints, const GridSums& sums) {
  const Tensor& gravity = sums.gravity;
  T* const nodes = motion_of(i);
  GridUpdateBackwardArguments<T, D> update;
  update.forward = s_.update;
  update.grad_updated = reinterpret_cast<const NodeRow<T, D>*>(nodes);
  if (s_.obstacles) {
    backward_obstacles(i, nodes, sums);
    update.grad_updated = static_cast<const NodeRow<T, D>*>(contact_.data_ptr());
  }
  update.grad_nodes = static_cast<NodeRow<T, D>*>(update_.data_ptr());
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
  p2g.motion = motion(adjoints);
  p2g.grad_nodes = {reinterpret_cast<const T*>(update.grad_nodes), 1 + D, 1 + D};
  p2g.x = field<T>(adjoints.x);
  p2g.mass = field<T>(adjoints.mass);
  p2g.velocity = field<T>(adjoints.v);
  if (s_.p2g.affine.pointer) p2g.affine = field<T>(adjoints.C);
  p2g.stress = field<T>(stress_);
  p2g.volume = field<T>(adjoints.volume);
  p2g.dt = field<T>(stress_dt_);
  p2g.adds = true;
  backend::p2g_backward(in_.lattice.order(), p2g, stream_);
  if (!s_.p2g.affine.pointer) torch::stable::zero_(adjoints.C);  // already read by the position gradient
}

// Adjoint of the node velocities before the forces; FLIP subtracts its share of them from G2P.
template <class T, int D>
void SubstepsBackward<T, D>::keep_adjoint(const Adjoints& adjoints) {
  const Field<const T> v = field<const T>(adjoints.v);
  backend::add_scaled(AddScaledArguments<T, D>{in_.x.size(0), field<T>(kept_), {}, v, -in_.flip()}, stream_);
}

// Adjoint of FLIP's share, through the velocities of the particle and of the nodes before the forces. The remaining
// terms are in the adjoint of G2P.
template <class T, int D>
void SubstepsBackward<T, D>::backward_kept(Adjoints& adjoints) {
  const int64_t order = in_.lattice.order(), size = before_.stride(0);
  Tensor sums = torch::stable::narrow(before_, 0, 0, 2);
  backend::clear(sums, stream_);
  T* const nodes = static_cast<T*>(before_.data_ptr());
  T *const grad = nodes + size, *const updated = grad + size;
  GridUpdateBackwardArguments<T, D> update;
  update.forward = s_.find_nodes_before(s_.p2g, nodes, reinterpret_cast<NodeRow<T, D>*>(updated), stream_);
  PositionGradientArguments<T, D> motion = this->motion(adjoints);
  motion.value = field<const T>(kept_);
  motion.moment = motion.gradient = {};
  motion.nodes = {updated + 1, 1 + D, D};
  ScatterArguments<T, D> scatter{motion.topology,     motion.x, motion.value, {}, {}, 1, s_.p2g.deterministic,
                                 {grad + 1, 1 + D, D}};
  backend::scatter(order, scatter, stream_);
  update.grad_updated = reinterpret_cast<const NodeRow<T, D>*>(grad);
  update.grad_nodes = static_cast<NodeRow<T, D>*>(update_.data_ptr());
  backend::grid_update_backward(update, stream_);

  P2GBackwardArguments<T, D> p2g;
  p2g.forward = s_.p2g;
  p2g.forward.stress = {};
  p2g.motion = motion;
  p2g.grad_nodes = {reinterpret_cast<const T*>(update.grad_nodes), 1 + D, 1 + D};
  p2g.x = field<T>(adjoints.x);
  p2g.mass = field<T>(adjoints.mass);
  p2g.velocity = field<T>(v_term_);
  if (s_.p2g.affine.pointer) p2g.affine = field<T>(C_term_);
  p2g.adds = true;
  backend::p2g_backward(order, p2g, stream_);
  add_terms({{adjoints.v, v_term_}, {adjoints.C, s_.p2g.affine.pointer ? C_term_ : Tensor()}});
  const Field<T> v = field<T>(adjoints.v);
  backend::add_scaled(AddScaledArguments<T, D>{in_.x.size(0), v, constant(v), motion.value, -1}, stream_);
}

// Adjoint of the laws, the last one first: from F after the laws, stress and history to F and history before. A law
// updates the adjoints of the quantities that it maps in place, and adds to those that it only reads. `dissipated` is
// the adjoint of the energy that becomes heat, or undefined.
template <class T, int D>
void SubstepsBackward<T, D>::backward_laws(Adjoints& adjoints, const Tensor& dissipated) {
  int64_t parameter = int64_t(in_.parameters.size());
  for (size_t k = s_.calls.size(); k-- > 0;) {
    const LawCall& call = s_.calls[k];
    const LawInfo& info = call.law->info;
    LawBackwardArguments<T, D> a;
    a.law = s_.laws[k].law;
    a.grad_stress = field<const T>(stress_);
    a.adds = !info.changes();
    if (info.plastic) a.grad_state = field<const T>(adjoints.F);
    a.state = field<T>(info.field == Deformation::volume_ratio ? adjoints.J
                       : info.plastic || a.adds                ? adjoints.F
                                                               : F_term_);
    if (info.viscous) a.C = field<T>(adjoints.C);
    if (s_.dissipates(k)) a.grad_dissipated = field<const T>(dissipated);
    if (!call.history.empty()) {
      a.grad_history = variable<const T, D>(field<const T>(adjoints.history), call.first_column, false);
      a.history = variable<T, D>(field<T>(adjoints.history), call.first_column, false);
    }
    if (thermal_) thermal_->set(k, a);
    parameter -= int64_t(call.parameters.size());
    if (adjoints.parameters.defined())
      a.parameters = variable<T, D>(field<T>(a.adds ? adjoints.parameters : parameters_term_), parameter, false);
    call.law->template kernels<T, D>().update_backward(a, stream_);
  }
  if (F_term_.defined() || parameters_term_.defined())
    add_terms({{adjoints.F, F_term_}, {adjoints.parameters, parameters_term_}});
  if (thermal_ && thermal_->F_term.defined()) add_terms({{thermal_->elastic_F, thermal_->F_term}});
}

// Sets an adjoint to the given gradient, or to zero.
void set(Tensor& adjoint, const OptionalTensor& grad, const char* name, const Tensor& x) {
  if (!adjoint.defined()) return;
  if (!has(grad)) {
    torch::stable::zero_(adjoint);
    return;
  }
  check_shape(*grad, name, sizes_of(adjoint));
  check_like(*grad, name, x);
  torch::stable::copy_(adjoint, *grad);
}

using Gradients = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                             Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// The list of the adjoints of the results. An op has at most 64 arguments, the bits of the dispatcher.
enum Result : size_t { kX, kV, kC, kF, kJ, kHistory, kImpulse, kHeat, kResults };

Gradients substeps_backward(const std::vector<OptionalTensor>& grads, int64_t needs, const OptionalTensor& record,
                            MPM_SUBSTEPS_PARAMETERS) {
  const SubstepsInputs in{MPM_SUBSTEPS_ARGUMENTS};
  check_positions(x);
  STD_TORCH_CHECK(grads.size() == kResults, "grads must have ", size_t(kResults), " entries, got ", grads.size());
  const int64_t P = x.size(0);
  Adjoints adjoints;
  GridSums sums;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    SubstepsBackward<T, D> backward(in, grads[kImpulse], record, needs, device.stream());
    adjoints.x = empty_particles(x, {P, D});
    adjoints.v = empty_particles(x, {P, D});
    adjoints.C = empty_particles(x, {P, D, D});
    adjoints.F = result(x, has(F), {P, D, D});
    adjoints.J = result(x, has(J), {P});
    adjoints.history = result(x, backward.columns() > 0, {P, backward.columns()});
    adjoints.mass = result(x, needs & kMass, {P});
    adjoints.volume = result(x, needs & kVolume, {P});
    adjoints.parameters = result(x, backward.wants_parameters(needs), {P, int64_t(parameters.size())});
    adjoints.dt = result(x, needs & kTimeStep, {P});
    if (const int64_t columns = backward.heat_columns(); columns > 0) {
      adjoints.heat = empty_particles(x, {P, columns});
      adjoints.heat_parameters = result(x, needs & kHeatParameters_, {P, int64_t(kHeatParameters)});
      const int64_t numbers = 2 * int64_t(in.heat_terms.size()) + int64_t(in.held_obstacles.size());
      if ((needs & kHeatBoundaries) && numbers > 0) adjoints.heat_boundaries = zeros(x, {in.scenes, numbers});
      adjoints.heat_status = empty(x, {in.scenes, int64_t(kHeatStatusSize)}, ScalarType::Double);
      torch::stable::zero_(adjoints.heat_status);
    }
    int64_t values = 0;
    for (const Tensor& table : in.tables) values += table.size(1);
    adjoints.tables = result(x, needs & kTables, {P, values});
    const auto set_from = [&](Result k, Tensor& adjoint) {
      set(adjoint, grads[k], element("grads", int(k)).c_str(), x);
    };
    set_from(kX, adjoints.x);
    set_from(kV, adjoints.v);
    set_from(kC, adjoints.C);
    set_from(kF, adjoints.F);
    set_from(kJ, adjoints.J);
    set_from(kHistory, adjoints.history);
    set_from(kHeat, adjoints.heat);
    for (Tensor* sum : {&adjoints.mass, &adjoints.volume, &adjoints.parameters, &adjoints.dt, &adjoints.heat_parameters,
                        &adjoints.tables})
      set(*sum, {}, "", x);
    if ((needs & kGravity) && has(gravity)) sums.gravity = zeros(x, {backward.blocks(), D});
    if ((needs & kObstacles) && has(obstacle_table)) sums.obstacles = zeros(x, sizes_of(*obstacle_table));
    if (P > 0) with_team(P * n, [&] { backward.run(adjoints, sums); });
  });
  if (!has(C)) adjoints.C = Tensor();
  if (!(needs & kParameters_)) adjoints.parameters = Tensor();
  return {adjoints.x,
          adjoints.v,
          adjoints.C,
          adjoints.F,
          adjoints.J,
          adjoints.history,
          adjoints.mass,
          adjoints.volume,
          adjoints.parameters,
          sums.gravity,
          sums.obstacles,
          adjoints.dt,
          adjoints.heat,
          adjoints.heat_parameters,
          adjoints.heat_boundaries,
          adjoints.heat_status,
          adjoints.tables};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("substeps_backward(Tensor?[] grads, int needs, Tensor? record, " MPM_SUBSTEPS_SCHEMA
        ") -> (Tensor x, Tensor v, Tensor C, Tensor F, Tensor J, Tensor history, Tensor mass, Tensor volume, "
        "Tensor parameters, Tensor gravity, Tensor obstacles, Tensor dt, Tensor heat, Tensor heat_parameters, Tensor "
        "heat_boundaries, Tensor heat_status, Tensor tables)");
}
#endif

MPM_LIBRARY_IMPL(m) { m.impl("substeps_backward", TORCH_BOX(&mpm::substeps_backward)); }
