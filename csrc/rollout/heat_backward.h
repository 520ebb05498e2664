#pragma once

#include <algorithm>

#include "rollout/recorded.h"

// Adjoint of the conduction of heat in the steps of a record, the last step first.
namespace mpm {

// Bytes of nodes that a backward pass clears at once, those of several steps, to save launches.
constexpr int64_t kCleared = 1 << 26;

// Number of steps whose nodes, of `bytes` each, are cleared at once.
inline int64_t cleared_at_once(int64_t bytes, int64_t steps) {
  return std::clamp<int64_t>(kCleared / std::max<int64_t>(bytes, 1), 1, steps);
}

// Adjoints of the heat of the particles, and sums of other adjoints that it adds to; absent ones are undefined.
struct HeatAdjoints {
  Tensor state;       // [P, m] in the order of the record
  Tensor parameters;  // [P, kHeatParameters]
  Tensor velocity_gradient, mass, volume, dt;
  Tensor boundaries;  // [B, m]: of both numbers of each term, and of the temperatures of the held obstacles
  Tensor status;      // [B, kHeatStatusSize] of the adjoint solves, as that of the solves of a call
  Tensor obstacles;   // of the table of obstacles
};

template <class T, int D>
class HeatBackward {
 public:
  Tensor x_term, F_term, J_term;  // adjoints of the particles before the step, from its heat
  Tensor dissipated;              // adjoint of the energy that its laws dissipate, undefined where none becomes heat

  HeatBackward(Recorded<T, D>& record, const SubstepsInputs& in, backend::Stream stream);

  // Step i, to which the record has returned. The adjoints after the step become those before it.
  void run(int64_t i, const HeatAdjoints& adjoints) {
    const HeatSolution<T, D> solution = record_.conduct_again(i);
    make_nodes(solution);
    use_cleared(i);
    HeatToParticlesBackwardArguments<T, D> up = to_particles(solution, adjoints);
    backend::heat_to_particles_backward(order(), up, stream_);
    scatter(up);
    solve(solution.system, adjoints.status);
    multiply(solution.system);
    if (heat().has_terms()) adjoint_of_terms(solution);
    if (adjoints.boundaries.defined()) adjoint_of_boundaries(solution, adjoints.boundaries);
    adjoint_of_nodes(solution, adjoints.dt.defined());
    gather(solution.down, adjoints.dt.defined());
    if (heat().holds_surface()) adjoint_of_layers(i, solution.down, adjoints.obstacles);
    backend::heat_to_nodes_backward(order(), to_nodes(i, solution.down, adjoints), stream_);
    if (!kOnCuda) position_gradient(solution.down);
    position_gradient_of_boundaries(solution.down);
  }

 private:
  // There the adjoint of P2G gathers ∇(θ + d) and ∇λ itself, and computes the position gradient of the forms.
  static constexpr bool kOnCuda = MPM_BACKEND == MPM_BACKEND_IS_cuda;

  // Numbers per node that are zero when the adjoint of a step begins.
  static constexpr int64_t kZero = kHeatSolved + 1 + kMostSimpleSteps;

  int64_t order() const { return in_.lattice.order(); }
  T* rows(const Tensor& t) const { return static_cast<T*>(t.data_ptr()); }
  HeatSteps<T, D>& heat() const { return *record_.heat; }
  // Memory of packed particles that the adjoint solve leaves as they are: that of the solves of the steps.
  void* packed() const { return kOnCuda ? heat().workspace(stream_) : nullptr; }
  // Forms from `first` on.
  static Field<T> forms(const Tensor& t, int first) {
    Field<T> f = field<T>(t);
    f.pointer += first * f.stride[1];
    return f;
  }

  void make_nodes(const HeatSolution<T, D>& solution);
  void use_cleared(int64_t i);
  HeatToParticlesBackwardArguments<T, D> to_particles(const HeatSolution<T, D>& solution, const HeatAdjoints& adjoints);
  void scatter(const HeatToParticlesBackwardArguments<T, D>& up);
  void solve(HeatArguments<T, D> system, const Tensor& status);
  void multiply(HeatArguments<T, D> system);
  HeatTermBackwardArguments<T, D> term_backward(const HeatSolution<T, D>& solution,
                                                const HeatTermArguments<T, D>& term) const;
  void adjoint_of_terms(const HeatSolution<T, D>& solution);
  void adjoint_of_boundaries(const HeatSolution<T, D>& solution, const Tensor& sums);
  void adjoint_of_surface_temperature(const HeatSolution<T, D>& solution, const HeatSlotSums<T>& to);
  void adjoint_of_layers(int64_t i, const HeatToNodesArguments<T, D>& down, const Tensor& obstacles);
  void adjoint_of_surface(int64_t i, const HeatLayersBackwardArguments<T, D>& layers, const Tensor& obstacles);
  void adjoint_of_nodes(const HeatSolution<T, D>& solution, bool by_dt);
  void gather(const HeatToNodesArguments<T, D>& down, bool by_dt);
  HeatToNodesBackwardArguments<T, D> to_nodes(int64_t i, const HeatToNodesArguments<T, D>& down,
                                              const HeatAdjoints& adjoints) const;
  void position_gradient(const HeatToNodesArguments<T, D>& down);
  void position_gradient_of_boundaries(const HeatToNodesArguments<T, D>& down);

  Recorded<T, D>& record_;
  const SubstepsInputs& in_;
  backend::Stream stream_;
  Tensor value_, moment_, blend_, rate_of_particles_;  // [P, kHeatForms], [P, kHeatForms, D], [P], [P, 1]
  int64_t nodes_ = -1;
  Tensor zero_;  // nodes of several steps, cleared at once [cleared_steps_, kZero, N]
  int64_t cleared_steps_ = 1, first_cleared_ = 0;
  // Parts of the present step: adjoints of the nodes, H λ, and products of the solve.
  T *adjoints_ = nullptr, *product_ = nullptr, *products_ = nullptr;
  Tensor source_, multiplier_, by_sums_, solved_, rate_;
  Tensor slot_sums_, counted_;  // of the numbers of the boundary, by slots; nodes that are held
  // Adjoints of the sums of the free surface, and of θ by the terms; [P, 1 + D], [P, 1 + D, D].
  Tensor surface_, by_terms_, surface_value_, surface_gradient_;
  // Of a held surface: adjoint of the exchange of the nodes, and gathered [P, 1]; of κ V [P], of x [P, D], and of the
  // distance [P]; of the row of its obstacle, by slots.
  Tensor layer_, layer_exchange_, layer_of_particles_, by_conductance_, x_layer_, by_distance_, row_sums_;
  Tensor no_bound_;  // [B], bounds of zero, for `multiply`
  Tensor iterations_, residual_, converged_, workspace_;
};

template <class T, int D>
HeatBackward<T, D>::HeatBackward(Recorded<T, D>& record, const SubstepsInputs& in, backend::Stream stream)
    : record_(record), in_(in), stream_(stream) {
  const Tensor& x = in.x;
  const int64_t P = x.size(0);
  x_term = empty_particles(x, {P, D});
  F_term = result(x, has(in.F), {P, D, D});
  J_term = result(x, has(in.J), {P});
  value_ = empty_particles(x, {P, kHeatForms});
  moment_ = empty_particles(x, {P, kHeatForms, D});
  torch::stable::zero_(value_);  // some forms have no values, and some no moments
  torch::stable::zero_(moment_);
  blend_ = empty(x, {P});
  dissipated = result(x, heat().heats_by_laws(), {P});
  layer_of_particles_ = result(x, heat().holds_surface(), {P, 1});
  by_conductance_ = result(x, heat().holds_surface(), {P});
  x_layer_ = result(x, heat().holds_surface(), {P, D});
  surface_value_ = result(x, heat().has_terms(), {P, 1 + D});
  surface_gradient_ = result(x, heat().has_terms(), {P, 1 + D, D});
  no_bound_ = empty(x, {in.scenes}, ScalarType::Double);
  torch::stable::zero_(no_bound_);
  iterations_ = empty_int(x, {in.scenes});
  residual_ = empty(x, {in.scenes});
  converged_ = empty(x, {in.scenes}, ScalarType::Bool);
}

template <class T, int D>
void HeatBackward<T, D>::make_nodes(const HeatSolution<T, D>& solution) {
  const int64_t nodes = int64_t(solution.system.topology.max_blocks) * kBlockNodes<D>;
  if (nodes == nodes_) return;
  nodes_ = nodes;
  cleared_steps_ = kOnCuda ? cleared_at_once(kZero * nodes * int64_t(sizeof(T)), in_.n) : 1;
  zero_ = empty(in_.x, {cleared_steps_, kZero, nodes});
  first_cleared_ = in_.n;
  for (Tensor* t : {&multiplier_, &rate_}) *t = empty(in_.x, {nodes});
  if (!kOnCuda) source_ = empty(in_.x, {nodes});
  by_sums_ = empty(in_.x, {nodes, kHeatChannels});
  solved_ = empty(in_.x, {nodes, kHeatSolved});
  if (heat().holds_surface()) layer_ = empty(in_.x, {nodes});
  if (heat().has_terms()) surface_ = empty(in_.x, {nodes, kHeatChannels}), by_terms_ = empty(in_.x, {nodes});
  workspace_ = Tensor();
}

// Steps are processed from the last one to the first.
template <class T, int D>
void HeatBackward<T, D>::use_cleared(int64_t i) {
  if (i < first_cleared_) {
    backend::clear(zero_, stream_);
    first_cleared_ = i + 1 - cleared_steps_;
  }
  adjoints_ = rows(zero_) + (i - first_cleared_) * kZero * nodes_;
  product_ = adjoints_ + kHeatSolved * nodes_;
  products_ = product_ + nodes_;
}

template <class T, int D>
HeatToParticlesBackwardArguments<T, D> HeatBackward<T, D>::to_particles(const HeatSolution<T, D>& solution,
                                                                        const HeatAdjoints& adjoints) {
  HeatToParticlesBackwardArguments<T, D> a;
  a.forward = heat().to_particles(solution.down, true);
  a.theta = HeatSteps<T, D>::column_of(adjoints.state, 0);
  a.gradient = HeatSteps<T, D>::column_of(adjoints.state, heat().gradient_column());
  a.liquid = HeatSteps<T, D>::column_of(adjoints.state, heat().liquid_column());
  a.value = field<T>(value_);
  a.moment = field<T>(moment_);
  a.blend = field<T>(blend_);
  a.velocity_gradient = field<T>(adjoints.velocity_gradient);
  a.parameters = field<T>(adjoints.parameters);
  a.dt = field<T>(adjoints.dt);
  return a;
}

// Adjoints of the increments and of θ̄. On CUDA four channels are one pass, two of them unused, and the solve reads the
// adjoints in place.
template <class T, int D>
void HeatBackward<T, D>::scatter(const HeatToParticlesBackwardArguments<T, D>& up) {
  ScatterArguments<T, D> a;
  a.topology = up.forward.topology;
  a.x = up.forward.x;
  a.value = constant(forms(value_, kHeatIncrement));
  if (up.gradient.pointer) a.moment = constant(forms(moment_, kHeatIncrement));
  a.deterministic = in_.lattice.deterministic();
  a.nodes = {adjoints_, kHeatSolved, kOnCuda ? kHeatSolved : 2};
  backend::scatter(order(), a, stream_);
  if (kOnCuda) return;
  torch::stable::copy_(
      source_, torch::stable::from_blob(adjoints_ + kIncrementAdjoint, Shape{nodes_}, Shape{int64_t(kHeatSolved)},
                                        in_.x.device(), in_.x.scalar_type()));
}

// λ of A λ = adjoint of the increment.
template <class T, int D>
void HeatBackward<T, D>::solve(HeatArguments<T, D> system, const Tensor& status) {
  system.theta = nullptr;
  system.source = kOnCuda ? adjoints_ + kIncrementAdjoint : rows(source_);
  system.source_stride = kOnCuda ? kHeatSolved : 1;
  system.tolerance = 0;
  system.relative_tolerance = in_.heat_scalars[3];
  system.increment = rows(multiplier_);
  system.iterations = static_cast<int*>(iterations_.data_ptr());
  system.residual = rows(residual_);
  system.converged = static_cast<bool*>(converged_.data_ptr());
  if (!workspace_.defined()) workspace_ = empty(in_.x, {backend::heat_workspace(system, stream_)}, ScalarType::Byte);
  system.workspace = workspace_.data_ptr();
  HeatFinishArguments<T, D> finish;
  finish.simple.solve = system;
  finish.simple.workspace = packed();
  for (int k = 0; k < kMostSimpleSteps; k++) finish.simple.product[k] = products_ + k * nodes_;
  finish.increment = system.increment;
  finish.status = static_cast<double*>(status.data_ptr());
  solve_simply(order(), finish, stream_);
}

// H λ: the first product of the simple steps, with λ in place of θ. With a bound of zero every scene takes that step.
// The particles are those that `solve` has packed.
template <class T, int D>
void HeatBackward<T, D>::multiply(HeatArguments<T, D> system) {
  system.theta = rows(multiplier_);
  system.sums = nullptr;
  system.scene_bound = static_cast<const double*>(no_bound_.data_ptr());
  system.workspace = workspace_.data_ptr();
  HeatSimpleArguments<T, D> a;
  a.solve = system;
  a.workspace = packed();
  a.packed = true;
  a.product[0] = product_;
  backend::heat_simple_step(order(), a, stream_);
}

template <class T, int D>
HeatTermBackwardArguments<T, D> HeatBackward<T, D>::term_backward(const HeatSolution<T, D>& solution,
                                                                  const HeatTermArguments<T, D>& term) const {
  return {term, solution.down.sums.pointer, rows(multiplier_), rows(surface_), rows(by_terms_)};
}

template <class T, int D>
void HeatBackward<T, D>::adjoint_of_terms(const HeatSolution<T, D>& solution) {
  backend::clear(surface_, stream_);
  backend::clear(by_terms_, stream_);
  for (const HeatTermArguments<T, D>& term : heat().terms())
    backend::heat_term_backward(term_backward(solution, term), stream_);
}

// Adds the adjoints of the numbers of the boundary to their sums.
template <class T, int D>
void HeatBackward<T, D>::adjoint_of_boundaries(const HeatSolution<T, D>& solution, const Tensor& sums) {
  const Topology<T, D>& t = solution.system.topology;
  const int columns = int(sums.size(1));
  slot_sums_ = empty(in_.x, {int64_t(t.max_blocks), columns});
  backend::clear(slot_sums_, stream_);
  HeatSlotSums<T> to{rows(slot_sums_), columns, 0};
  if (heat().has_terms())
    for (const HeatTermArguments<T, D>& term : heat().terms()) {
      if (term.term == HeatTerm::power) continue;
      backend::heat_numbers_backward(HeatNumbersBackwardArguments<T, D>{term_backward(solution, term), to}, stream_);
      to.first += 2;
    }
  if (heat().held_nodes() > 0) {
    counted_ = empty(in_.x, {nodes_}, ScalarType::Bool);
    backend::clear(counted_, stream_);
  }
  for (int64_t k = 0; k < heat().held_nodes(); k++, to.first++)
    backend::heat_held_backward(
        HeatHeldBackwardArguments<T, D>{heat().hold(k, solution.system.heat_capacity), adjoints_, product_,
                                        static_cast<bool*>(counted_.data_ptr()), to},
        stream_);
  if (heat().holds_surface()) adjoint_of_surface_temperature(solution, to);
  backend::sum_slots(SumSlotsArguments<T, D>{{t.max_blocks, t.geometry.blocks_per_scene, t.block, int(in_.scenes),
                                              columns, in_.scenes > 1, rows(slot_sums_), rows(sums), columns}},
                     stream_);
}

template <class T, int D>
void HeatBackward<T, D>::adjoint_of_surface_temperature(const HeatSolution<T, D>& solution, const HeatSlotSums<T>& to) {
  layer_exchange_ = empty(in_.x, {nodes_});
  backend::clear(layer_exchange_, stream_);
  ScatterArguments<T, D> a;
  a.topology = solution.down.topology;
  a.x = solution.down.x;
  a.value = constant(heat().exchange_of_particles());
  a.deterministic = in_.lattice.deterministic();
  a.nodes = {rows(layer_exchange_), 1, 1};
  backend::scatter(order(), a, stream_);
  backend::heat_surface_temperature_backward(
      HeatSurfaceTemperatureBackwardArguments<T, D>{a.topology, rows(multiplier_), rows(layer_exchange_), to}, stream_);
}

template <class T, int D>
void HeatBackward<T, D>::adjoint_of_nodes(const HeatSolution<T, D>& solution, bool by_dt) {
  HeatNodesBackwardArguments<T, D> a;
  a.topology = solution.system.topology;
  a.sums = solution.down.sums.pointer;
  a.theta = solution.theta;
  a.multiplier = rows(multiplier_);
  a.product = product_;
  a.adjoints = adjoints_;
  a.exchange = solution.system.exchange;
  if (heat().has_terms()) a.by_terms = rows(by_terms_);
  a.fixed = solution.system.fixed;
  if (heat().holds_surface()) {
    const HeatFromSurfaceArguments<T, D> held = heat().from_surface();
    a.temperature = held.temperature;
    a.stride = held.stride;
    a.layer = rows(layer_);
  }
  a.scene_dt = solution.down.scene_dt;
  a.dt = solution.down.dt;
  a.by_sums = rows(by_sums_);
  a.solved = rows(solved_);
  if (by_dt) a.rate = rows(rate_);
  backend::heat_nodes_backward(a, stream_);
}

// ∇(θ + d) and ∇λ at the particles, the adjoints of their shares of the free surface, and the mean of λ d/dt² for the
// adjoint of dt.
template <class T, int D>
void HeatBackward<T, D>::gather(const HeatToNodesArguments<T, D>& down, bool by_dt) {
  GatherArguments<T, D> a;
  a.topology = down.topology;
  a.x = down.x;
  if (!kOnCuda || heat().holds_surface()) {
    a.nodes = {rows(solved_) + (int(kHeatAfter) - int(kHeatChannels)), kHeatSolved, 2};
    a.moment_scale = in_.lattice.inverse_inertia();
    a.moment = forms(moment_, kHeatAfter);
    backend::gather(order(), a, stream_);
    a.moment = {};
  }
  if (heat().has_terms()) {
    a.nodes = {rows(surface_), kHeatChannels, 1 + D};
    a.value = field<T>(surface_value_);
    a.gradient = field<T>(surface_gradient_);
    backend::gather(order(), a, stream_);
    a.gradient = {};
  }
  if (!by_dt) return;
  if (!rate_of_particles_.defined()) rate_of_particles_ = empty_particles(in_.x, {in_.x.size(0), 1});
  a.nodes = {rows(rate_), 1, 1};
  a.value = field<T>(rate_of_particles_);
  backend::gather(order(), a, stream_);
}

template <class T, int D>
HeatToNodesBackwardArguments<T, D> HeatBackward<T, D>::to_nodes(int64_t i, const HeatToNodesArguments<T, D>& down,
                                                                const HeatAdjoints& adjoints) const {
  const Particles<const T> before = record_.state(i);
  HeatToNodesBackwardArguments<T, D> a;
  a.forward = down;
  a.rest = record_.steps.p2g.volume;
  a.F = before.F;
  a.J = before.J;
  a.nodes = {rows(by_sums_), kHeatChannels, kHeatChannels};
  a.solved = {rows(solved_), kHeatSolved, kHeatSolved};
  a.x_term = field<T>(x_term);
  a.blend = field<const T>(blend_);
  if (adjoints.dt.defined()) a.rate = constant(HeatSteps<T, D>::column_of(rate_of_particles_, 0));
  a.inverse_inertia = in_.lattice.inverse_inertia();
  if (heat().has_terms()) a.surface = heat().surface(before.x, a.rest);
  a.conductance = field<const T>(by_conductance_);
  a.surface_value = field<T>(surface_value_);
  a.surface_gradient = field<T>(surface_gradient_);
  a.dissipated = field<T>(dissipated);
  a.value = field<T>(value_);
  a.moment = field<T>(moment_);
  a.theta = HeatSteps<T, D>::column_of(adjoints.state, 0);
  a.gradient = HeatSteps<T, D>::column_of(adjoints.state, heat().gradient_column());
  a.velocity_gradient = field<T>(adjoints.velocity_gradient);
  a.mass = field<T>(adjoints.mass);
  a.volume = field<T>(adjoints.volume);
  a.parameters = field<T>(adjoints.parameters);
  a.dt = field<T>(adjoints.dt);
  a.F_term = field<T>(F_term);
  a.J_term = field<T>(J_term);
  return a;
}

// Particles around the held surface: their exchange at the nodes, the rest of their conductance and their distance.
template <class T, int D>
void HeatBackward<T, D>::adjoint_of_layers(int64_t i, const HeatToNodesArguments<T, D>& down, const Tensor& obstacles) {
  GatherArguments<T, D> gather;
  gather.topology = down.topology;
  gather.x = down.x;
  gather.nodes = {rows(layer_), 1, 1};
  gather.value = field<T>(layer_of_particles_);
  backend::gather(order(), gather, stream_);
  HeatLayersBackwardArguments<T, D> a;
  a.down = down;
  a.layers = heat().layers(down.x, record_.scene_of_particles());
  a.exchange = constant(HeatSteps<T, D>::column_of(layer_of_particles_, 0));
  a.moment = field<const T>(moment_);
  a.conductance = field<T>(by_conductance_);
  a.x = field<T>(x_layer_);
  if (obstacles.defined() && !by_distance_.defined()) by_distance_ = empty(in_.x, {in_.x.size(0)});
  a.distance = field<T>(by_distance_);
  backend::heat_layers_backward(a, stream_);
  if (obstacles.defined()) adjoint_of_surface(i, a, obstacles);
}

// Adds the adjoint of the obstacle of the held surface.
template <class T, int D>
void HeatBackward<T, D>::adjoint_of_surface(int64_t i, const HeatLayersBackwardArguments<T, D>& layers,
                                            const Tensor& obstacles) {
  constexpr int width = ObstacleRow<T, D>::width;
  const Topology<T, D>& t = layers.down.topology;
  const ContactArguments<T, D>& contact = layers.layers.contact;
  if (!row_sums_.defined() || row_sums_.size(0) != t.max_blocks)
    row_sums_ = empty(in_.x, {int64_t(t.max_blocks), width});
  backend::clear(row_sums_, stream_);
  backend::heat_surface_row_backward(
      HeatSurfaceRowBackwardArguments<T, D>{t, layers.layers, constant(layers.distance), rows(row_sums_)}, stream_);
  const int64_t row = i * contact.step_stride + layers.layers.obstacle;
  backend::sum_slots(SumSlotsArguments<T, D>{{t.max_blocks, t.geometry.blocks_per_scene, t.block, contact.rows, width,
                                              contact.rows > 1, rows(row_sums_), rows(obstacles) + row * width,
                                              int64_t(contact.obstacles) * width}},
                     stream_);
}

// Of the forms of P2G, and of those of G2P and of the solve.
template <class T, int D>
void HeatBackward<T, D>::position_gradient(const HeatToNodesArguments<T, D>& down) {
  PositionGradientArguments<T, D> a;
  a.topology = down.topology;
  a.x = down.x;
  a.value = field<const T>(value_);
  a.moment = field<const T>(moment_);
  a.nodes = {rows(by_sums_), kHeatChannels, kHeatChannels};
  a.position_gradient = field<T>(x_term);
  backend::position_gradient(order(), a, stream_);
  a.adds = true;
  a.value = constant(forms(value_, kHeatIncrement));
  a.moment = constant(forms(moment_, kHeatIncrement));
  a.nodes = {rows(solved_), kHeatSolved, kHeatSolved};
  backend::position_gradient(order(), a, stream_);
}

// Adds that of the exchange of a held surface, and of the forms of the free surface.
template <class T, int D>
void HeatBackward<T, D>::position_gradient_of_boundaries(const HeatToNodesArguments<T, D>& down) {
  PositionGradientArguments<T, D> a;
  a.topology = down.topology;
  a.x = down.x;
  a.position_gradient = field<T>(x_term);
  a.adds = true;
  if (heat().holds_surface()) {
    a.value = constant(heat().exchange_of_particles());
    a.nodes = {rows(layer_), 1, 1};
    backend::position_gradient(order(), a, stream_);
    const Field<T> sum = field<T>(x_term);
    backend::add_scaled(AddScaledArguments<T, D>{in_.x.size(0), sum, constant(sum), field<const T>(x_layer_), 1},
                        stream_);
  }
  if (!heat().has_terms()) return;
  a.value = field<const T>(surface_value_);
  a.gradient = field<const T>(surface_gradient_);
  a.nodes = {rows(surface_), kHeatChannels, 1 + D};
  backend::position_gradient(order(), a, stream_);
}

}  // namespace mpm
