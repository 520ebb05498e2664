#pragma once

#include <string>
#include <tuple>

#include "grid/topology.op.h"
#include "laws/law.op.h"

// The arguments of a call of many steps, its particles and its laws.
namespace mpm {

struct BodiesOfCall;  // see bodies/bodies.op.h

// The arguments of a call: a kind, the name in the schema, and the member of SubstepsInputs. The only list of them.
#define MPM_SUBSTEPS_LIST(FIRST, X)             \
  FIRST(TENSOR, x, x)                           \
  X(TENSOR, v, v)                               \
  X(TENSOR, mass, mass)                         \
  X(TENSOR, volume, volume)                     \
  X(OPTIONAL, C, C)                             \
  X(OPTIONAL, F, F)                             \
  X(OPTIONAL, J, J)                             \
  X(OPTIONAL, residual, residual)               \
  X(TENSORS, history, history)                  \
  X(OPTIONAL, scene, scene)                     \
  X(OPTIONAL, ids, ids)                         \
  X(OPTIONAL, material, material)               \
  X(OPTIONAL, previous_status, previous_status) \
  X(STRING, laws, laws)                         \
  X(INTS, options, options)                     \
  X(TENSORS, parameters, parameters)            \
  X(INTS, variables, variables)                 \
  X(INT, n, n)                                  \
  X(FLOAT, dt, dt)                              \
  X(BOOL, apic, apic)                           \
  X(FLOATS, velocity_shares, velocity_shares)   \
  X(BOOL, wants_C, wants_C)                     \
  X(INT, stress_form, stress_form)              \
  X(OPTIONAL, gravity, gravity)                 \
  X(INTS, wall_kind, wall_kind)                 \
  X(FLOATS, wall_plane, wall_plane)             \
  X(FLOATS, wall_friction, wall_friction)       \
  X(OPTIONAL, obstacles, obstacle_table)        \
  X(OPTIONAL, data, obstacle_data)              \
  X(INTS, shape, shape)                         \
  X(INTS, sizes, sizes)                         \
  X(INTS, contact, contact_kind)                \
  X(INTS, obstacle_scene, obstacle_scene)       \
  X(FLOATS, start, start)                       \
  X(FLOATS, end, end)                           \
  X(FLOAT, time, time)                          \
  X(INT, scenes, scenes)                        \
  X(INT, max_blocks, max_blocks)                \
  X(BOOL, grows, grows)                         \
  X(BOOL, resident, resident)                   \
  X(BOOL, records, records)                     \
  X(OPTIONAL, impulse, impulse)                 \
  X(OPTIONAL, scene_dt, scene_dt)               \
  X(OPTIONAL, scene_time, scene_time)           \
  X(TENSORS, heat, heat)                        \
  X(INTS, heat_options, heat_options)           \
  X(FLOATS, heat_scalars, heat_scalars)         \
  X(INTS, held_obstacles, held_obstacles)       \
  X(INTS, heat_terms, heat_terms)               \
  X(TENSORS, heat_boundaries, heat_boundaries)  \
  X(INTS, thermal, thermal)                     \
  X(TENSORS, tables, tables)                    \
  X(FLOATS, lattice, lattice_numbers)           \
  X(INTS, layout, lattice_layout)               \
  X(CHOICE, schedule, schedule)

// For each kind its name in the schema, and the type of a member.
#define MPM_SCHEMA_TENSOR(name) "Tensor " #name
#define MPM_SCHEMA_OPTIONAL(name) "Tensor? " #name
#define MPM_SCHEMA_TENSORS(name) "Tensor[] " #name
#define MPM_SCHEMA_STRING(name) "str " #name
#define MPM_SCHEMA_INT(name) "int " #name
#define MPM_SCHEMA_INTS(name) "int[] " #name
#define MPM_SCHEMA_FLOAT(name) "float " #name
#define MPM_SCHEMA_FLOATS(name) "float[] " #name
#define MPM_SCHEMA_BOOL(name) "bool " #name
#define MPM_SCHEMA_CHOICE(name) "int " #name "=-1"
#define MPM_MEMBER_TENSOR Tensor
#define MPM_MEMBER_OPTIONAL OptionalTensor
#define MPM_MEMBER_TENSORS Tensors
#define MPM_MEMBER_STRING std::string
#define MPM_MEMBER_INT int64_t
#define MPM_MEMBER_INTS std::vector<int64_t>
#define MPM_MEMBER_FLOAT double
#define MPM_MEMBER_FLOATS std::vector<double>
#define MPM_MEMBER_BOOL bool
#define MPM_MEMBER_CHOICE int64_t

#define MPM_FIRST_SCHEMA(kind, name, member) MPM_SCHEMA_##kind(name)
#define MPM_NEXT_SCHEMA(kind, name, member) ", " MPM_SCHEMA_##kind(name)
#define MPM_FIRST_PARAMETER(kind, name, member) const MPM_MEMBER_##kind& member
#define MPM_NEXT_PARAMETER(kind, name, member) , const MPM_MEMBER_##kind& member
#define MPM_FIRST_ARGUMENT(kind, name, member) member
#define MPM_NEXT_ARGUMENT(kind, name, member) , member
#define MPM_DECLARE_MEMBER(kind, name, member) MPM_MEMBER_##kind member;

#define MPM_SUBSTEPS_SCHEMA MPM_SUBSTEPS_LIST(MPM_FIRST_SCHEMA, MPM_NEXT_SCHEMA)
#define MPM_SUBSTEPS_PARAMETERS MPM_SUBSTEPS_LIST(MPM_FIRST_PARAMETER, MPM_NEXT_PARAMETER)
#define MPM_SUBSTEPS_ARGUMENTS MPM_SUBSTEPS_LIST(MPM_FIRST_ARGUMENT, MPM_NEXT_ARGUMENT)

// The arguments of a call.
struct SubstepsInputs {
  MPM_SUBSTEPS_LIST(MPM_DECLARE_MEMBER, MPM_DECLARE_MEMBER)
  // Share of the particles' own velocities that FLIP adds, and that of node velocities which damping leaves.
  double flip() const { return velocity_share(0); }
  double damping() const { return velocity_share(1); }
  double velocity_share(size_t k) const {
    STD_TORCH_CHECK(velocity_shares.size() == 2, "velocity_shares must have 2 entries, those of FLIP and damping, got ",
                    velocity_shares.size());
    const double share = velocity_shares[k];
    STD_TORCH_CHECK(share >= 0 && share <= 1, "velocity_shares must be between 0 and 1, got ", share);
    return share;
  }
  PackedLattice lattice{lattice_numbers, lattice_layout};
  BodiesOfCall* bodies = nullptr;  // free bodies, or null
};

// The parts of a list between commas or other marks.
inline std::vector<std::string> parts(const std::string& list, char mark) {
  std::vector<std::string> result;
  for (size_t begin = 0; begin <= list.size();) {
    const size_t end = std::min(list.find(mark, begin), list.size());
    result.push_back(list.substr(begin, end - begin));
    begin = end + 1;
  }
  return result;
}

// The laws of a mixture, or of a single material, with their places in the lists of parameters and history.
struct LawCall {
  LawEntry* law;
  int material;
  bool adds;   // to the stress of another law of the material
  bool melts;  // the liquid of a material whose solid is the law before
  int64_t options;
  Tensors parameters, history;
  int64_t first_column;  // in the history of all laws
};

// Materials are separated by commas, a solid and its liquid by '~', and the laws of either by '+'. `variables` are the
// numbers of history tensors, which may be zero.
inline std::vector<LawCall> law_calls(const std::string& names, const std::vector<int64_t>& options,
                                      const Tensors& parameters, const Tensors& history,
                                      const std::vector<int64_t>& variables, int64_t dim) {
  std::vector<LawCall> calls;
  for (const std::string& material : parts(names, ',')) {
    const int number = calls.empty() ? 0 : calls.back().material + 1;
    const std::vector<std::string> phases = parts(material, '~');
    STD_TORCH_CHECK(phases.size() <= 2, "a material must have at most two phases, got ", material);
    for (size_t phase = 0; phase < phases.size(); phase++) {
      bool adds = false;
      for (const std::string& name : parts(phases[phase], '+')) {
        calls.push_back({&law_of(name), number, adds, phase > 0, 0, {}, {}, 0});
        STD_TORCH_CHECK(!adds || calls.back().law->info.additive, "a law after '+' must be one that is added, got ",
                        name);
        adds = true;
      }
    }
    const size_t last = calls.size() - 1;
    STD_TORCH_CHECK(!calls[last].melts || (!calls[last].adds && !calls[last - 1].adds &&
                                           calls[last].law->info.field == Deformation::volume_ratio &&
                                           calls[last - 1].law->info.field == Deformation::gradient),
                    "a material must have one law of F and one of J where it melts, got ", material);
  }
  STD_TORCH_CHECK(options.size() == calls.size(), "options must have an entry per law, ", calls.size(), ", got ",
                  options.size());
  STD_TORCH_CHECK(variables.size() == calls.size(), "variables must have an entry per law, ", calls.size(), ", got ",
                  variables.size());
  size_t parameter = 0, variable = 0;
  int64_t column = 0;
  for (size_t k = 0; k < calls.size(); k++) {
    LawCall& call = calls[k];
    const size_t count = call.law->info.parameters.size();
    STD_TORCH_CHECK(variables[k] >= 0, "variables must not be negative, got ", variables[k]);
    const size_t end = parameter + count, last = variable + size_t(variables[k]);
    STD_TORCH_CHECK(end <= parameters.size() && last <= history.size(),
                    "parameters and history must have those of all laws one after another, got ", parameters.size(),
                    " and ", history.size(), " tensors");
    call.options = options[k];
    call.first_column = column;
    call.parameters = {parameters.begin() + parameter, parameters.begin() + end};
    call.history = {history.begin() + variable, history.begin() + last};
    parameter = end;
    variable = last;
    column += history_size(call.law->info, call.history, dim);
  }
  STD_TORCH_CHECK(parameter == parameters.size() && variable == history.size(),
                  "parameters and history must be those of all laws, ", parameter, " and ", variable, " tensors, got ",
                  parameters.size(), " and ", history.size());
  return calls;
}

// Fields of the particles; absent ones are empty.
template <class T>
struct Particles {
  Field<T> x, v, C, F, J, residual;
  Field<T> history;  // [P, m], the entries of all laws
};

template <class T>
Particles<const T> constant(const Particles<T>& p) {
  return {constant(p.x), constant(p.v),        constant(p.C),      constant(p.F),
          constant(p.J), constant(p.residual), constant(p.history)};
}

template <class T, int D>
Particles<const T> given_particles(const SubstepsInputs& in, const Tensor& history) {
  const Tensor& x = in.x;
  const int64_t P = x.size(0);
  return {input<T>(x, "x", x, {P, D}),
          input<T>(in.v, "v", x, {P, D}),
          input<T>(in.C, "C", x, {P, D, D}),
          input<T>(in.F, "F", x, {P, D, D}),
          input<T>(in.J, "J", x, {P}),
          input<T>(in.residual, "residual", x, {P, D}),
          field<const T>(history)};
}

// The history of all laws side by side, [P, m].
inline Tensor packed_history(const Tensor& x, const Tensors& history, int64_t columns) {
  Tensor packed = result(x, columns > 0, {x.size(0), columns});
  int64_t first = 0;
  for (const Tensor& variable : history) {
    const int64_t width = variable.dim() == 1 ? 1 : variable.size(1) * variable.size(2);
    Tensor part = torch::stable::narrow(packed, 1, first, width);
    torch::stable::copy_(part, torch::stable::reshape(variable, {x.size(0), width}));
    first += width;
  }
  return packed;
}

// A history variable, from a column of the packed history on: [P], or [P, D, D].
template <class T, int D>
Field<T> variable(const Field<T>& history, int64_t first, bool matrix) {
  Field<T> f = history;
  f.pointer += first * f.stride[1];
  f.stride[2] = f.stride[1];
  if (matrix) f.stride[1] *= D;
  return f;
}

// Checks the material of each particle, if there are several.
inline void check_material(const OptionalTensor& material, const std::vector<LawCall>& calls, const Tensor& x) {
  STD_TORCH_CHECK(has(material) || calls.back().material == 0, "several laws need material");
  if (!has(material)) return;
  check_shape(*material, "material", {x.size(0)});
  check_type(*material, "material", ScalarType::Int, x);
}

// The arguments of a law for its own particles.
template <class T, int D>
LawArguments<T, D> law_arguments(const LawCall& call, const Tensor& x, const OptionalTensor& F, const OptionalTensor& J,
                                 const OptionalTensor& C, const OptionalTensor& scene, const OptionalTensor& material,
                                 int64_t scenes = -1) {
  const LawInfo& info = call.law->info;
  const char* const name = info.field == Deformation::gradient ? "F" : "J";
  const OptionalTensor& state = info.field == Deformation::gradient ? F : J;
  STD_TORCH_CHECK(has(state), "the law ", info.name, " needs ", name);
  check_shape(*state, name, shape_of_state(info, x.size(0), D));
  auto a = arguments<T, D>(info, *state, C, call.parameters, call.history, scene, call.options, scenes);
  if (has(material)) a.members = {static_cast<const int*>(material->data_ptr()), material->stride(0), call.material};
  return a;
}

// Sets the history of a law, in columns from `first` on.
template <class T, int D>
void set_history(LawArguments<T, D>& a, const LawCall& call, const Field<const T>& history, int64_t first) {
  for (size_t k = 0; k < call.history.size(); k++) {
    const bool matrix = call.law->info.history[k].matrix;
    a.history[k] = variable<const T, D>(history, first, matrix);
    first += matrix ? D * D : 1;
  }
}

// The results of a call: x, v, C, F, J, history, status, impulse, time, residual, heat, its status, and the record.
using Results =
    std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

inline Tensor copy_of(const Tensor& t) {
  Tensor copy = empty(t, sizes_of(t));
  torch::stable::copy_(copy, t);
  return copy;
}

}  // namespace mpm
