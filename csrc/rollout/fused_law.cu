// Fused kernels of the laws of one header, MPM_LAW_HEADER: the law is evaluated as P2G loads a particle.
#define MPM_REGISTER_LAW(Law) static const bool Law##_is_fused = cuda::enter_fused<Law>();

#include "laws/fluid.h"
#include "rollout/fused_law.h"
#include "rollout/schedules/block_per_scene.cuh"
#include "rollout/schedules/fused_g2p2g.cuh"
#include "rollout/schedules/persistent.cuh"

namespace mpm::cuda {

// Entries of the first `variables` history variables of a law, side by side. On the host or in a constant alone: device
// code does not see the array of variables.
template <class Law, int D>
constexpr int history_entries(int variables) {
  int entries = 0;
  for (int k = 0; k < variables; k++) entries += Law::history[k].matrix ? D * D : 1;
  return entries;
}

// Entries of the history that the law has with its options, which are its first variables.
template <class Law, class T, int D>
int given_history_entries(const LawArguments<T, D>& law) {
  int given = 0;
  while (given < kHistory<Law> && law.history[given].pointer) given++;
  return history_entries<Law, D>(given);
}

// Momentum of particles whose stress is computed as they are loaded, and stored where it has a destination. Where
// requested, F or J is updated first if the previous G2P has deferred the update, and the present volume is stored.
template <class Law, class T, int D, bool MayMove, bool StoresVolume = false>
struct LawMomentumSource : MomentumSource<2, T, D, Stress::moment, true, false> {
  using Base = MomentumSource<2, T, D, Stress::moment, true, false>;
  using Kernels = typename Law::template Kernels<Law>;
  static constexpr bool moves_F = Law::field == Deformation::gradient;
  static constexpr int resident = Law::gpu_p2g_blocks, entries = history_entries<Law, D>(kHistory<Law>);
  LawUpdateArguments<T, D> law;
  LateDeformation<T, D> late;
  Columns<const T, moves_F ? D * D : 1> state;  // F or J, as given
  Columns<T, moves_F ? D * D : 1> kept;         // and their destination; optional
  int kept_entries;                             // of the history
  Columns<T, 1> present_volume;                 // optional

  // Result of the law at a particle.
  struct Changes {
    Matrix<T, D> F;
    T J, history[entries > 0 ? entries : 1];
  };
  struct Parameters {
    T value[kParameters<Law>];
  };

  LawMomentumSource(const P2GArguments<T, D>& a, const LawUpdateArguments<T, D>& law,
                    const LateDeformation<T, D>& late = {})
      : Base(a),
        law(law),
        late(late),
        state(law.law.state, D),
        kept(Law::plastic ? law.state : late.state, D),
        kept_entries(law.history.pointer ? given_history_entries<Law>(law.law) : 0),
        present_volume(late.volume) {}

  // Inputs of the law at a particle, except its history.
  __device__ void fetch(int p, Changes& changes) const {
    if constexpr (moves_F) {
#pragma unroll
      for (int k = 0; k < D * D; k++) changes.F[k / D][k % D] = state.at(p, k);
    } else {
      changes.J = state.at(p);
    }
  }
  __device__ Parameters parameters(int p) const {
    Parameters r;
#pragma unroll
    for (int k = 0; k < kParameters<Law>; k++) r.value[k] = load_parameter(One<T>{p}, law.law, k);
    return r;
  }
  // The update that the previous G2P has deferred.
  __device__ void move(int p, const Matrix<T, D>& C, const T& dt, Changes& changes) const {
    if constexpr (moves_F) {
      if (late.moves) changes.F = advance_deformation(changes.F, C, dt);
      if (StoresVolume && present_volume.present())
        present_volume.at(p) = Base::fields.volume.at(p) * determinant(changes.F);
    } else {
      if (late.moves) changes.J = advance_volume_ratio(changes.J, C, dt);
      if (StoresVolume && present_volume.present()) present_volume.at(p) = Base::fields.volume.at(p) * changes.J;
    }
  }
  // Stress from the inputs, which become the values to be stored.
  __device__ Matrix<T, D> stress_of_law(int p, const Matrix<T, D>& C, const Parameters& parameters,
                                        Changes& changes) const {
    const One<T> at{p};
    Matrix<T, D> stress;
    LawUpdateArguments<T, D> a = law;
    a.stress = {&stress[0][0], {0, D, 1}};
#pragma unroll
    for (int k = 0; k < kParameters<Law>; k++) a.law.parameters[k] = {&parameters.value[k]};
    if (Law::viscous && Base::fields.affine.present()) a.law.C = {&C[0][0], {0, D, 1}};
    if constexpr (moves_F) {
      a.law.state = {&changes.F[0][0], {0, D, 1}};
      if (Law::plastic) a.state = {&changes.F[0][0], {0, D, 1}};
    } else {
      a.law.state = {&changes.J, {0}};
    }
    if (entries > 0 && law.history.pointer) a.history = {changes.history, {0, 1}};
    Kernels::update(a, at);
    if (law.stress.pointer) store_matrix<D>(at, law.stress, stress);
    return stress;
  }
  // The update, and then the stress, from the loaded inputs.
  __device__ Matrix<T, D> stress(int p, const Matrix<T, D>& C, const T& dt, const Parameters& parameters,
                                 Changes& changes) const {
    move(p, C, dt, changes);
    return stress_of_law(p, C, parameters, changes);
  }
  __device__ void keep(int p, const Changes& changes) const {
    if (kept.present()) {
      if constexpr (!moves_F) kept.at(p) = changes.J;
#pragma unroll
      for (int k = 0; moves_F && k < D * D; k++) kept.at(p, k) = changes.F[k / D][k % D];
    }
#pragma unroll
    for (int k = 0; k < entries; k++)
      if (k < kept_entries) store_entry(One<T>{p}, law.history, k, changes.history[k]);
  }
  __device__ Matrix<T, D> update(int p, const Matrix<T, D>& C, const T& dt) const {
    if constexpr (MayMove) {
      Changes changes;
      fetch(p, changes);
      const Matrix<T, D> result = stress(p, C, dt, parameters(p), changes);
      keep(p, changes);
      return result;
    } else {
      Matrix<T, D> stress;
      LawUpdateArguments<T, D> a = law;
      a.stress = {&stress[0][0], {0, D, 1}};
      Kernels::update(a, One<T>{p});
      if (law.stress.pointer) store_matrix<D>(One<T>{p}, law.stress, stress);
      return stress;
    }
  }
  __device__ ParticleMomentum<T, D> load(int p, int scene) const {
    ParticleMomentum<T, D> m = read(p, scene, p);
    m.stress = update(p, m.affine, m.dt);
    return m;
  }
  // Its stress is still zero; `of_motion` is the row of its velocity and affine field.
  __device__ ParticleMomentum<T, D> read(int p, int scene, int of_motion) const {
    ParticleMomentum<T, D> m = Base::fields.read_at_rest(p, Base::fields.time_step(scene));
    Base::fields.read_motion(of_motion, m);
    return m;
  }
  // Outside the grid, where F has to be updated once more after the particle has left; then its affine field is zero.
  // For a position that is not finite it may be NaN, and F is unchanged.
  __device__ void skip(int p) const {
    const auto m = read(p, scene_of_late(p), p);
    const bool finite = is_finite<D>(read_vector(Base::position, p).e);
    update(p, finite ? m.affine : zero_matrix<T, D>(), m.dt);
  }
  __device__ void skip_at_rest(int p) const {
    update(p, zero_matrix<T, D>(), Base::fields.time_step(scene_of_late(p)));
  }

 protected:
  __device__ int scene_of_late(int p) const {
    const int scene = late.scene ? late.scene[p * late.scene_stride] : 0;
    return unsigned(scene) < unsigned(Base::topology.scenes) ? scene : 0;
  }
};

// Whether P2G can evaluate the law where its parameters or its material depend on the temperature: it changes neither F
// nor a history.
template <class Law>
constexpr bool kFitsThermalP2G = kChangesNothing<Law>;

// What a material is besides its law, where that reads the temperature (rollout/thermal_laws.h).
template <class T, int D>
struct MaterialAtTemperature {
  const ThermalP2GArguments<T, D>& a;
  One<T> at;
  T J = T(1);  // that the liquid reads

  __device__ T parameter(const TemperatureTable<T>& table, const T& otherwise) const {
    return table.knots > 0 ? value_at(table, load_scalar(at, a.theta)) : otherwise;
  }
  // F that the law reads. J of the material is updated as F was, if `moves`, by a step of C.
  __device__ Matrix<T, D> deformation(const Matrix<T, D>& F, bool moves, const Matrix<T, D>& C,
                                      const ParticleMomentum<T, D>& m) {
    if (a.melts()) J = load_scalar(at, a.J);
    if (a.melts() && moves) J = advance_volume_ratio(J, C, m.dt);
    if (a.present_volume.pointer) store_scalar(at, a.present_volume, m.volume * J);
    const Phases<T, D> read = read_by_laws(a, at, Phases<T, D>{J, F});
    J = read.J;
    return read.F;
  }
  __device__ T volume_ratio(const T& ratio) const { return read_by_laws<T, D>(a, at, {ratio, zero_matrix<T, D>()}).J; }
  __device__ void store_J() const { store_scalar(at, a.J_next, volume_of_stretch<D>(stretch_of(a, at)) * J); }
  __device__ Matrix<T, D> stress(const Matrix<T, D>& solid, const Matrix<T, D>& C) const {
    InvariantState<ViscousFluid, T, D> liquid;
    liquid.J = J;
    liquid.C = a.is_viscous ? C : zero_matrix<T, D>();
#pragma unroll
    for (int k = 0; k < kParameters<ViscousFluid>; k++) {
      const bool is_given = k < kParameters<WeaklyCompressible> || a.is_viscous;
      liquid.parameters[k] = is_given ? parameter(a.liquid[k], load_parameter(at, a.fluid, k)) : T(0);
    }
    return stress_of_phases(a, at, solid, stress_of(liquid));
  }
};

// Particles that P2G also moves into the order of its items, if the call owns them, and whose law may read the
// temperature.
template <class Law, class T, int D>
struct ReorderingSource : LawMomentumSource<Law, T, D, true, true> {
  using Base = LawMomentumSource<Law, T, D, true, true>;
  using Changes = typename Base::Changes;
  using Parameters = typename Base::Parameters;
  ThermalP2GArguments<T, D> thermal;
  ReorderOnScatter<T, D> reorder;
  WorkOfLaunch work;

  ReorderingSource(const P2GArguments<T, D>& a, const LawUpdateArguments<T, D>& law,
                   const ThermalP2GArguments<T, D>& thermal, const LateDeformation<T, D>& late,
                   const ReorderOnScatter<T, D>& reorder)
      : Base(a, law, late), thermal(thermal), reorder(reorder), work(a.work) {}

  bool is_mostly_idle() const {
    return reorder.rows > 0 ? reorder.is_mostly_idle() : work.displacement && !work.where_it_lasts;
  }
  __device__ bool is_due() const {
    const int64_t particles = Base::topology.particles;
    return reorder.rows > 0 ? reorder.is_due(particles) : work.is_due(particles);
  }
  __device__ bool reorders() const { return reorder.rows > 0; }
  __device__ ParticleMomentum<T, D> load(int p, int scene, int place) const {
    ParticleMomentum<T, D> m = Base::read(p, scene, reorder.rows ? reorder.place(p) : p);
    take(p, place, m, m.affine, m.stress);
    return m;
  }
  __device__ void skip(int p, int place) const {
    ParticleMomentum<T, D> m = Base::read(p, Base::scene_of_late(p), reorder.rows ? reorder.place(p) : p);
    const bool finite = is_finite<D>(read_vector(Base::position, p).e);
    take(p, place, m, finite ? m.affine : zero_matrix<T, D>(), m.stress);
  }

 private:
  __device__ void take(int p, int place, const ParticleMomentum<T, D>& m, const Matrix<T, D>& C,
                       Matrix<T, D>& stress) const {
    Changes changes;
    Base::fetch(p, changes);
    Parameters parameters = Base::parameters(p);
    Base::move(p, C, m.dt, changes);
    MaterialAtTemperature<T, D> material{thermal, {p}};
    if (reads_temperature()) {
      Base::keep(p, changes);
      begin_thermal_law(m, C, material, parameters, changes);
    }
    stress = Base::stress_of_law(p, C, parameters, changes);
    if (reads_temperature()) return end_thermal_law(C, material, changes, stress);
    const int to = reorder.rows ? reorder.in_other_copy(p, place) : p;
    Base::keep(to, changes);
    if (reorder.rows) write_reordered(p, place, to, m);
  }
  __device__ bool reads_temperature() const { return kFitsThermalP2G<Law> && thermal.given; }
  // Replaces the parameters, and F or J, by those that the law reads at the temperature.
  __device__ void begin_thermal_law(const ParticleMomentum<T, D>& m, const Matrix<T, D>& C,
                                    MaterialAtTemperature<T, D>& material, Parameters& parameters,
                                    Changes& changes) const {
#pragma unroll
    for (int k = 0; k < kParameters<Law>; k++)
      parameters.value[k] = material.parameter(thermal.solid[k], parameters.value[k]);
    if constexpr (Base::moves_F)
      changes.F = material.deformation(changes.F, Base::late.moves, C, m);
    else
      changes.J = material.volume_ratio(changes.J);
  }
  // Stores F and J of a material that melts, and replaces the stress of its solid by its own.
  __device__ void end_thermal_law(const Matrix<T, D>& C, const MaterialAtTemperature<T, D>& material, Changes& changes,
                                  Matrix<T, D>& stress) const {
    if constexpr (Base::moves_F) {
      if (!thermal.melts()) return;
      material.store_J();
      if (is_solid(thermal, material.at)) return;
      if (has_collapsed(thermal, material.at)) {
        changes.F = stretch_of(thermal, material.at) * changes.F;
        Base::keep(int(material.at.p), changes);
      }
      stress = material.stress(stress, C);
    }
  }
  __device__ void write_reordered(int p, int place, int to, const ParticleMomentum<T, D>& m) const {
    const One<T> at{to};
    store_vector<D>(at, reorder.x, read_vector(Base::position, p));
    store_scalar(at, reorder.mass, m.mass);
    store_scalar(at, reorder.volume, m.volume);
    if (reorder.residual.pointer)
      store_vector<D>(at, reorder.residual, load_vector<D>(One<T>{p}, reorder.residual_before));
    reorder.origin[to] = reorder.given ? p : reorder.origin[p];
    reorder.index[place] = to;
    if (place == 0) *reorder.copy = to >= reorder.rows;
  }
};

// In float only: in double the kernels would need all registers.
template <class Law, int D>
struct FusedLaunches {
  static void p2g(const LawUpdateArguments<float, D>& law, const ThermalP2GArguments<float, D>& thermal,
                  const LateDeformation<float, D>& late, const P2GArguments<float, D>& a,
                  const ReorderOnScatter<float, D>& reorder, void* stream) {
    launch_scatter(ReorderingSource<Law, float, D>(a, law, thermal, late, reorder), static_cast<Stream>(stream));
  }
  static void g2p2g(const LawUpdateArguments<float, D>& law, const G2P2GArguments<float, D>& a, void* stream) {
    launch_g2p2g(LawMomentumSource<Law, float, D, true>(a.p2g, law, a.late),
                 AdvanceGather<2, float, D, false, true, false>(a.advance), a, static_cast<Stream>(stream));
  }
#if CUDART_VERSION >= 13000
  static void persistent(const LawUpdateArguments<float, D>& law, const PersistentArguments<float, D>& a,
                         void* stream) {
    launch_persistent(LawMomentumSource<Law, float, D, true>(a.p2g, law, a.late),
                      AdvanceGather<2, float, D, false, true, false>(a.advance), a, static_cast<Stream>(stream));
  }
#endif
  static void block_per_scene(const LawUpdateArguments<float, D>& law, const BlockPerSceneArguments<float, D>& a,
                              void* stream) {
    launch_block_per_scene(LawMomentumSource<Law, float, D, false>(a.p2g, law),
                           AdvanceGather<2, float, D, false, false>(a.advance), a, static_cast<Stream>(stream));
  }
};

template <class Law, int D>
void fill_fused(FusedLawKernels<float, D>& kernels) {
  using Launches = FusedLaunches<Law, D>;
  kernels.p2g = Launches::p2g;
  kernels.reads_temperature = kFitsThermalP2G<Law>;
  kernels.g2p2g = Launches::g2p2g;
#if CUDART_VERSION >= 13000
  kernels.persistent = Launches::persistent;
#endif
  kernels.block_per_scene = Launches::block_per_scene;
}

// Only laws that are the only one of a material have fused kernels.
template <class Law>
bool enter_fused() {
  if constexpr (!Law::additive) {
    FusedLaw& law = fused_laws()[Law::name];
    fill_fused<Law, 3>(law.in_3d);
    if constexpr (Law::in_2d) fill_fused<Law, 2>(law.in_2d);
  }
  return true;
}

}  // namespace mpm::cuda

#include MPM_LAW_HEADER
