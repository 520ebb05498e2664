#pragma once

#include <algorithm>
#include <iterator>
#include <optional>

#include "heat/kernels.h"
#include "rollout/arena.h"
#include "rollout/own_field.h"
#include "rollout/step_kernels.h"

// Conduction of heat in the substeps of a call, in the order of torch_mpm/heat/heat.py: present volumes before the
// laws; after G2P, with the positions before it: sums on the nodes, the solve, and the temperature of the particles.
namespace mpm {

// The node temperatures of a step: the transfer to the nodes, the system, and the results of its solve.
template <class T, int D>
struct HeatSolution {
  HeatToNodesArguments<T, D> down;
  HeatArguments<T, D> system;
  const T* theta;  // averages of the nodes [N]; null where the solve reads their sums
};

// Memory of a step at the nodes; absent parts are null.
template <class T>
struct HeatNodeMemory {
  // Zero when the step begins: the largest diffusion number of a particle in each scene; the sums of the nodes, their
  // exchange and source, the sums of the surface, and the products of the simple steps. On the CPU also: slots to which
  // particles are transferred.
  double* largest = nullptr;
  T *sums = nullptr, *exchange = nullptr, *source = nullptr, *surface = nullptr;
  T* product[kMostSimpleSteps] = {};
  bool* matter = nullptr;
  // Averages of the temperature, heat capacities, increments of the solve, and where nodes may be held the temperatures
  // before these increments, and whether nodes are held.
  T *theta = nullptr, *capacity = nullptr, *increment = nullptr, *start = nullptr;
  bool* fixed = nullptr;
};

// Solves by simple steps where these suffice, and the other scenes by conjugate gradients.
template <class T, int D>
void solve_simply(int64_t order, HeatFinishArguments<T, D>& a, backend::Stream stream) {
  HeatSimpleArguments<T, D>& simple = a.simple;
  simple.solve.leaves_simple = true;
  for (simple.step = has_theta(simple.solve) ? 0 : 1; simple.step < kMostSimpleSteps; simple.step++) {
    backend::heat_simple_step(order, simple, stream);
    simple.packed = true;
  }
  backend::heat_cg(order, simple.solve, stream);
  backend::heat_finish(a, stream);
}

template <class T, int D>
class HeatSteps {
 public:
  OwnField<T> fields;                   // [P, m]: temperature, gradient, liquid fraction, present volume
  std::vector<OwnField<T>> parameters;  // those with a value per particle
  Tensor status;                        // [B, kHeatStatusSize], float64

  static bool wanted(const SubstepsInputs& in) { return !in.heat.empty(); }
  // Of the liquid fraction in the fields, or -1.
  int liquid_column() const { return liquid_; }
  // Of the energy that laws dissipate in the fields, or -1 where none becomes heat.
  int dissipated_column() const { return dissipated_; }

  explicit HeatSteps(Substeps<T, D>& steps);

  Field<const T> temperature() const { return column(fields.now(), 0); }
  Field<const T> liquid_fraction() const { return column(fields.now(), liquid_); }
  // Whether energy that laws dissipate becomes heat, and where they store it.
  bool heats_by_laws() const { return dissipated_ >= 0; }
  Field<T> dissipated() { return column(fields.next(false), dissipated_); }

  // Steps leave nothing for an adjoint: neither increments nor averages of the nodes.
  void leave_no_record() { for_record_ = false; }

  // Lets the next step read fields of a record, and write others.
  void use_fields(const Tensor& before, const Tensor& after) { fields.use(before, after); }
  // Lets the next step use memory of a record: at the nodes, and of the transfer to them at the particles
  // [P, transfer_columns()]. Without memory it uses that of the call.
  void use_memory(const HeatNodeMemory<T>& nodes, const Tensor& of_transfer) {
    nodes_ = nodes;
    of_transfer_ = of_transfer;
    is_recorded_ = true;
  }
  void use_own_memory() {
    if (is_recorded_) of_transfer_ = absent();
    is_recorded_ = false;
  }
  // Lays out the memory of a step at the nodes of a pool: what is zero when the step begins, and the rest.
  HeatNodeMemory<T> lay_out(int64_t slots, Arena& zero, Arena& rest) const;
  int transfer_columns() const { return kNumber + melts() + holds_surface(); }
  int columns_of_fields() const { return columns_; }

  // Whether begin() is needed: the present volumes are not stored yet, or laws store what they dissipate.
  bool begins() const { return !has_volumes_ || heats_by_laws(); }

  // Computes the present volumes; before laws change F.
  void begin(const Field<const T>& F, const Field<const T>& J, const Field<const T>& rest, backend::Stream stream) {
    HeatVolumesArguments<T, D> a = volumes_of(F, J, rest, fields.next(false));
    a.dissipated = dissipated();
    backend::heat_volumes(a, stream);
  }

  // Lets the transfer to the particles compute the volumes for the next substep, from F and J after this one; on CUDA.
  // G2P computes them where it is joined, and begin() where laws heat the particles.
  void store_volumes(const Field<const T>& F, const Field<const T>& J, const Field<const T>& rest) {
    if (s_.with_heat.to_nodes.sums.pointer || heats_by_laws()) return;
    volumes_after_ = volumes_of(F, J, rest, fields.next(true));
    has_volumes_ = true;
  }

  // Lets G2P of the substep compute P2G of heat, and the volumes for the next substep unless P2G or laws do; on CUDA.
  // Sums on deterministic grids have an order, and FLIP a G2P of its own.
  void join_g2p(const Field<const T>& x, const Field<const T>& mass, const Field<const T>& velocity_gradient,
                backend::Stream stream) {
    const bool is_cpu = MPM_BACKEND == MPM_BACKEND_IS_cpu;
    if (!kAdvancesHeat<T, D> || is_cpu || s_.flips() || in_.lattice.deterministic()) return;
    HeatAdvanceArguments<T, D>& a = s_.with_heat;
    a.to_nodes = begin_nodes(x, mass, velocity_gradient, stream);
    a.rest = s_.p2g.volume;
    a.volume_next = column(fields.next(true), volume_);
    a.workspace = packs_in_g2p() ? workspace(stream) : nullptr;
    has_volumes_ = true;
  }

  // Computes the temperatures after a substep, with positions before it and the velocity gradient after it.
  void run(const Field<const T>& x, const Field<const T>& mass, const Field<const T>& rest,
           const Field<const T>& velocity_gradient, const Field<const int>& scene, backend::Stream stream) {
    const HeatSolution<T, D> solution = conduct(x, mass, rest, velocity_gradient, scene, stream);
    HeatToParticlesArguments<T, D> up = to_particles(solution.down, true);
    up.volumes = volumes_after_;
    backend::heat_to_particles(in_.lattice.order(), up, stream);
    fields.go(true);
  }

  // The part of a substep up to the node temperatures.
  HeatSolution<T, D> conduct(const Field<const T>& x, const Field<const T>& mass, const Field<const T>& rest,
                             const Field<const T>& velocity_gradient, const Field<const int>& scene,
                             backend::Stream stream) {
    HeatToNodesArguments<T, D> down = s_.with_heat.to_nodes;
    if (!down.sums.pointer) {
      down = begin_nodes(x, mass, velocity_gradient, stream);
      backend::heat_to_nodes(in_.lattice.order(), down, stream);
    }
    return conduct(down, rest, scene, stream);
  }

  // The transfer to the nodes, whose sums are zero.
  HeatToNodesArguments<T, D> begin_nodes(const Field<const T>& x, const Field<const T>& mass,
                                         const Field<const T>& velocity_gradient, backend::Stream stream) {
    make_nodes(stream);
    return to_nodes(x, mass, velocity_gradient);
  }
  // That part after the transfer to the nodes.
  HeatSolution<T, D> conduct(const HeatToNodesArguments<T, D>& down, const Field<const T>& rest,
                             const Field<const int>& scene, backend::Stream stream) {
    const Field<const T>& x = down.x;
    sum_boundaries(x, rest, scene, stream);
    HeatFinishArguments<T, D> finish;
    finish.simple.solve = equations(x);
    finish.simple.solve.workspace = workspace(stream);
    finish.simple.packed = s_.with_heat.workspace != nullptr;
    if (!solves_for_sums()) average(finish.simple, stream);
    for (int64_t k = 0; k < held_nodes(); k++) backend::heat_hold(hold(k, nodes_.capacity), stream);
    solve(finish, stream);
    return {down, finish.simple.solve, nodes_.theta};
  }
  // The same of a step whose memory has the results.
  HeatSolution<T, D> solution(const Field<const T>& x, const Field<const T>& mass,
                              const Field<const T>& velocity_gradient) {
    return {to_nodes(x, mass, velocity_gradient), equations(x), nodes_.theta};
  }

  // Work space of the solves of the steps.
  void* workspace(backend::Stream stream);

  // The transfer of these temperatures to the particles, to the other buffer of the fields or in place.
  HeatToParticlesArguments<T, D> to_particles(const HeatToNodesArguments<T, D>& down, bool elsewhere);

  // Whether particles may leave their base blocks while an activation lasts, on the CPU: not where sums over them other
  // than those of `conduct` are needed.
  static bool may_last(const SubstepsInputs& in) {
    return in.heat_terms.empty() && in.heat_options[2] == 0 && in.heat_scalars[2] == 0 &&
           (in.heat_boundaries.empty() || in.heat_boundaries[kPower].numel() == 0);
  }

  // Where the present volumes are stored.
  Field<T> volumes() { return column(fields.next(false), volume_); }

  // The first columns of the fields, which a call returns and a step reads.
  int state_columns() const { return volume_; }
  Tensor state() const {
    Tensor all = fields.tensor();
    return torch::stable::narrow(all, 1, 0, volume_);
  }
  bool melts() const { return liquid_ >= 0; }
  // The columns of a tensor in the order of the fields.
  static Field<T> column_of(const Tensor& t, int first) { return column(field<T>(t), first); }
  int gradient_column() const { return gradient_; }

  // The terms of the free surface, and heat from inside the matter; and what they read of the particles.
  bool has_terms() const { return !in_.heat_terms.empty() || has_power() || heats_by_laws(); }
  std::vector<HeatTermArguments<T, D>> terms() const;
  HeatSurfaceArguments<T, D> surface(const Field<const T>& x, const Field<const T>& rest) const;

  // The last of the held obstacles is held at its surface, the others at the nodes in them.
  bool holds_surface() const { return in_.heat_options[2] != 0; }
  int64_t held_nodes() const { return int64_t(in_.held_obstacles.size()) - holds_surface(); }
  HeatHoldArguments<T, D> hold(int64_t k, const T* capacity) const;
  HeatLayersArguments<T, D> layers(const Field<const T>& x, const Field<const int>& scene) const;
  HeatFromSurfaceArguments<T, D> from_surface() const;
  Field<T> exchange_of_particles() const { return holds_surface() ? transfer_column(kNumber + melts()) : Field<T>{}; }

 private:
  int64_t particles() const { return in_.x.size(0); }
  // Tensors of the boundaries: held temperatures, numbers of the terms, power of the source; absent ones are empty.
  enum Boundaries : size_t { kHeld, kNumbers, kPower, kBoundaries };
  bool given(Boundaries k) const { return !in_.heat_boundaries.empty() && in_.heat_boundaries[k].numel() > 0; }
  bool has_power() const { return given(kPower); }
  // The gradient is the last tensor of `heat`.
  bool has_gradient() const { return in_.heat.size() % 3 == 1; }
  bool exchanges() const { return holds_surface() || has_terms(); }
  // Whether the solve reads the sums of the nodes. Boundaries and the adjoint need averages in arrays.
  bool solves_for_sums() const { return !for_record_ && !exchanges() && held_nodes() == 0; }
  // Whether G2P packs the particles for the simple steps; a held surface changes their conductance after it.
  bool packs_in_g2p() const { return !holds_surface(); }
  // Columns of what the transfer to the nodes stores at the particles: the diffusion number where particles melt, and
  // then their exchange with a held surface.
  enum TransferColumn : int { kConductance, kBlend, kNumber };
  Field<T> transfer_column(int k) const { return column(field<T>(of_transfer_), k); }
  double* rows_of_status() const { return static_cast<double*>(status.data_ptr()); }
  const T* held_temperature(int64_t k) const { return temperatures_.pointer + k * temperatures_.stride[0]; }

  template <class E>
  static Field<E> column(const Field<E>& f, int first) {
    return first < 0 ? Field<E>{} : Field<E>{f.pointer + first * f.stride[1], {f.stride[0], f.stride[1], 0}};
  }
  HeatParticles<T> columns() const {
    const Field<const T>& f = fields.now();
    return {column(f, 0), column(f, gradient_), column(f, liquid_), column(f, volume_)};
  }

  HeatVolumesArguments<T, D> volumes_of(const Field<const T>& F, const Field<const T>& J, const Field<const T>& rest,
                                        const Field<T>& to) const {
    return {particles(), rest, F, J, column(to, volume_), {}};
  }

  void pack();
  void check_held();
  void check_terms();
  HeatNodesArguments<T, D> nodes() const;
  HeatCleared<T> next_cleared() const;
  void sum_boundaries(const Field<const T>& x, const Field<const T>& rest, const Field<const int>& scene,
                      backend::Stream stream);
  HeatExchangeArguments<T, D> exchange(const Field<const T>& x, const Field<const int>& scene) const;
  void add_layers(const Field<const T>& x, const Field<const int>& scene, backend::Stream stream);
  void average(HeatSimpleArguments<T, D>& simple, backend::Stream stream);
  void read_parameter(const Tensor& t, const char* name);
  HeatValue<T> value(size_t k) const;
  // Slots with nodes in use. On the CPU those with a block are first, where the activation counts them.
  int64_t used_slots() const { return s_.activation.used_slots ? s_.used_slots : s_.activation.slots(); }
  void make_nodes(backend::Stream stream);
  void make_own_nodes(backend::Stream stream);
  HeatToNodesArguments<T, D> to_nodes(const Field<const T>& x, const Field<const T>& mass,
                                      const Field<const T>& velocity_gradient) const;
  HeatArguments<T, D> equations(const Field<const T>& x) const;
  void solve(HeatFinishArguments<T, D>& finish, backend::Stream stream);

  Substeps<T, D>& s_;
  const SubstepsInputs& in_;
  int gradient_ = -1, liquid_ = -1, volume_ = 1, dissipated_ = -1, columns_ = 0;  // columns, and their number
  std::vector<HeatValue<T>> values_;  // of the parameters; those per particle have no pointer
  std::vector<int> own_;              // index in `parameters`, or -1
  Tensor of_transfer_ = absent();     // [P, transfer_columns()]
  bool has_volumes_ = false, for_record_ = true, is_recorded_ = false;
  HeatVolumesArguments<T, D> volumes_after_;
  Field<const T> temperatures_;  // of the held obstacles [K, B]
  size_t power_ = 0;             // its number among the parameters
  HeatNodeMemory<T> nodes_;
  // Memory of the call; what is zero when a substep begins is used in turn.
  int64_t slots_ = -1;
  static constexpr int kTurns = MPM_BACKEND == MPM_BACKEND_IS_cuda ? 2 : 1;
  Tensor zero_[kTurns], rest_;
  int turn_ = 0;
  Tensor iterations_, residual_, converged_, workspace_;
};

template <class T, int D>
HeatSteps<T, D>::HeatSteps(Substeps<T, D>& steps) : s_(steps), in_(steps.in) {
  const Tensor& x = in_.x;
  const size_t tensors = in_.heat.size() - has_gradient();
  STD_TORCH_CHECK(tensors == 3 || tensors == 6, "heat must be 3 or 6 tensors, and the gradient, got ", in_.heat.size());
  STD_TORCH_CHECK(in_.heat_options.size() == 3, "heat_options must have 3 entries, got ", in_.heat_options.size());
  STD_TORCH_CHECK(in_.heat_scalars.size() == 4, "heat_scalars must have 4 entries, got ", in_.heat_scalars.size());
  STD_TORCH_CHECK(in_.heat_scalars[2] >= 0 && in_.heat_scalars[2] <= 1,
                  "heat_scalars[2], the share of plastic heating, must be 0 to 1, got ", in_.heat_scalars[2]);
  STD_TORCH_CHECK(in_.heat_boundaries.empty() || in_.heat_boundaries.size() == kBoundaries,
                  "heat_boundaries must be empty or 3 tensors, got ", in_.heat_boundaries.size());
  STD_TORCH_CHECK(in_.heat_options[0] >= 0 && in_.heat_options[0] <= int64_t(HeatTransfer::pic),
                  "heat_options[0], the transfer of heat, must be 0 to 3, got ", in_.heat_options[0]);
  STD_TORCH_CHECK(in_.heat_options[1] > 0 && in_.heat_options[1] <= INT32_MAX,
                  "heat_options[1], the number of iterations, must be positive, got ", in_.heat_options[1]);
  for (const size_t k : {0, 3})
    STD_TORCH_CHECK(in_.heat_scalars[k] > 0 && in_.heat_scalars[k] < 1, element("heat_scalars", int(k)), ", the ",
                    k == 0 ? "" : "adjoint ", "tolerance, must be between 0 and 1, got ", in_.heat_scalars[k]);
  STD_TORCH_CHECK(in_.wants_C, "heat needs wants_C");
  STD_TORCH_CHECK(s_.p2g.form == StressForm::mls, "heat needs the stress form mls");
  pack();
  check_held();
  check_terms();
  for (const size_t k : {1, 2, 4, 5})
    if (k < tensors) read_parameter(in_.heat[k], element("heat", int(k)).c_str());
  power_ = values_.size();
  if (has_power()) read_parameter(in_.heat_boundaries[kPower], "the power of heat");
  status = empty(x, {in_.scenes, int64_t(kHeatStatusSize)}, ScalarType::Double);
  torch::stable::zero_(status);
  iterations_ = empty_int(x, {in_.scenes});
  residual_ = empty(x, {in_.scenes});
  converged_ = empty(x, {in_.scenes}, ScalarType::Bool);
}

template <class T, int D>
void HeatSteps<T, D>::pack() {
  const Tensor& x = in_.x;
  const int64_t P = x.size(0);
  int columns = 1;
  if (has_gradient()) gradient_ = columns, columns += D;
  if (in_.heat.size() >= 6) liquid_ = columns++;
  volume_ = columns++;
  if (in_.heat_scalars[2] > 0) dissipated_ = columns++;
  columns_ = columns;
  Tensor packed = empty_particles(x, {P, columns});
  torch::stable::zero_(packed);
  const auto put = [&](const Tensor& t, const char* name, int first, int width) {
    check_shape(t, name, width == 1 ? Shape{P} : Shape{P, width});
    check_like(t, name, x);
    Tensor part = torch::stable::narrow(packed, 1, first, width);
    torch::stable::copy_(part, torch::stable::reshape(t, {P, width}));
  };
  put(in_.heat[0], "heat[0]", 0, 1);
  if (gradient_ >= 0) put(in_.heat.back(), "the temperature gradient", gradient_, D);
  if (melts()) put(in_.heat[3], "heat[3]", liquid_, 1);
  fields = OwnField<T>(packed);
}

template <class T, int D>
void HeatSteps<T, D>::check_held() {
  const int64_t count = int64_t(in_.held_obstacles.size());
  STD_TORCH_CHECK(given(kHeld) == (count > 0), "held_obstacles needs temperatures in heat_boundaries");
  STD_TORCH_CHECK(count > 0 || !holds_surface(), "a held surface needs held_obstacles");
  if (count == 0) return;
  for (const int64_t k : in_.held_obstacles)
    STD_TORCH_CHECK(k >= 0 && k < s_.contact.obstacles, "held_obstacles must be 0 to ", s_.contact.obstacles - 1,
                    ", got ", k);
  check_shape(in_.heat_boundaries[kHeld], "the held temperatures", {count, in_.scenes});
  check_like(in_.heat_boundaries[kHeld], "the held temperatures", in_.x);
  temperatures_ = field<const T>(in_.heat_boundaries[kHeld]);
}

// The layer of particles near the held surface.
template <class T, int D>
HeatLayersArguments<T, D> HeatSteps<T, D>::layers(const Field<const T>& x, const Field<const int>& scene) const {
  constexpr double kWidth = 2;  // in dx, `WIDTH` of FixedSurface
  HeatLayersArguments<T, D> a;
  a.contact = s_.contact;
  a.particles = particles();
  a.scenes = in_.scenes;
  a.x = x;
  a.scene = scene;
  a.obstacle = int(in_.held_obstacles.back());
  a.width = kWidth * in_.lattice.dx();
  a.inverse_inertia = in_.lattice.inverse_inertia();
  a.conductance = transfer_column(kConductance);
  a.exchange = exchange_of_particles();
  return a;
}

// Sums of the nodes for the exchange with a held surface, and for the free surface.
template <class T, int D>
void HeatSteps<T, D>::sum_boundaries(const Field<const T>& x, const Field<const T>& rest, const Field<const int>& scene,
                                     backend::Stream stream) {
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
  if (holds_surface() && has_terms() && !in_.lattice.deterministic() && particles() <= kMostParticlesAtOnce)
    return backend::heat_exchange_and_surface(
        in_.lattice.order(), HeatExchangeAndSurfaceArguments<T, D>{exchange(x, scene), surface(x, rest)}, stream);
#endif
  if (holds_surface()) add_layers(x, scene, stream);
  if (has_terms()) backend::heat_surface(in_.lattice.order(), surface(x, rest), stream);
}

template <class T, int D>
HeatExchangeArguments<T, D> HeatSteps<T, D>::exchange(const Field<const T>& x, const Field<const int>& scene) const {
  const NodeField<T> nodes{nodes_.exchange, 1, 1, s_.tile_memory()};
  return {layers(x, scene), s_.p2g.topology, nodes, in_.lattice.deterministic()};
}

// The rest of the conductance in the layer, and its exchange, which is added to the nodes.
template <class T, int D>
void HeatSteps<T, D>::add_layers(const Field<const T>& x, const Field<const int>& scene, backend::Stream stream) {
  const HeatExchangeArguments<T, D> a = exchange(x, scene);
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
  backend::heat_exchange(in_.lattice.order(), a, stream);
#else
  backend::heat_layers(a.layers, stream);
  ScatterArguments<T, D> down;
  down.topology = a.topology;
  down.x = x;
  down.value = constant(exchange_of_particles());
  down.deterministic = a.deterministic;
  down.nodes = a.nodes;
  backend::scatter(in_.lattice.order(), down, stream);
#endif
}

// The averages of the nodes and the boundaries there, and the packed particles if that saves a launch.
template <class T, int D>
void HeatSteps<T, D>::average([[maybe_unused]] HeatSimpleArguments<T, D>& simple, backend::Stream stream) {
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
  if (!simple.packed && !in_.lattice.deterministic()) {
    backend::heat_pack(in_.lattice.order(), HeatPackArguments<T, D>{nodes(), simple}, stream);
    simple.packed = true;
    return;
  }
#endif
  backend::heat_nodes(nodes(), stream);
}

// Heat from the held surface.
template <class T, int D>
HeatFromSurfaceArguments<T, D> HeatSteps<T, D>::from_surface() const {
  return {s_.p2g.topology, held_temperature(int64_t(in_.held_obstacles.size()) - 1), temperatures_.stride[1],
          nodes_.exchange, nodes_.source};
}

// The nodes in a held obstacle.
template <class T, int D>
HeatHoldArguments<T, D> HeatSteps<T, D>::hold(int64_t k, const T* capacity) const {
  return {s_.contact,
          s_.p2g.topology,
          int(in_.held_obstacles[size_t(k)]),
          held_temperature(k),
          temperatures_.stride[1],
          capacity,
          nodes_.start,
          nodes_.fixed};
}

template <class T, int D>
void HeatSteps<T, D>::read_parameter(const Tensor& t, const char* name) {
  const int64_t P = particles();
  ParameterScenes scenes(in_.scene, in_.scenes);
  const Parameter<T> p = parameter<T>(t, name, in_.x, P, scenes);
  const bool own = p.stride != 0 && p.scenes == 0;
  own_.push_back(own ? int(parameters.size()) : -1);
  values_.push_back({own ? nullptr : p.pointer, p.stride, p.scenes > 0});
  if (own) parameters.push_back({in_.x, {p.pointer, {p.stride, 0, 0}}, {P}});
}

template <class T, int D>
HeatValue<T> HeatSteps<T, D>::value(size_t k) const {
  if (k >= values_.size()) return {};
  if (own_[k] < 0) return values_[k];
  const Field<const T>& f = parameters[size_t(own_[k])].now();
  return {f.pointer, f.stride[0], false};
}

// Makes the memory of the call for the size of the pool. On CUDA a substep clears that of the next one, in another
// kernel's pass over the nodes.
template <class T, int D>
void HeatSteps<T, D>::make_own_nodes(backend::Stream stream) {
  const int64_t slots = s_.activation.slots();
  if (!of_transfer_.defined()) of_transfer_ = empty_particles(in_.x, {particles(), transfer_columns()});
  if (slots != slots_) {
    slots_ = slots;
    Arena zero, rest;
    lay_out(slots, zero, rest);
    rest_ = empty(in_.x, {rest.size()}, ScalarType::Byte);
    for (Tensor& turn : zero_) {
      turn = empty(in_.x, {zero.size()}, ScalarType::Byte);
      backend::clear(turn, stream);
    }
    workspace_ = Tensor();
  }
  turn_ = kTurns - 1 - turn_;
  Arena zero(zero_[turn_]), rest(rest_);
  nodes_ = lay_out(slots, zero, rest);
}

template <class T, int D>
void HeatSteps<T, D>::make_nodes(backend::Stream stream) {
  if (!is_recorded_) make_own_nodes(stream);
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
  const int64_t used = used_slots() * kBlockNodes<D>, scalar = sizeof(T);
  clear_memory(nodes_.largest, in_.scenes * int64_t(sizeof(double)));
  HeatSlotsArguments<T, D> touched;
  touched.topology = s_.p2g.topology;
  touched.slots = s_.activation.slots();  // an earlier activation may have used more of them
  touched.order = int(in_.lattice.order());
  touched.sums = nodes_.sums;
  touched.matter = nodes_.matter;
  backend::heat_find_slots(touched, stream);
  for (T* const of_nodes : {nodes_.exchange, nodes_.source})
    if (of_nodes) clear_memory(of_nodes, used * scalar);
  if (nodes_.surface) clear_memory(nodes_.surface, used * kHeatChannels * scalar);
#endif
}

template <class T, int D>
HeatNodeMemory<T> HeatSteps<T, D>::lay_out(int64_t slots, Arena& zero, Arena& rest) const {
  const int64_t nodes = slots * kBlockNodes<D>;
  HeatNodeMemory<T> m;
  m.largest = zero.take<double>(in_.scenes);
  m.sums = zero.take<T>(nodes * kHeatChannels);
  if (exchanges()) m.exchange = zero.take<T>(nodes), m.source = zero.take<T>(nodes);
  if (has_terms()) m.surface = zero.take<T>(nodes * kHeatChannels);
  for (T*& product : m.product) product = zero.take<T>(nodes);
  if (MPM_BACKEND == MPM_BACKEND_IS_cpu) m.matter = zero.take<bool>(slots);
  if (!solves_for_sums()) m.theta = rest.take<T>(nodes), m.capacity = rest.take<T>(nodes);
  m.increment = rest.take<T>(nodes);
  if (held_nodes() > 0) m.start = rest.take<T>(nodes), m.fixed = rest.take<bool>(nodes);
  return m;
}

template <class T, int D>
HeatToNodesArguments<T, D> HeatSteps<T, D>::to_nodes(const Field<const T>& x, const Field<const T>& mass,
                                                     const Field<const T>& velocity_gradient) const {
  HeatToNodesArguments<T, D> a;
  a.topology = s_.p2g.topology;
  a.x = x;
  a.mass = mass;
  a.velocity_gradient = velocity_gradient;
  a.particles = columns();
  a.conductivity = value(0);
  a.specific_heat = value(1);
  a.transfer = HeatTransfer(in_.heat_options[0]);
  a.scene_dt = s_.p2g.scene_dt;
  a.dt = in_.dt;
  a.deterministic = in_.lattice.deterministic();
  a.conductance = transfer_column(kConductance);
  a.blend = transfer_column(kBlend);
  if (melts()) a.number = transfer_column(kNumber);
  a.largest = nodes_.largest;
  a.sums = {nodes_.sums, kHeatChannels, kHeatChannels, s_.tile_memory()};
  return a;
}

template <class T, int D>
HeatToParticlesArguments<T, D> HeatSteps<T, D>::to_particles(const HeatToNodesArguments<T, D>& down, bool elsewhere) {
  HeatToParticlesArguments<T, D> a;
  a.topology = down.topology;
  a.x = down.x;
  a.velocity_gradient = down.velocity_gradient;
  a.blend = constant(down.blend);
  a.number = constant(down.number);
  a.particles = down.particles;
  a.specific_heat = down.specific_heat;
  a.melting_point = value(2);
  a.latent_heat = value(3);
  a.scene_dt = down.scene_dt;
  a.dt = down.dt;
  a.moment_scale = in_.lattice.inverse_inertia();
  a.nodes = {nodes_.sums + kHeatTheta, kHeatChannels, kHeatChannels - kHeatTheta};
  const Field<T> next = fields.next(elsewhere);
  a.theta = column(next, 0);
  a.gradient = column(next, gradient_);
  a.liquid = column(next, liquid_);
  a.largest = rows_of_status() + kLargestFront;
  return a;
}

// The averages of the nodes, and the boundaries there.
template <class T, int D>
HeatNodesArguments<T, D> HeatSteps<T, D>::nodes() const {
  HeatNodesArguments<T, D> a;
  a.topology = s_.p2g.topology;
  HeatMeansArguments<T, D>& means = a.means;
  means.nodes = used_slots() * kBlockNodes<D>;
  means.sums = nodes_.sums;
  means.theta = nodes_.theta;
  means.capacity = nodes_.capacity;
  means.start = nodes_.start;
  means.fixed = nodes_.fixed;
  means.cleared = next_cleared();
  if (holds_surface()) a.surface = from_surface();
  for (const HeatTermArguments<T, D>& term : terms()) {
    a.terms = term;
    a.term[a.term_count] = term.term;
    a.number[a.term_count++] = term.number;
  }
  return a;
}

// The memory of the next substep; that of a record is zero already.
template <class T, int D>
HeatCleared<T> HeatSteps<T, D>::next_cleared() const {
  if (MPM_BACKEND == MPM_BACKEND_IS_cpu || is_recorded_) return {};
  const Tensor& next = zero_[kTurns - 1 - turn_];
  return {static_cast<T*>(next.data_ptr()), next.numel() / int64_t(sizeof(T))};
}

template <class T, int D>
void HeatSteps<T, D>::check_terms() {
  const int64_t count = int64_t(in_.heat_terms.size());
  STD_TORCH_CHECK(given(kNumbers) == (count > 0), "heat_terms needs numbers in heat_boundaries");
  STD_TORCH_CHECK(count < kMostHeatTerms, "heat_terms must have at most ", kMostHeatTerms - 1, " entries, got ", count);
  for (const int64_t term : in_.heat_terms)
    STD_TORCH_CHECK(term >= 0 && term <= int64_t(HeatTerm::radiation), "heat_terms must be 0 to 2, got ", term);
  if (count == 0) return;
  check_shape(in_.heat_boundaries[kNumbers], "the numbers of heat_terms", {count, in_.scenes, 2});
  check_like(in_.heat_boundaries[kNumbers], "the numbers of heat_terms", in_.x);
  STD_TORCH_CHECK(in_.heat_boundaries[kNumbers].is_contiguous(), "the numbers of heat_terms must be contiguous");
}

template <class T, int D>
HeatSurfaceArguments<T, D> HeatSteps<T, D>::surface(const Field<const T>& x, const Field<const T>& rest) const {
  HeatSurfaceArguments<T, D> a;
  a.topology = s_.p2g.topology;
  a.x = x;
  a.volume = columns().volume;
  if (has_power()) a.power = value(power_);
  if (heats_by_laws()) {
    a.dissipated = column(fields.now(), dissipated_);
    a.rest = rest;
    a.share = in_.heat_scalars[2];
    a.scene_dt = s_.p2g.scene_dt;
    a.dt = in_.dt;
  }
  a.deterministic = in_.lattice.deterministic();
  a.sums = {nodes_.surface, kHeatChannels, kHeatChannels, s_.tile_memory()};
  return a;
}

template <class T, int D>
std::vector<HeatTermArguments<T, D>> HeatSteps<T, D>::terms() const {
  std::vector<HeatTermArguments<T, D>> list;
  HeatTermArguments<T, D> a;
  a.topology = s_.p2g.topology;
  a.sums = nodes_.surface;
  a.theta = nodes_.theta;
  a.reference = in_.heat_scalars[1];
  a.exchange = nodes_.exchange;
  a.source = nodes_.source;
  for (size_t k = 0; k < in_.heat_terms.size(); k++) {
    a.term = HeatTerm(in_.heat_terms[k]);
    a.number = static_cast<const T*>(in_.heat_boundaries[kNumbers].data_ptr()) + 2 * int64_t(k) * in_.scenes;
    list.push_back(a);
  }
  a.term = HeatTerm::power;
  if (has_power() || heats_by_laws()) list.push_back(a);
  return list;
}

// The equations of the temperatures of the nodes.
template <class T, int D>
HeatArguments<T, D> HeatSteps<T, D>::equations(const Field<const T>& x) const {
  HeatArguments<T, D> a;
  a.topology = s_.p2g.topology;
  a.matter = nodes_.matter;
  a.near_blocks = int(MPM_BACKEND == MPM_BACKEND_IS_cpu ? used_slots() : s_.activation.max_blocks);
  a.x = x;
  a.conductance = constant(transfer_column(kConductance));
  if (solves_for_sums()) a.sums = nodes_.sums;
  a.heat_capacity = nodes_.capacity;
  a.theta = held_nodes() > 0 ? nodes_.start : nodes_.theta;
  a.fixed = nodes_.fixed;
  a.dt = in_.dt;
  a.scene_dt = s_.p2g.scene_dt.pointer;
  a.tolerance = kNegligibleResidual;
  a.relative_tolerance = in_.heat_scalars[0];
  a.most = int(in_.heat_options[1]);
  // With W = M/dt, u · H u ≤ Σ K_i u_i² and K_i = D⁻¹ Σ_p κ_p V_p N_i ≤ D⁻¹ dx² max_p r_p W_i (csrc/heat/cell.h).
  a.scene_bound = nodes_.largest;
  a.bound_scale = in_.lattice.inverse_inertia() * in_.lattice.dx() * in_.lattice.dx();
  a.deterministic = in_.lattice.deterministic();
  a.exchange = nodes_.exchange;
  a.source = nodes_.source;
  a.increment = nodes_.increment;
  a.iterations = static_cast<int*>(iterations_.data_ptr());
  a.residual = static_cast<T*>(residual_.data_ptr());
  a.converged = static_cast<bool*>(converged_.data_ptr());
  return a;
}

template <class T, int D>
void* HeatSteps<T, D>::workspace(backend::Stream stream) {
  HeatArguments<T, D> a;
  a.topology = s_.p2g.topology;
  a.deterministic = in_.lattice.deterministic();
  if (!workspace_.defined()) workspace_ = empty(in_.x, {backend::heat_workspace(a, stream)}, ScalarType::Byte);
  return workspace_.data_ptr();
}

// Solves the equations of all scenes, and adds the solves to the status. The kernels of simple steps allow particles
// that have left their base blocks, but for sums with an order, where none has. On CUDA the solver of the other scenes
// does not, so an activation is requested where a scene may soon be one.
template <class T, int D>
void HeatSteps<T, D>::solve(HeatFinishArguments<T, D>& finish, backend::Stream stream) {
  std::copy(std::begin(nodes_.product), std::end(nodes_.product), finish.simple.product);
  finish.theta = nodes_.theta;
  finish.sums = nodes_.sums;
  if (for_record_) finish.increment = finish.simple.solve.increment;
  if (solves_for_sums()) finish.cleared = next_cleared();
  finish.status = rows_of_status();
  finish.displacement = s_.counters;
  if (!s_.p2g_is_ahead) finish.next_displacement = s_.advance.displacement;
  solve_simply(in_.lattice.order(), finish, stream);
}

}  // namespace mpm
