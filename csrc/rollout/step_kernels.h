#pragma once

#include <cmath>
#include <memory>
#include <optional>
#include <string>
#include <type_traits>

#include "bodies/bodies.op.h"
#include "cuda/schedule.h"
#include "grid/contact.h"
#include "grid/impulse.op.h"
#include "grid/obstacle.op.h"
#include "grid/walls.op.h"
#include "heat/kernels.h"
#include "laws/law.op.h"
#include "rollout/fused_law.h"
#include "rollout/inputs.h"
#include "rollout/kernels.h"
#include "rollout/plan.op.h"
#include "rollout/pool.h"
#include "transfer/kernels.h"
#include "transfer/tiles.h"

// Many steps in one call: activation, laws, P2G, grid update, obstacles and G2P in the order of the ops of one step, in
// buffers that belong to the call. Shared by the ops of rollouts.
namespace mpm {

// The kernels of a step with their arguments; a call makes most of these once.
template <class T, int D>
struct Substeps {
  const SubstepsInputs& in;
  std::vector<LawCall> calls;
  FusedLawKernels<T, D> fused_kernels;  // of the first law
  bool plastic = false;                 // some law changes F
  bool melts = false;                   // some material has a solid and a liquid law, which change F and J
  int64_t columns = 0;                  // of the history of all laws
  ActivateArguments<T, D> activation;
  std::vector<LawUpdateArguments<T, D>> laws;
  P2GArguments<T, D> p2g;
  GridUpdateArguments<T, D> update;
  ContactArguments<T, D> contact;
  G2PAdvanceArguments<T, D> advance;
  HeatAdvanceArguments<T, D> with_heat;  // with `advance` of this struct; without node sums: not together
  Pool<T, D> pool;
  Tensor stress = absent(), step_time = absent();
  Tensor scene_time = absent();      // the time of each scene now, where each has its own
  Tensor displacements = absent();   // counters of two substeps in turn, if activations last
  Displacement* counters = nullptr;  // those of the substep
  bool p2g_is_ahead = false;         // whether P2G of the next substep is launched beside the solve of heat
  Tensor largest_mass = absent();    // of a particle, where sums are fixed
  NextGridArguments<T, D> next;      // with `update` and `contact` of this struct
  Tensor known_nodes = absent(), known = absent();      // see ContactArguments
  std::shared_ptr<void> known_slots;                    // on the CPU, see contact.cpu.cpp
  std::optional<BodiesCall<T, D>> bodies;               // free bodies, which move after the obstacles act
  Tensor impulse = absent(), impulse_slots = absent();  // on obstacles and walls, if wanted; see `add_impulses_to`
  bool obstacles = false, fused = false;
  bool laws_are_apart = false;        // whether laws have kernels of their own, which other kernels precede or follow
  ThermalP2GArguments<T, D> thermal;  // of P2G, if it evaluates laws of temperature
  Tensor kept = absent();             // of FLIP, see `keep_velocities`
  Tensor tiles = absent();            // of sums with an order, see csrc/transfer/tiles.h
  LateDeformation<T, D> late;         // of P2G, if G2P defers F or J to it
  ReorderOnScatter<T, D> reorder;     // of P2G, if the call owns the particles
  bool nodes_are_clear = false;       // when a step begins
  int used_slots = 0;                 // on the CPU: number of slots with a block, if the activation counts them
  const int* previous_status = nullptr;
  PlanFacts facts;

  explicit Substeps(const SubstepsInputs& inputs);

  // Sets the inputs of the next substep, and the destination `mapped` of deformation gradients after return maps.
  void read(const Particles<const T>& p, const Field<T>& mapped) {
    bool maps = false;  // whether F of the material has changed before an added law reads it
    for (size_t k = 0; k < laws.size(); k++) {
      const LawInfo& info = calls[k].law->info;
      LawUpdateArguments<T, D>& a = laws[k];
      maps = a.adds ? maps : info.plastic;
      a.law.state = info.field == Deformation::volume_ratio ? p.J : a.adds && maps ? constant(mapped) : p.F;
      if (info.viscous) a.law.C = p.C;
      if (info.plastic) a.state = mapped;
      set_history(a.law, calls[k], p.history, calls[k].first_column);
    }
    p2g.x = advance.gather.x = activation.x = p.x;
    p2g.velocity = p.v;
    p2g.affine = in.apic ? p.C : Field<const T>{};
    advance.F = plastic ? constant(mapped) : p.F;
    advance.J = p.J;
    advance.residual = p.residual;
  }

  // Replaces the settings of read() and write() for F and J: P2G updates those of `p` if a G2P has deferred that
  // (`has_left`), and G2P defers the update to the next P2G, except in the last substep.
  void move_late(const Particles<T>& p, bool has_left, bool last) {
    const bool is_F = calls[0].law->info.field == Deformation::gradient;
    late = {is_F ? p.F : p.J, has_left, activation.scene, activation.scene_stride};
    defer(p, last);
  }
  // G2P leaves F and J of `p` for the next substep to update, and updates them in place in the last one.
  void defer(const Particles<T>& p, bool last) {
    advance.late = !last;
    advance.F = constant(p.F);
    advance.J = constant(p.J);
    advance.F_next = p.F;
    advance.J_next = p.J;
  }

  // Sets the destinations of the results.
  void write(const Particles<T>& p) {
    for (size_t k = 0; k < laws.size(); k++)
      if (!calls[k].history.empty()) laws[k].history = variable<T, D>(p.history, calls[k].first_column, false);
    advance.gather.value = p.v;
    advance.gather.moment = p.C;
    advance.x_next = p.x;
    advance.F_next = p.F;
    advance.J_next = p.J;
    advance.residual_next = p.residual;
  }

  bool flips() const { return in.flip() > 0; }

  // Velocities of the particles minus those of the nodes before the forces; FLIP adds its share of them after G2P. Uses
  // the nodes of the pool, before P2G does.
  void keep_velocities(const P2GArguments<T, D>& particles, const Field<T>& to, backend::Stream stream) {
    clear_nodes(stream);
    const GridUpdateArguments<T, D> before =
        find_nodes_before(particles, static_cast<T*>(pool.nodes.data_ptr()), update.updated, stream);
    nodes_are_clear = false;
    GatherArguments<T, D> g = advance.gather;
    g.x = particles.x;
    g.value = to;
    g.moment = {};
    g.nodes = {before.updated->value.e, 1 + D, D};
    backend::gather(in.lattice.order(), g, stream);
    backend::add_scaled(AddScaledArguments<T, D>{in.x.size(0), to, particles.velocity, constant(to), -1}, stream);
  }

  // Computes the nodes, zero on entry, and their velocities before the forces and all boundaries except mirrors,
  // without damping; returns the arguments of the update.
  GridUpdateArguments<T, D> find_nodes_before(P2GArguments<T, D> particles, T* nodes, NodeRow<T, D>* updated,
                                              backend::Stream stream) const {
    particles.stress = {};
    particles.nodes = {nodes, 1 + D, 1 + D, particles.nodes.tiles};
    backend::p2g(in.lattice.order(), particles, stream);
    GridUpdateArguments<T, D> a = update;
    a.gravity = nullptr;
    a.damping = 1;
    a.walls = mirrors(update.walls);
    a.nodes = reinterpret_cast<const NodeRow<T, D>*>(nodes);
    a.updated = updated;
    backend::grid_update(a, stream);
    return a;
  }

  // Adds the share of FLIP to the velocities after G2P.
  void add_flip(const Field<const T>& velocities, backend::Stream stream) {
    const Field<T>& v = advance.gather.value;
    backend::add_scaled(AddScaledArguments<T, D>{in.x.size(0), v, constant(v), velocities, in.flip()}, stream);
  }

  // Finds the active blocks; false if the pool has no room for them and must not grow. On CUDA the result is true
  // without a wait, and the status has the number of blocks.
  bool activate(const int* previous_status, int* status, backend::Stream stream) {
    activation.previous_status = previous_status;
    activation.status = status;
    if (MPM_BACKEND != MPM_BACKEND_IS_cpu) contact.activations = status + kActivations;
    find_blocks(stream);
    if (MPM_BACKEND != MPM_BACKEND_IS_cpu || status[kBlocksNow] <= activation.max_blocks) return true;
    if (!in.grows) return false;
    const int64_t most = std::min<int64_t>(update.block_count, INT32_MAX / kBlockNodes<D>);
    activation.max_blocks = int(std::min(with_headroom(status[kBlocksNow]), most));
    if (MPM_BACKEND == MPM_BACKEND_IS_cpu && activation.margin_blocks > 0) make_margin();
    make_pool(stream);
    find_blocks(stream);
    return true;
  }

  void find_blocks(backend::Stream stream) {
    backend::activate(in.lattice.order(), activation, stream);
    activation.fresh = false;
    if (activation.used_slots) update.max_blocks = contact.max_blocks = used_slots;
  }

  // On the CPU an activation may serve several substeps of a call that owns its particles: blocks around those with
  // particles are active too, if there is room.
  void make_margin() {
    const int64_t most = std::min<int64_t>(update.block_count, INT32_MAX / kBlockNodes<D> - activation.max_blocks);
    activation.margin_blocks = int(std::clamp<int64_t>(2 * activation.max_blocks + 64, 0, std::max<int64_t>(most, 0)));
  }

  // On CUDA an activation may serve several substeps: blocks around those with particles are active too, and G2P
  // detects when they no longer suffice. Exceptions: sums with an order, which is that of whole blocks; FLIP, whose
  // second P2G and gather use the blocks of the activation only; and gradients through a pool that does not grow, since
  // the backward pass needs room for the blocks of every substep.
  void let_activations_last(backend::Stream stream) {
    if (MPM_BACKEND == MPM_BACKEND_IS_cpu || (in.lattice.deterministic() && !sums_are_fixed(facts)) || flips()) return;
    if (!in.grows && !in.resident) return;
    if (sums_are_fixed(facts)) fix_sums(stream);
    displacements = empty_int(in.x, {2, sizeof(Displacement) / sizeof(int)});
    torch::stable::zero_(displacements);
    p2g.displaced = true;
    advance.loads_ahead = true;
    if (in.heat.empty())
      for (LawUpdateArguments<T, D>& law : laws) law.runs_beside = !law.adds;
    next.particles = in.x.size(0);
    if (!in.heat.empty())
      activation.out_of_block_cost = next.out_of_block_cost = out_of_block_cost_with_heat(next.particles);
    next.obstacles = obstacles && !impulse.defined();  // impulses need the velocities before contact
    const int64_t most = std::min<int64_t>(update.block_count, INT32_MAX / kBlockNodes<D> - activation.max_blocks);
    activation.margin_blocks = int(std::clamp<int64_t>(activation.max_blocks / 2 + 64, 0, std::max<int64_t>(most, 0)));
  }

  void fix_sums([[maybe_unused]] backend::Stream stream) {
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
    if constexpr (std::is_same_v<T, float>) {
      largest_mass = empty_int(in.x, {1});
      int* const bits = static_cast<int*>(largest_mass.data_ptr());
      backend::find_largest(p2g.mass, in.x.size(0), bits, stream);
      const int of_mass = kUnitBits - std::ilogb(double(std::max<int64_t>(in.x.size(0), 1))) - 1;
      const double most = kMostCellsPerStep * in.lattice.dx() / in.dt;
      p2g.fixed = next.fixed = {bits, of_mass, of_mass - std::ilogb(most) - 1};
      p2g.deterministic = false;
    }
#endif
  }

  // Lets P2G compute the stress, if there is a kernel for it.
  void fuse(bool keeps_stress) {
    PlanFacts f = facts;
    if (thermal.given) f.laws = 1;  // P2G evaluates the law of a liquid with that of its solid
    fused = why_not_fused_law(f).empty() && !p2g.deterministic && fused_kernels.p2g && !laws_are_apart;
    if (fused && !keeps_stress) forget_stress();
  }

  // Whether P2G updates F or J. It needs the affine field and a kernel of the law; particles stay in place in memory.
  // G2P with heat processes items as P2G does, and passes over particles in no better order.
  bool moves_late() const {
    return fused && displacements.defined() && in.apic && facts.one_deformation &&
           (!in.heat.empty() || in.x.size(0) <= kMostLateParticles);
  }

  void forget_stress() {
    stress = absent();
    for (LawUpdateArguments<T, D>& law : laws) law.stress = {};
  }

  // Selects the counters of a substep by its parity. The last substep always has an activation, whose status counts the
  // blocks at the end.
  void swap_buffers(int parity, bool last) {
    if (!displacements.defined()) return;
    counters = counters_of(parity);
    activation.displacement = last ? nullptr : counters;
    next.displacement = counters;
    next.next_displacement = advance.displacement = counters_of(1 - parity);
  }
  Displacement* counters_of(int parity) const { return static_cast<Displacement*>(displacements.data_ptr()) + parity; }

  // Accumulates the time of obstacles as single steps do; on a device, which may run ahead of the host.
  void count_time([[maybe_unused]] const int* status_before, [[maybe_unused]] backend::Stream stream) {
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
    if (!obstacles) return;
    if (status_before) contact.activations_before = status_before + kActivations;
    if (has(in.scene_time)) return;
    step_time = empty(in.x, {in.n}, ScalarType::Double);
    contact.step_time = static_cast<const double*>(step_time.data_ptr());
    backend::add_up_times(static_cast<double*>(step_time.data_ptr()), in.time, in.dt, in.n, stream);
#endif
  }

  // Sets where laws store the energy that they dissipate, [P].
  void dissipate(const Field<T>& to) {
    for (size_t k = 0; k < laws.size(); k++)
      if (dissipates(k)) laws[k].dissipated = to;
  }
  bool dissipates(size_t k) const { return calls[k].law->info.plastic || !calls[k].history.empty(); }

  // Computes the stress, if P2G does not.
  void run_laws(backend::Stream stream) {
    for (size_t k = 0; k < laws.size() && !fused; k++) run_law(k, stream);
  }
  void run_law(size_t k, backend::Stream stream) const { calls[k].law->kernels<T, D>().update(laws[k], stream); }

  // Moves the particles, after their laws; the time of the obstacles stays that of the step.
  void move(backend::Stream stream) {
    if (flips()) keep_velocities(p2g, field<T>(kept), stream);
    move_grid(stream);
    move_particles(stream);
    if (flips()) add_flip(field<const T>(kept), stream);
  }

  // G2P, together with P2G of heat where that is requested.
  void move_particles(backend::Stream stream) {
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
    if (with_heat.to_nodes.sums.pointer) {
      with_heat.advance = advance;
      return backend::heat_advance(in.lattice.order(), with_heat, stream);
    }
#endif
    backend::g2p_advance(in.lattice.order(), advance, stream);
  }

  // Advances the time after a step, on the CPU and for scenes with separate clocks.
  void end_time(backend::Stream stream) {
    if (MPM_BACKEND == MPM_BACKEND_IS_cpu) contact.time += in.dt, contact.row += contact.step_stride;
    if (scene_time.defined()) advance_clocks(static_cast<double*>(scene_time.data_ptr()), stream);
  }

  // Scenes with separate time steps and clocks begin at `times`, which is advanced.
  void count_scene_times(const Tensor& times) {
    scene_time = times;
    contact.scene_time = static_cast<const double*>(times.data_ptr());
    contact.times = int(in.scenes);
  }

  void advance_clocks(double* times, backend::Stream stream) const {
    const T* const scene_dt = static_cast<const T*>(in.scene_dt->data_ptr());
    backend::advance_clocks(AdvanceClocksArguments<T, D>{times, scene_dt, in.dt, in.scenes}, stream);
  }

  // Computes the velocities of the nodes from the stress; P2G may compute the stress itself.
  void move_grid(backend::Stream stream) {
    clear_nodes(stream);
    if (fused)
      fused_kernels.p2g(laws[0], thermal, late, p2g, reorder, stream);
    else
      backend::p2g(in.lattice.order(), p2g, stream);
    move_nodes(stream);
  }

  void clear_nodes([[maybe_unused]] backend::Stream stream) {
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
    const int64_t slots = activation.used_slots ? used_slots : activation.slots();
    if (!nodes_are_clear)
      clear_memory(pool.nodes.data_ptr(), slots * int64_t(kBlockNodes<D>) * int64_t(sizeof(NodeRow<T, D>)));
#else
    // The sums of tiles are stored at all nodes of the active blocks.
    if (!next.emptied && !nodes_are_clear && !tiles.defined()) backend::clear(pool.nodes, stream);
#endif
  }

  // Computes the velocities of the nodes from their momenta.
  void move_nodes(backend::Stream stream) {
    if (impulse.defined() && !in.wall_kind.empty()) backend::wall_impulses(wall_impulses(), stream);
    update_grid(stream);
    if (obstacles && !next.obstacles) {
      if (impulse.defined()) backend::contact_impulses(contact_impulses(), stream);
      backend::contact(contact, stream);
    }
    if (bodies) move_bodies(stream);
  }

  // Free bodies: their step, and the velocities of the nodes after contact with them, in place.
  void move_bodies(backend::Stream stream) {
    T* const rows = static_cast<T*>((pool.velocity.defined() ? pool.velocity : pool.updated).data_ptr());
    bodies->run(update.block, activation.max_blocks, update.max_blocks, static_cast<const T*>(pool.updated.data_ptr()),
                1 + D, rows + 1, 1 + D, stream);
  }

  // Grid update; on CUDA with contact, if an activation serves several substeps.
  void update_grid(backend::Stream stream) {
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
    if (displacements.defined()) {
      next.update = update;
      next.contact = contact;
      return backend::next_grid(next, stream);
    }
#endif
    backend::grid_update(update, stream);
  }

  // From now on the impulses on obstacles, and then on the faces of the domain, are added to `sums`.
  void add_impulses_to(const Tensor& sums) { impulse = sums; }

  Shape impulse_shape() const { return {in.scenes, int64_t(in.shape.size()) + 2 * D, kImpulse<D>}; }

  // Impulses of `count` of these boundaries.
  ImpulseArguments<D> impulses(int64_t first, int64_t count) {
    return impulse_arguments<D>(in.lattice, impulse, first, count, activation.slots(), impulse_slots);
  }

  WallImpulsesArguments<T, D> wall_impulses() { return {update, impulses(int64_t(in.shape.size()), 2 * D)}; }

  ContactImpulsesArguments<T, D> contact_impulses() {
    return {contact, reinterpret_cast<const T*>(update.updated), 1 + D, impulses(0, int64_t(in.shape.size()))};
  }

  // Node velocities after contact.
  const NodeRow<T, D>* velocities() const {
    return static_cast<const NodeRow<T, D>*>((pool.velocity.defined() ? pool.velocity : pool.updated).data_ptr());
  }

  // Memory for sums with an order, absent where colours of blocks give it: where the backward pass recomputes the
  // steps, whose sums have the order of single steps, and without heat.
  T* tile_memory() const { return tiles.defined() ? static_cast<T*>(tiles.data_ptr()) : nullptr; }
  bool takes_tiles() const {
    return MPM_BACKEND != MPM_BACKEND_IS_cpu && p2g.deterministic && in.resident && !in.heat.empty();
  }

  void make_pool(backend::Stream stream);
  void make_known_nodes(backend::Stream stream);
  void use_pool();

 private:
  void set_laws();
  void set_transfers();
  void set_grid_update();
  void set_obstacles();
  void set_clocks();
  void set_bodies();
  PlanFacts facts_of_call() const;
};

template <class T, int D>
Substeps<T, D>::Substeps(const SubstepsInputs& inputs) : in(inputs) {
  STD_TORCH_CHECK(in.n > 0 && in.n <= kMostSteps, "n must be 1 to ", kMostSteps, ", got ", in.n);
  STD_TORCH_CHECK(in.dt > 0 && std::isfinite(in.dt), "dt must be positive and finite, got ", in.dt);
  STD_TORCH_CHECK(in.wants_C || !in.apic, "apic needs wants_C");
  activation = activate_arguments<T, D>(in.lattice, in.x, in.scene, in.ids, in.scenes, in.max_blocks);
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
  // An item fits into a batch of the kernels of heat. On a deterministic grid the items of a scene, and the order of
  // its sums, do not depend on the other scenes.
  if (!in.heat.empty()) {
    activation.most_of_item = cuda::kSmallItemParticles<D>;
    if (!in.lattice.deterministic())
      activation.most_of_item = std::min(activation.most_of_item, cuda::item_particles(in.x.size(0)));
  }
#endif
  if (has(in.previous_status))
    previous_status = int_pointer(*in.previous_status, "previous_status", in.x, {1 + in.scenes, kStatusSize});
  set_laws();
  set_transfers();
  set_grid_update();
  set_obstacles();
  set_clocks();
  set_bodies();
  if (has(in.impulse)) {
    check_shape(*in.impulse, "impulse", impulse_shape());
    check_type(*in.impulse, "impulse", ScalarType::Double, in.x);
    STD_TORCH_CHECK(!flips() || !update.walls.mirrored, "impulses on mirrors are not counted with flip, got ",
                    in.flip());
    STD_TORCH_CHECK(in.damping() == 1, "impulses are not counted with damping, got ", in.damping());
  }
  facts = facts_of_call();
}

template <class T, int D>
void Substeps<T, D>::set_laws() {
  const Tensor& x = in.x;
  if (in.laws.empty()) return;  // a body at rest
  calls = law_calls(in.laws, in.options, in.parameters, in.history, in.variables, D);
  fused_kernels = fused_kernels_of<T, D>(calls[0].law->info.name);
  check_material(in.material, calls, x);
  stress = empty_particles(x, {x.size(0), D, D});
  if (has(in.material)) torch::stable::zero_(stress);  // of particles without a law
  for (const LawCall& call : calls) {
    const LawInfo& info = call.law->info;
    STD_TORCH_CHECK(in.wants_C || !info.viscous, "the viscous law ", info.name, " needs wants_C");
    kernels_of<T, D>(*call.law);
    LawUpdateArguments<T, D> a;
    a.law = law_arguments<T, D>(call, x, in.F, in.J, {}, in.scene, in.material, in.scenes);
    a.adds = call.adds;
    a.stress = field<T>(stress);
    laws.push_back(a);
    melts |= call.melts;
    plastic |= info.plastic || call.melts;
    columns = call.first_column + history_size(info, call.history, D);
  }
}

template <class T, int D>
void Substeps<T, D>::set_transfers() {
  const int64_t P = in.x.size(0);
  kept = result(in.x, flips(), {P, D});
  p2g.mass = input<T>(in.mass, "mass", in.x, {P});
  p2g.volume = input<T>(in.volume, "volume", in.x, {P});
  p2g.stress = field<const T>(stress);
  p2g.dt = update.dt = advance.dt = in.dt;
  p2g.form = advance.form = stress_form_of(in.stress_form);
  p2g.deterministic = in.lattice.deterministic();
  advance.gather.moment_scale = in.lattice.inverse_inertia();
  advance.gather.lost = NAN;
}

template <class T, int D>
void Substeps<T, D>::set_grid_update() {
  update.geometry = activation.geometry;
  update.block_count = activation.scenes * activation.geometry.blocks_per_scene;
  update.walls = walls<T, D>(in.wall_kind, in.wall_plane, in.wall_friction, in.lattice);
  update.damping = T(in.damping());
  if (!has(in.gravity)) return;
  check_shape(*in.gravity, "gravity", {in.scenes, D});
  check_like(*in.gravity, "gravity", in.x);
  STD_TORCH_CHECK(in.gravity->is_contiguous(), "gravity must be contiguous");
  update.gravity = static_cast<const T*>(in.gravity->data_ptr());
}

template <class T, int D>
void Substeps<T, D>::set_obstacles() {
  obstacles = has(in.obstacle_table);
  STD_TORCH_CHECK(!obstacles || has(in.obstacle_data), "obstacles need data");
  if (!obstacles) return;
  contact = obstacle_arguments<T, D>(in.x, in.lattice, *in.obstacle_table, in.obstacle_data.value(), in.shape, in.sizes,
                                     in.contact_kind, in.obstacle_scene, in.start, in.end, {}, in.time, in.n);
  set_walls(contact, in.wall_kind, in.wall_plane);
  check_scenes(contact, in.scenes);
}

// Time steps and times of scenes with clocks of their own.
template <class T, int D>
void Substeps<T, D>::set_clocks() {
  STD_TORCH_CHECK(has(in.scene_dt) == has(in.scene_time), "scene_dt must be given with scene_time");
  if (!has(in.scene_dt)) return;
  const auto type = in.x.scalar_type();
  for (const auto& [tensor, name, expected] :
       {std::tuple(*in.scene_dt, "scene_dt", type), std::tuple(*in.scene_time, "scene_time", ScalarType::Double)}) {
    check_shape(tensor, name, {in.scenes});
    check_type(tensor, name, expected, in.x);
    STD_TORCH_CHECK(tensor.is_contiguous(), name, " must be contiguous");
  }
  p2g.scene_dt = advance.scene_dt = field<const T>(*in.scene_dt);
  update.scene_dt = p2g.scene_dt.pointer;
}

template <class T, int D>
void Substeps<T, D>::set_bodies() {
  if (!in.bodies) return;
  STD_TORCH_CHECK(in.resident && !in.records,
                  "bodies are computed without gradients: records must be false, and "
                  "resident true");
  bodies.emplace(in.bodies->in, in.x, in.lattice, in.wall_kind, in.wall_plane, in.scenes, in.dt);
  if (update.scene_dt) bodies->set_scene_dt(update.scene_dt);
  in.bodies->rows = bodies->rows();
  in.bodies->report = bodies->report();
}

// The facts of a call, except those of the stream and the device.
template <class T, int D>
PlanFacts Substeps<T, D>::facts_of_call() const {
  PlanFacts f;
  f.cuda = MPM_BACKEND != MPM_BACKEND_IS_cpu;
  f.float32 = sizeof(T) == sizeof(float);
  f.dim = D;
  f.particles = in.x.size(0);
  f.scenes = in.scenes;
  f.steps = in.n;
  f.blocks_per_scene = activation.geometry.blocks_per_scene;
  f.max_blocks = in.max_blocks;
  f.grows = in.grows;
  f.deterministic = in.lattice.deterministic();
  f.quadratic = in.lattice.order() == 2;
  f.apic = in.apic;
  f.flips = flips();
  f.mls = p2g.form == StressForm::mls;
  f.mirrors = update.walls.mirrored;
  f.impulses = has(in.impulse);
  f.clocks = has(in.scene_dt);
  f.scene_ids = has(in.scene);
  f.sorted = has(in.ids);
  f.laws = int64_t(calls.size());
  f.materials = has(in.material);
  f.additive = !calls.empty() && calls[0].law->info.additive;
  f.uniform_parameters = true;
  for (size_t k = 0; !calls.empty() && k < calls[0].parameters.size(); k++)
    f.uniform_parameters &= laws[0].law.parameters[k].stride == 0;
  f.one_deformation = has(in.F) != has(in.J);
  f.gradients = !in.resident;
  f.records = in.records;
  f.obstacles = contact.obstacles;
  f.heat = !in.heat.empty();
  f.rests = in.laws.empty();
  f.bodies = in.bodies != nullptr;
  return f;
}

// Makes the pool for the number of blocks of the arguments.
template <class T, int D>
void Substeps<T, D>::make_pool(backend::Stream stream) {
  const bool apart = obstacles && !next.obstacles;  // contact is separate from the grid update
  pool.make(in.x, activation, apart, stream);
  if (obstacles && in.resident && in.n > 1) make_known_nodes(stream);
  if (takes_tiles()) tiles = empty(in.x, {int64_t(activation.slots()) * tile_words<D>(int(in.lattice.order()))});
  if (largest_mass.defined()) pool.nodes = empty(in.x, Pool<T, D>::nodes_shape(activation), ScalarType::Long);
  if (impulse.defined() && (MPM_BACKEND == MPM_BACKEND_IS_cpu || in.lattice.deterministic()))
    impulse_slots = empty(in.x, {activation.slots(), impulse_shape()[1] * kImpulse<D>}, ScalarType::Double);
  use_pool();
  if (displacements.defined() && !update.walls.mirrored) {
    backend::clear(pool.nodes, stream);
    next.emptied = static_cast<NodeRow<T, D>*>(pool.nodes.data_ptr());
  }
}

// What is found once in the call: on CUDA a table of surfaces, on the CPU the surfaces by slot.
template <class T, int D>
void Substeps<T, D>::make_known_nodes(backend::Stream stream) {
  if (MPM_BACKEND == MPM_BACKEND_IS_cpu) {
    contact.known = &known_slots;
    return;
  }
  constexpr int least = 1 << 14, most = 1 << 18, of_scene = 1 << 10;
  contact.known_size = least;
  while (contact.known_size < most && contact.known_size < of_scene * in.scenes) contact.known_size *= 2;
  known_nodes = empty(in.x, {contact.known_size}, ScalarType::Long);
  known = empty(in.x, {contact.known_size * int64_t(sizeof(MetSurfaces<T, D>))}, ScalarType::Byte);
  backend::clear(known_nodes, stream);
  contact.known_nodes = static_cast<unsigned long long*>(known_nodes.data_ptr());
  contact.known = known.data_ptr();
}

// Sets the present activation and pool in the arguments of the kernels.
template <class T, int D>
void Substeps<T, D>::use_pool() {
  const Topology<T, D> topology = topology_of(activation);
  p2g.topology = advance.gather.topology = topology;
  p2g.nodes = {static_cast<T*>(pool.nodes.data_ptr()), 1 + D, 1 + D, tile_memory()};
  update.max_blocks = contact.max_blocks = topology.max_blocks;
  next.near_blocks = activation.max_blocks;
  update.block = contact.block = topology.block;
  update.table = topology.table;
  update.nodes = static_cast<const NodeRow<T, D>*>(pool.nodes.data_ptr());
  update.updated = static_cast<NodeRow<T, D>*>(pool.updated.data_ptr());
  contact.mass = static_cast<const T*>(pool.updated.data_ptr());
  contact.velocity = contact.mass + 1;
  contact.stride = contact.mass_stride = 1 + D;
  if (pool.velocity.defined()) contact.result = static_cast<T*>(pool.velocity.data_ptr());
  advance.gather.nodes = {velocities()->value.e, 1 + D, D};
}

// Passes clocks of scenes to a kernel of many substeps.
template <class T, int D, class Arguments>
void give_clocks(const Substeps<T, D>& s, Arguments& a) {
  if (!s.scene_time.defined()) return;
  a.scene_time = static_cast<double*>(s.scene_time.data_ptr());
  a.scene_dt = static_cast<const T*>(s.in.scene_dt->data_ptr());
}

}  // namespace mpm
