#pragma once

#include <algorithm>

#include "laws/fluid.h"
#include "rollout/heat_steps.h"
#include "rollout/thermal_laws.h"

// Laws of temperature in a call of many substeps: their tables, and where laws are computed kernel by kernel their
// buffers and kernels, or their arguments of P2G.
namespace mpm {

// What a table gives in the place of the number of a parameter: the expansion of a material, the coherency of a liquid.
constexpr int64_t kExpansion = -1, kCoherency = -2;

template <class T>
TemperatureTable<T> temperature_table(const SubstepsInputs& in, int64_t number) {
  STD_TORCH_CHECK(number >= 0 && number < int64_t(in.tables.size()), "tables must have an entry ", number, ", got ",
                  in.tables.size());
  const Tensor& t = in.tables[size_t(number)];
  const int64_t knots = t.dim() == 2 ? t.size(1) : 0;
  STD_TORCH_CHECK(knots > 0, "tables must have shape [2, K], got ", shape_of(t));
  check_shape(t, element("tables", int(number)).c_str(), {2, knots});
  check_like(t, element("tables", int(number)).c_str(), in.x);
  STD_TORCH_CHECK(t.is_contiguous(), "tables must be contiguous");
  const T* const values = static_cast<const T*>(t.data_ptr());
  int64_t first = 0;
  for (int64_t k = 0; k < number; k++) first += in.tables[size_t(k)].size(-1);
  return {int(knots), values, values + knots, int(first)};
}

// What each law reads of the temperature. Records of the call: a law, the number of a parameter, kExpansion or
// kCoherency, and the number of a table.
template <class T>
std::vector<LawTemperature<T>> temperatures_of_laws(const SubstepsInputs& in, const std::vector<LawCall>& calls) {
  std::vector<LawTemperature<T>> laws(calls.size());
  STD_TORCH_CHECK(in.thermal.size() % 3 == 0, "thermal must have records of 3 numbers, got ", in.thermal.size());
  for (size_t r = 0; r < in.thermal.size(); r += 3) {
    const int64_t k = in.thermal[r], what = in.thermal[r + 1];
    STD_TORCH_CHECK(k >= 0 && k < int64_t(laws.size()), "thermal must name laws 0 to ", laws.size() - 1, ", got ", k);
    LawTemperature<T>& law = laws[size_t(k)];
    STD_TORCH_CHECK(what >= kCoherency && what < int64_t(calls[size_t(k)].parameters.size()),
                    "thermal must name parameters of a law, got ", what);
    TemperatureTable<T>& table = what == kExpansion   ? law.expansion
                                 : what == kCoherency ? law.coherency
                                                      : law.parameters[what];
    table = temperature_table<T>(in, in.thermal[r + 2]);
  }
  bool melts = false;
  for (size_t k = 0; k < calls.size(); k++) {
    melts |= calls[k].melts;
    STD_TORCH_CHECK(calls[k].melts == (laws[k].coherency.knots > 0),
                    "a law must have a coherency where it is that of a liquid, got law ", k);
  }
  STD_TORCH_CHECK((in.thermal.empty() && !melts) || !in.heat.empty(), "laws of temperature need heat");
  STD_TORCH_CHECK(!melts || in.heat.size() >= 6, "a material that melts needs heat with a melting point");
  return laws;
}

// The laws of a call: kernel by kernel, with buffers for what they read in place of the fields of the particles, or in
// P2G.
template <class T, int D>
class ThermalLaws {
 public:
  static bool wanted(const Substeps<T, D>& s) { return !s.in.thermal.empty() || s.melts; }

  // `heat` must be there.
  ThermalLaws(Substeps<T, D>& steps, const HeatSteps<T, D>* heat)
      : s_(steps), heat_(heat), laws_(temperatures_of_laws<T>(s_.in, s_.calls)) {
    materials_.resize(laws_.size());
    columns_.resize(laws_.size());
    liquid_stress_.resize(laws_.size());
    int first = 0;
    for (size_t k = 0; k < laws_.size(); k++) {
      for (int i = 0; i < kMostParameters; i++)
        if (laws_[k].parameters[i].knots > 0) columns_[first_of(k)].push_back(first + i);
      first += int(s_.calls[k].parameters.size());
    }
  }

  // Gives laws kernels of their own.
  void separate() {
    for (size_t k = 0; k < laws_.size(); k++) {
      const bool melts = s_.calls[k].melts;
      ThermalLawsArguments<T, D>& a = materials_[first_of(k)];
      a.particles = s_.in.x.size(0);
      a.members = s_.laws[k].law.members;
      for (int i = 0; i < kMostParameters; i++)
        if (laws_[k].parameters[i].knots > 0) add_parameter(a, s_.laws[k].law.parameters[i], laws_[k].parameters[i]);
      if (!melts) a.expansion = laws_[k].expansion;
      if (melts) a.coherency = laws_[k].coherency;
    }
    for (size_t k = 0; k < laws_.size(); k++) make_buffers(k);
    // The law of a liquid reads and writes nothing of that of its solid, before which its inputs are computed.
    for (size_t k = 0; k < laws_.size(); k++) s_.laws[k].runs_beside = s_.calls[k].melts;
  }

  // Whether P2G can evaluate the laws: those of a material of all particles, where a liquid is a fluid. P2G updates and
  // stores F and J of a material that melts, and of another one the field that its law reads, which then is the only
  // one.
  bool fit_p2g() const {
    const std::string liquid = has_liquid(0) ? s_.calls[1].law->info.name : "";
    const bool is_fluid = liquid == WeaklyCompressible::name || liquid == ViscousFluid::name;
    const bool has_fields = has_liquid(0) ? is_fluid : s_.facts.one_deformation;
    return is_alone() && has_fields && s_.fused_kernels.reads_temperature;
  }

  // Lets P2G evaluate them, of the fields of the last Substeps::read(), and write J of `to`. Present volumes are stored
  // where a G2P has deferred their update (`has_left`).
  void enter_p2g(const Field<T>& J, bool has_left, const Field<T>& present_volume) {
    ThermalP2GArguments<T, D>& a = s_.thermal;
    a.theta = heat_->temperature();
    a.expansion = laws_[0].expansion;
    std::copy_n(laws_[0].parameters, kMostParameters, a.solid);
    if (has_left && !has_liquid(0)) s_.late.volume = present_volume;
    if (!has_liquid(0)) return;
    a.fraction = heat_->liquid_fraction();
    a.coherency = laws_[1].coherency;
    std::copy_n(laws_[1].parameters, kMostParameters, a.liquid);
    a.fluid = s_.laws[1].law;
    a.is_viscous = s_.calls[1].law->info.viscous;
    a.J = a.fluid.state;
    a.J_next = J;
    a.present_volume = has_left ? present_volume : Field<T>{};
  }

  // Replaces the settings of Substeps::read and Substeps::write for these laws. F and J after the laws are written to
  // `F` and `J`, which may be those before; their other entries are unchanged. See ThermalLawsArguments for
  // `difference`.
  void read(const Field<T>& F, const Field<T>& J, const Field<T>& difference = {}) {
    for (size_t k = 0; k < materials_.size(); k++) {
      if (s_.calls[k].melts) continue;
      ThermalLawsArguments<T, D>& a = materials_[k];
      a.theta = heat_->temperature();
      if (has_liquid(k)) a.fraction = heat_->liquid_fraction();
      if (!a.has_elastic()) continue;
      (s_.calls[k].law->info.field == Deformation::gradient ? a.F : a.J) = s_.laws[k].law.state;
      if (has_liquid(k) || s_.calls[k].law->info.plastic) a.next_F = F;
      if (has_liquid(k)) {
        a.J = s_.laws[k + 1].law.state;
        a.next_J = J;
        a.stress = s_.laws[k].stress;
        a.dissipated = s_.laws[k].dissipated;
        a.difference = difference;
        s_.laws[k + 1].stress = liquid_stress_[k];
        a.liquid_stress = constant(liquid_stress_[k]);
        read_elastic(k + 1, a);
      }
      read_elastic(k, a);
    }
  }

  // Whether the laws of a call can update F and J in place of G2P: those of a material of all particles, which read F
  // and J without expansion, or those of both phases.
  bool may_move() const {
    const ThermalLawsArguments<T, D>& a = materials_[0];
    return is_alone() && bool(a.elastic_F.pointer) == has(s_.in.F) && bool(a.elastic_J.pointer) == has(s_.in.J);
  }

  // Lets the laws update F and J of the particles `to`, if a G2P has deferred that (`has_left`), and store the present
  // volumes then.
  void move_late(const Particles<T>& to, bool has_left, const Field<T>& volume) {
    DeferredMotion<T, D>& d = materials_[0].deferred;
    d.moves = has_left;
    d.advance.x = s_.p2g.x;
    d.advance.affine = s_.p2g.affine;
    d.advance.scene = s_.activation.scene;
    d.advance.scene_stride = s_.activation.scene_stride;
    d.advance.scene_dt = s_.p2g.scene_dt;
    d.advance.scenes = s_.in.scenes;
    d.advance.dt = s_.in.dt;
    d.advance.F_next = to.F;
    d.advance.J_next = to.J;
    d.rest = s_.p2g.volume;
    d.volume = has_left ? volume : Field<T>{};
  }

  // Computes what laws read: the parameters by tables at the present temperatures, F and J.
  void begin(backend::Stream stream) const {
    for (const ThermalLawsArguments<T, D>& a : materials_)
      if (a.begins()) backend::begin_thermal_laws(a, stream);
  }

  void run(backend::Stream stream) const {
    for (size_t k = 0; k < materials_.size(); k++) {
      const ThermalLawsArguments<T, D>& a = materials_[first_of(k)];
      if (!s_.calls[k].melts && a.begins()) backend::begin_thermal_laws(a, stream);
      s_.run_law(k, stream);
      if (!has_liquid(k) && a.ends()) backend::end_thermal_laws(a, stream);
    }
  }

  size_t count() const { return materials_.size(); }  // of laws
  // Arguments of the material whose first law is k, empty for other laws; and the columns of its parameters by tables
  // in those of all laws.
  const ThermalLawsArguments<T, D>& material(size_t k) const { return materials_[k]; }
  const std::vector<int>& columns(size_t k) const { return columns_[k]; }
  // Whether parameters depend on the temperature.
  bool has_parameters() const {
    return std::any_of(columns_.begin(), columns_.end(), [](const auto& of_law) { return !of_law.empty(); });
  }

  // Whether the material whose first law is k melts.
  bool has_liquid(size_t k) const { return k + 1 < s_.calls.size() && s_.calls[k + 1].melts; }
  // The first law of the material of law k.
  size_t first_of(size_t k) const { return s_.calls[k].melts ? k - 1 : k; }

 private:
  bool is_alone() const { return count() == size_t(has_liquid(0) ? 2 : 1) && !has(s_.in.material); }

  void add_parameter(ThermalLawsArguments<T, D>& a, Parameter<T>& p, const TemperatureTable<T>& table) {
    buffers_.push_back(empty(s_.in.x, {a.particles}));
    T* const to = static_cast<T*>(buffers_.back().data_ptr());
    a.parameters[a.parameter_count++] = {table, to};
    p = {to, 1, 0};
  }

  Field<T> buffer(const Shape& shape) {
    buffers_.push_back(empty_particles(s_.in.x, shape));
    return field<T>(buffers_.back());
  }

  void make_buffers(size_t k) {
    ThermalLawsArguments<T, D>& a = materials_[k];
    if (s_.calls[k].melts || (!has_liquid(k) && a.expansion.knots == 0)) return;
    a.is_plastic = s_.calls[k].law->info.plastic;
    const bool gradient = s_.calls[k].law->info.field == Deformation::gradient;
    if (gradient) a.elastic_F = buffer({a.particles, D, D});
    if (!gradient || has_liquid(k)) a.elastic_J = buffer({a.particles});
    if (!has_liquid(k)) return;
    liquid_stress_[k] = buffer({a.particles, D, D});
  }

  void read_elastic(size_t k, const ThermalLawsArguments<T, D>& a) {
    const LawInfo& info = s_.calls[k].law->info;
    const Field<T>& own = info.field == Deformation::gradient ? a.elastic_F : a.elastic_J;
    s_.laws[k].law.state = constant(own);
    if (info.plastic) s_.laws[k].state = own;
  }

  Substeps<T, D>& s_;
  const HeatSteps<T, D>* const heat_;
  const std::vector<LawTemperature<T>> laws_;
  std::vector<ThermalLawsArguments<T, D>> materials_;  // with their first law
  std::vector<std::vector<int>> columns_;              // of their parameters by tables in those of all laws
  std::vector<Field<T>> liquid_stress_;
  Tensors buffers_;
};

}  // namespace mpm
