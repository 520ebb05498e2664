#pragma once

#include <limits>
#include <utility>

#include "cpu/schedule.h"
#include "rollout/own_field.h"
#include "rollout/step_kernels.h"
#include "rollout/thermal_laws.op.h"

namespace mpm {

// The particles of a call on the CPU. They move in place and are reordered by cell from time to time, so that packs of
// particles are loads and stores of whole registers. At the end they are restored to the given order.
template <class T, int D>
class SortedCpu {
 public:
  OwnField<T> x, v, C, F, J, residual, history;
  std::optional<HeatSteps<T, D>> heat;

  // `sorts`: whether steps may change the order of the particles.
  SortedCpu(Substeps<T, D>& steps, const Tensor& packed_history, bool sorts, backend::Stream stream);

  // Whether an activation may serve several substeps of a call, with G2P and the next P2G in one pass. Exceptions:
  // - deterministic grids: the length of an activation depends on all scenes, and affects the rounding of each;
  // - gradients through a pool that does not grow, since they need room for the blocks of every substep;
  // - FLIP, which needs the velocities of particles before the forces, and a pass does not store them;
  // - heat with sums over particles that are transferred with their base blocks (`HeatSteps::may_last`).
  // The solve of heat is between G2P and the next step: G2P of the velocities is then in a pass of its own, with P2G of
  // heat, and G2P of heat is in the pass with the next P2G.
  static bool may_last(const SubstepsInputs& in) {
    return in.lattice.order() == 2 && in.n > kLeastLastingSteps && !in.lattice.deterministic() &&
           (in.grows || in.resident) && in.flip() == 0 &&
           (!HeatSteps<T, D>::wanted(in) || HeatSteps<T, D>::may_last(in));
  }

  // One substep, with `following` further ones; false as for `Substeps::activate`.
  bool step(const int* status_before, int* status, int64_t following);

  // Restores the given order.
  void restore_order();

 private:
  using R = ChunkRows<D>;

  // A reorder and the restoration at the end pay from this number of substeps on.
  static constexpr int64_t kLeastLastingSteps = 8;
  static constexpr int64_t kLeastPasses = 2;  // further substeps needed for a pass
  // Cost of a particle out of its block, as a multiple of that of activating one particle.
  static constexpr int kCpuOutOfBlockCost = 10;
  static constexpr int kActivationsOfPatience = 16;  // after an activation that served a single substep
  static constexpr int kDeterministicSteps = 8;      // between two reorders on deterministic grids

  double farthest() const;
  void find_laws();
  void find_thermal();
  void find_column(int column, int row, bool written);
  void keep_velocities();
  bool begin(const int* status_before, int* status, int64_t following);
  void run_substep(const int* status_before, int* status);
  bool pays(int64_t following);
  bool tries_to_last(int64_t following);
  bool lasts(int64_t following);
  bool reaches();
  void give_to_nodes(bool rearranges);
  void set_p2g();
  void set_advance(bool elsewhere);
  void conduct();
  void pass(bool follows);
  void find_rows(bool rearranges);
  void find_prefetched(bool motion);
  void advance();

  // Calls visit(field, first row of the copy or -1, whether laws read it, whether they change it) for the fields that
  // are reordered together.
  template <class Visit>
  void for_fields(const Visit& visit) {
    const bool gradient = has(in_.F), ratio = has(in_.J);
    visit(x, -1, false, false);
    if (gradient) visit(F, R::F, reads_F_, s_.plastic);
    if (ratio) visit(J, R::J, reads_J_, s_.melts);
    if (has(in_.residual)) visit(residual, -1, false, false);
    visit(mass_, -1, false, false);
    visit(volume_, -1, false, false);
    if (s_.columns > 0) visit(history, R::rest, true, true);
    for (size_t k = 0; k < parameters_.size(); k++) visit(parameters_[k], parameter_row(k), true, false);
    if (!heat) return;
    visit(heat->fields, -1, false, false);
    for (OwnField<T>& parameter : heat->parameters) visit(parameter, -1, false, false);
  }
  int parameter_row(size_t k) const { return R::rest + int(s_.columns) + int(k); }

  Substeps<T, D>& s_;
  const SubstepsInputs& in_;
  const bool sorts_;
  backend::Stream stream_;
  OwnField<T> mass_, volume_;
  OwnField<T> kept_;                     // of FLIP
  std::vector<OwnField<T>> parameters_;  // per particle
  OwnField<int> scene_, material_, origin_;
  std::vector<ChunkLaw<T, D>> laws_;
  std::vector<ParticleRow<T>> rows_;
  std::vector<ParticleRow<int>> numbers_;
  std::vector<const T*> prefetched_;
  LawsP2GArguments<T, D> a_;
  HeatToParticlesArguments<T, D> heat_to_particles_;
  Tensor copies_ = absent();
  int copied_rows_ = 0;
  bool reads_F_ = false, reads_J_ = false, viscous_ = false, rearranged_ = false;
  bool owned_ = false, moved_ = true;  // whether the fields are in buffers; whether some have moved since the last step
  int64_t breaks_ = 0, all_breaks_ = 0;  // of this substep, and since the last reorder
  Displacement displacement_{};
  Whereabouts whereabouts_{};
  double rounding_;                     // of positions [cells]
  int64_t passes_ = 0;                  // since the activation
  int patience_ = 0;                    // activations before the next attempt to let one last
  bool tries_ = false, lasts_ = false;  // whether this activation may last; whether a pass computes the next substep
};

template <class T, int D>
SortedCpu<T, D>::SortedCpu(Substeps<T, D>& steps, const Tensor& packed_history, bool sorts, backend::Stream stream)
    : s_(steps), in_(steps.in), sorts_(sorts), stream_(stream) {
  const Tensor& like = in_.x;
  const int64_t P = like.size(0);
  const Particles<const T> given = given_particles<T, D>(in_, packed_history);
  x = {like, given.x, {P, D}};
  v = {like, given.v, {P, D}};
  C = {like, given.C, {P, D, D}};
  F = {like, given.F, {P, D, D}};
  J = {like, given.J, {P}};
  residual = {like, given.residual, {P, D}};
  mass_ = {like, s_.p2g.mass, {P}};
  volume_ = {like, s_.p2g.volume, {P}};
  if (s_.columns > 0) history = OwnField<T>(packed_history);
  if (s_.flips()) kept_ = OwnField<T>(s_.kept);
  if (HeatSteps<T, D>::wanted(in_)) heat.emplace(s_), heat->leave_no_record();
  if (has(in_.scene)) scene_ = {like, field<const int>(*in_.scene), {P}};
  if (has(in_.material)) material_ = {like, field<const int>(*in_.material), {P}};
  s_.forget_stress();
  find_laws();
  s_.activation.breaks = &breaks_;
  s_.activation.used_slots = &s_.used_slots;
  rounding_ = 1e-3 + 4 * double(std::numeric_limits<T>::epsilon()) * farthest() / in_.lattice.dx();
  a_.has_material = has(in_.material);
  a_.laws = laws_.data();
  a_.law_count = int(laws_.size());
  a_.material_count = s_.calls.back().material + 1;
  a_.copy_size = int64_t(copied_rows_) * kCopyLine;
  copies_ = empty(like, {cpu::thread_count(), a_.copy_size});
  a_.copies = static_cast<T*>(copies_.data_ptr());
}

// Largest coordinate of the lattice.
template <class T, int D>
double SortedCpu<T, D>::farthest() const {
  const Geometry<T, D>& g = s_.activation.geometry;
  double most = 0;
  for (int a = 0; a < D; a++)
    most = std::max(most, std::abs(double(g.lower[a])) + double(g.blocks[a]) * kBlockWidth * double(g.dx));
  return most;
}

template <class T, int D>
void SortedCpu<T, D>::find_laws() {
  const std::vector<LawTemperature<T>> temperatures = temperatures_of_laws<T>(in_, s_.calls);
  for (size_t k = 0; k < s_.laws.size(); k++) {
    const LawCall& call = s_.calls[k];
    const LawInfo& info = call.law->info;
    ChunkLaw<T, D> law;
    law.temperature = temperatures[k];
    law.update = call.law->template kernels<T, D>().update;
    law.arguments = s_.laws[k];
    law.gradient = info.field == Deformation::gradient;
    law.viscous = info.viscous;
    viscous_ |= info.viscous;
    law.plastic = info.plastic;
    law.material = call.material;
    (law.gradient ? reads_F_ : reads_J_) = true;
    int row = R::rest + int(call.first_column);
    for (int i = 0; i < kMostHistory; i++) {
      law.history[i] = size_t(i) < call.history.size() ? row : -1;
      if (law.history[i] < 0) continue;
      law.matrix[i] = info.history[i].matrix;
      row += law.matrix[i] ? D * D : 1;
    }
    for (int i = 0; i < kMostParameters; i++) {
      const Parameter<T>& p = law.arguments.law.parameters[i];
      law.parameters[i] = -1;
      if (law.temperature.parameters[i].knots > 0 || !p.pointer || p.stride == 0 || p.scenes > 0) continue;
      law.parameters[i] = parameter_row(parameters_.size());
      parameters_.push_back({in_.x, {p.pointer, {p.stride, 0, 0}}, {in_.x.size(0)}});
    }
    law.melts = call.melts;
    laws_.push_back(law);
  }
  copied_rows_ = R::rest + int(s_.columns + parameters_.size());
  find_thermal();
}

// The rows that laws need for the temperature.
template <class T, int D>
void SortedCpu<T, D>::find_thermal() {
  bool reads_temperature = false, expands = false;
  for (ChunkLaw<T, D>& law : laws_) {
    for (int i = 0; i < kMostParameters; i++) {
      if (law.temperature.parameters[i].knots == 0) continue;
      law.parameters[i] = copied_rows_++;
      reads_temperature = true;
    }
    expands |= law.temperature.expansion.knots > 0;
  }
  if (reads_temperature || expands) a_.temperature_row = copied_rows_++;
  if (s_.melts) a_.fraction_row = copied_rows_++;
  const auto rows = [this](int count) { return std::exchange(copied_rows_, copied_rows_ + count); };
  if (s_.melts || expands) a_.elastic_row = rows(D * D + 1);
  if (s_.melts) a_.liquid_row = rows(D * D);
  if (heat && heat->heats_by_laws()) a_.dissipated_row = copied_rows_++;
}

// Copies a column of heat to a row, and back if it is written.
template <class T, int D>
void SortedCpu<T, D>::find_column(int column, int row, bool written) {
  if (row < 0) return;
  const Field<const T>& fields = heat->fields.now();
  const T* const from = fields.pointer + column * fields.stride[1];
  for (ParticleRow<T>& r : rows_)
    if (r.from == from) {
      r.row = row;
      return;
    }
  T* const to = written ? heat->fields.next(false).pointer + column * fields.stride[1] : nullptr;
  rows_.push_back({from, fields.stride[0], to, row});
}

// A break in the order of the particles costs every substep about as much as a particle; reordering a particle costs a
// quarter of that, and the restoration at the end one substep.
template <class T, int D>
bool SortedCpu<T, D>::pays(int64_t following) {
  if (!sorts_) return false;
  if (in_.lattice.deterministic())  // independent of other scenes
    return following >= kDeterministicSteps && (in_.n - 1 - following) % kDeterministicSteps == 0;
  const int64_t P = in_.x.size(0);
  all_breaks_ += breaks_;
  return 4 * all_breaks_ > P && breaks_ * following > (rearranged_ ? P / 4 : P);
}

template <class T, int D>
bool SortedCpu<T, D>::step(const int* status_before, int* status, int64_t following) {
  if (lasts_)
    run_substep(status_before, status);
  else if (!begin(status_before, status, following))
    return false;
  s_.move_nodes(stream_);
  lasts_ = lasts(following);
  if (heat && (lasts_ || passes_ > 0)) conduct();
  if (!lasts_) advance();  // heat reads the obstacles of this time
  s_.end_time(stream_);
  return true;
}

// Activation, laws and P2G of a substep that no pass computes.
template <class T, int D>
bool SortedCpu<T, D>::begin(const int* status_before, int* status, int64_t following) {
  s_.activation.x = x.now();
  s_.activation.scene = scene_.now().pointer;
  s_.activation.scene_stride = scene_.now().stride[0];
  s_.activation.origin = origin_.now().pointer;
  tries_ = tries_to_last(following);
  displacement_ = {};
  s_.activation.next_displacement = tries_ ? &displacement_ : nullptr;
  if (!s_.activate(status_before, status, stream_)) return false;
  if (s_.flips()) keep_velocities();
  s_.clear_nodes(stream_);
  passes_ = 0;
  if (tries_ && displacement_.lost != 0) patience_ = kActivationsOfPatience;  // no room for the blocks around
  tries_ = tries_ && displacement_.lost == 0;
  if (heat) heat->begin(F.now(), J.now(), volume_.now(), stream_);
  give_to_nodes(tries_ || pays(following));
  return true;
}

template <class T, int D>
void SortedCpu<T, D>::keep_velocities() {
  set_p2g();
  s_.keep_velocities(a_.p2g, kept_.next(false), stream_);
  kept_.go(false);
}

// G2P, laws and P2G, while an activation lasts.
template <class T, int D>
void SortedCpu<T, D>::run_substep(const int* status_before, int* status) {
  for (int64_t k = 0; k < (1 + in_.scenes) * kStatusSize; k++) status[k] = status_before[k];
  status[kActivations]++;
  s_.clear_nodes(stream_);
  pass(true);
}

template <class T, int D>
bool SortedCpu<T, D>::tries_to_last(int64_t following) {
  if (!sorts_ || !may_last(in_) || following < (rearranged_ ? kLeastPasses : kLeastLastingSteps)) return false;
  return patience_ == 0 || --patience_ == 0;
}

// Whether a pass can compute the next substep. The last one always has its own activation, whose status counts the
// blocks at the end.
template <class T, int D>
bool SortedCpu<T, D>::lasts(int64_t following) {
  if (!tries_ || following < kLeastPasses) return false;
  displacement_ = {whereabouts_.out_of_block, 0, displacement_.earlier + displacement_.out_of_block, 0};
  const bool result = displacement_.lasts(in_.x.size(0), kCpuOutOfBlockCost) && reaches();
  if (!result && passes_ == 0) patience_ = kActivationsOfPatience;
  return result;
}

// Whether all particles stay near their base blocks in the next G2P. No particle is faster than the fastest node, since
// its velocity is a mean over nodes.
template <class T, int D>
bool SortedCpu<T, D>::reaches() {
  T longest = 0;
  LongestMoveArguments<T, D> a;
  a.nodes = s_.velocities();
  a.block = s_.update.block;
  a.slots = s_.used_slots;
  a.blocks_per_scene = s_.update.geometry.blocks_per_scene;
  a.scene_dt = s_.update.scene_dt;
  a.longest = &longest;
  backend::longest_move(a, stream_);
  const double cells = double(longest) * in_.dt / in_.lattice.dx();
  return cells * (1 + rounding_) + rounding_ < double(whereabouts_.displacement_budget);
}

template <class T, int D>
void SortedCpu<T, D>::give_to_nodes(bool rearranges) {
  if (rearranges && !rearranged_) {
    origin_ = OwnField<int>(empty_int(in_.x, {in_.x.size(0)}));
    int* const origin = origin_.next(false).pointer;
    for (int64_t p = 0; p < in_.x.size(0); p++) origin[p] = int(p);
  }
  if (rearranges || moved_) find_rows(rearranges);
  moved_ = rearranges || !owned_;
  owned_ = true;
  set_p2g();
  a_.whereabouts = tries_ ? &whereabouts_ : nullptr;
  whereabouts_ = {float(kBlockWidth), 0};
  backend::laws_p2g(in_.lattice.order(), a_, stream_);
  for_fields([&](OwnField<T>& f, int, bool, bool changes) {
    if (changes || rearranges) f.go(rearranges);
  });
  if (!rearranges) return;
  origin_.go(true);
  if (s_.flips()) kept_.go(true);
  if (has(in_.scene)) scene_.go(true);
  if (has(in_.material)) material_.go(true);
  rearranged_ = true;
  all_breaks_ = 0;
}

// Lists the rows of the particles with their sources and destinations.
template <class T, int D>
void SortedCpu<T, D>::find_rows(bool rearranges) {
  rows_.clear();
  numbers_.clear();
  for_fields([&](OwnField<T>& f, int row, bool read, bool changes) {
    if (read || rearranges) f.rows(rows_, row, changes || rearranges, rearranges);
  });
  find_column(0, a_.temperature_row, false);
  if (heat) find_column(heat->liquid_column(), a_.fraction_row, false);
  if (heat) find_column(heat->dissipated_column(), a_.dissipated_row, true);
  if (viscous_ && C.now().pointer) C.rows(rows_, R::C, false, false);
  if (rearranges && s_.flips()) kept_.rows(rows_, -1, true, true);
  if (rearranges) origin_.rows(numbers_, kOriginRow, true, true);
  if (has(in_.scene)) scene_.rows(numbers_, kSceneRow, rearranges, true);
  if (has(in_.material)) material_.rows(numbers_, kMaterialRow, rearranges, true);
  find_prefetched(true);
  a_.rows = rows_.data();
  a_.row_count = int(rows_.size());
  a_.numbers = numbers_.data();
  a_.number_count = int(numbers_.size());
  a_.has_C = C.now().pointer;
  a_.rearranges = rearranges;
}

// Lists the rows that laws and P2G read, for prefetches.
template <class T, int D>
void SortedCpu<T, D>::find_prefetched(bool motion) {
  std::vector<ParticleRow<T>> read;
  for_fields([&](OwnField<T>& f, int row, bool read_by_laws, bool) {
    if (row < 0 || read_by_laws) f.rows(read, row, false, false);
  });
  if (motion) v.rows(read, -1, false, false);
  if (motion && C.now().pointer) C.rows(read, -1, false, false);
  prefetched_.clear();
  for (const ParticleRow<T>& r : read)
    if (r.stride == 1) prefetched_.push_back(r.from);
  a_.prefetched = prefetched_.data();
  a_.prefetched_count = int(prefetched_.size());
}

template <class T, int D>
void SortedCpu<T, D>::set_p2g() {
  a_.p2g = s_.p2g;
  a_.p2g.x = x.now();
  a_.p2g.mass = mass_.now();
  a_.p2g.velocity = v.now();
  a_.p2g.affine = in_.apic ? C.now() : Field<const T>{};
  a_.p2g.volume = volume_.now();
  a_.index = s_.activation.index;
  a_.schedule = s_.activation.schedule;
}

// Sets the arguments of G2P; the new positions are in the other buffer or in place.
template <class T, int D>
void SortedCpu<T, D>::set_advance(bool elsewhere) {
  G2PAdvanceArguments<T, D>& a = s_.advance;
  a.gather.x = x.now();
  a.F = F.now();
  a.J = J.now();
  a.residual = residual.now();
  a.gather.value = v.next(false);
  a.x_next = x.next(elsewhere);
  if (in_.wants_C) a.gather.moment = C.next(false);
  if (has(in_.F)) a.F_next = F.next(false);
  if (has(in_.J)) a.J_next = J.next(false);
  if (has(in_.residual)) a.residual_next = residual.next(false);
}

// G2P of the velocities and conduction of heat, while an activation lasts.
template <class T, int D>
void SortedCpu<T, D>::conduct() {
  set_advance(false);
  const Field<const T> gradients = constant(s_.advance.gather.moment);
  const HeatToNodesArguments<T, D> down = heat->begin_nodes(x.now(), mass_.now(), gradients, stream_);
  backend::heat_g2p_chunks(HeatG2PChunksArguments<T, D>{s_.advance, s_.velocities(), down}, stream_);
  heat->conduct(down, volume_.now(), scene_.now(), stream_);
  heat_to_particles_ = heat->to_particles(down, false);
}

// G2P of the previous substep, then laws and P2G of this one if `follows`.
template <class T, int D>
void SortedCpu<T, D>::pass(bool follows) {
  set_advance(false);
  if (passes_ == 0) {
    v.go(false);  // values of particles outside; those of others are not read before the last pass
    if (in_.wants_C) C.go(false);
    find_rows(false);
    find_prefetched(heat.has_value());
    moved_ = true;
  }
  set_p2g();
  whereabouts_ = {float(kBlockWidth), 0};
  G2P2GChunksArguments<T, D> a{s_.advance, a_};
  a.velocities = s_.velocities();
  a.sums = static_cast<NodeRow<T, D>*>(s_.pool.nodes.data_ptr());
  a.follows = follows;
  a.fresh = passes_++ == 0;
  if (heat) {
    a.heat = &heat_to_particles_;
    a.volume_next = heat->volumes();
  }
  backend::g2p2g_chunks(a, stream_);
}

template <class T, int D>
void SortedCpu<T, D>::advance() {
  const bool elsewhere = heat && passes_ == 0;  // heat then needs the positions before the step
  if (passes_ > 0) {
    pass(false);
  } else {
    set_advance(elsewhere);
    backend::g2p_advance(in_.lattice.order(), s_.advance, stream_);
    if (s_.flips()) s_.add_flip(kept_.now(), stream_);
    if (heat) heat->run(x.now(), mass_.now(), volume_.now(), constant(s_.advance.gather.moment), scene_.now(), stream_);
  }
  moved_ |= heat.has_value();
  v.go(false);
  x.go(elsewhere);
  if (in_.wants_C) C.go(false);
  if (has(in_.F)) F.go(false);
  if (has(in_.J)) J.go(false);
  if (has(in_.residual)) residual.go(false);
}

template <class T, int D>
void SortedCpu<T, D>::restore_order() {
  if (!rearranged_) return;
  rows_.clear();
  const auto each = [&](const auto& visit) {
    visit(x), visit(v);
    if (in_.wants_C) visit(C);
    if (has(in_.F)) visit(F);
    if (has(in_.J)) visit(J);
    if (has(in_.residual)) visit(residual);
    if (s_.columns > 0) visit(history);
    if (heat) visit(heat->fields);
  };
  each([&](OwnField<T>& f) { f.rows(rows_, 0, true, true); });
  const Tensor place = empty_int(in_.x, {in_.x.size(0)});
  PermuteArguments<T, D> a;
  a.rows = rows_.data();
  a.row_count = int(rows_.size());
  a.particles = in_.x.size(0);
  a.origin = origin_.now().pointer;
  a.place = static_cast<int*>(place.data_ptr());
  backend::permute(a, stream_);
  each([&](OwnField<T>& f) { f.go(true); });
}

}  // namespace mpm
