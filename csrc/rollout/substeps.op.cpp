#include <string>

#include "grid/activate.op.h"
#include "grid/obstacle.op.h"
#include "grid/walls.op.h"
#include "laws/law.op.h"
#include "transfer/kernels.h"

// n steps of a simulation in one call: activation, laws, P2G, grid update, obstacles, G2P, one after another as the ops
// of one step do them, in buffers that belong to the call.
namespace mpm {
namespace {

// The words of a list that commas part.
std::vector<std::string> words(const std::string& list) {
  std::vector<std::string> result;
  for (size_t begin = 0; begin <= list.size();) {
    const size_t comma = std::min(list.find(',', begin), list.size());
    result.push_back(list.substr(begin, comma - begin));
    begin = comma + 1;
  }
  return result;
}

constexpr int64_t kMostSteps = 1 << 16;  // of one call, which nothing interrupts

// As a growing grid does in torch_mpm/grid.py.
int64_t with_headroom(int64_t blocks) { return blocks + blocks / 2 + 16; }

// The laws of a mixture, or a single one, with their places in the lists of parameters and history.
struct LawCall {
  LawEntry* law;
  int64_t options;
  Tensors parameters, history;
  int64_t first_column;  // of the history of all laws
};

// `variables` are the numbers of history tensors: a law may go without.
std::vector<LawCall> law_calls(const std::string& names, const std::vector<int64_t>& options, const Tensors& parameters,
                               const Tensors& history, const std::vector<int64_t>& variables, int64_t dim) {
  const std::vector<std::string> list = words(names);
  STD_TORCH_CHECK(options.size() == list.size(), "options must have an entry per law, ", list.size(), ", got ",
                  options.size());
  STD_TORCH_CHECK(variables.size() == list.size(), "variables must have an entry per law, ", list.size(), ", got ",
                  variables.size());
  std::vector<LawCall> calls;
  size_t parameter = 0, variable = 0;
  int64_t column = 0;
  for (size_t k = 0; k < list.size(); k++) {
    LawEntry& law = law_of(list[k]);
    const size_t count = law.info.parameters.size();
    STD_TORCH_CHECK(variables[k] >= 0, "variables must not be negative, got ", variables[k]);
    const size_t end = parameter + count, last = variable + size_t(variables[k]);
    STD_TORCH_CHECK(end <= parameters.size() && last <= history.size(),
                    "parameters and history must have those of all laws one after another, got ", parameters.size(),
                    " and ", history.size(), " tensors");
    LawCall call{&law, options[k], {}, {}, column};
    call.parameters = {parameters.begin() + parameter, parameters.begin() + end};
    call.history = {history.begin() + variable, history.begin() + last};
    parameter = end;
    variable = last;
    column += history_size(law.info, call.history, dim);
    calls.push_back(call);
  }
  STD_TORCH_CHECK(parameter == parameters.size() && variable == history.size(),
                  "parameters and history must be those of all laws, ", parameter, " and ", variable, " tensors, got ",
                  parameters.size(), " and ", history.size());
  return calls;
}

// The activation and the nodes, for one size of the pool of blocks.
template <class T, int D>
struct Pool {
  ActivationTensors active;
  Tensor nodes, updated, velocity;

  void make(const Tensor& x, ActivateArguments<T, D>& a, bool obstacles, backend::Stream stream) {
    const int64_t rows = int64_t(a.max_blocks) * kBlockNodes<D>;
    active.make(x, a, stream);
    nodes = empty(x, {rows, 1 + D});
    updated = empty(x, {rows, 1 + D});
    if (obstacles) velocity = empty(x, {rows, 1 + D});
  }
};

template <class T, int D>
Topology<T, D> topology_of(const ActivateArguments<T, D>& a) {
  Topology<T, D> t;
  t.geometry = a.geometry;
  t.scenes = a.scenes;
  t.max_blocks = a.max_blocks;
  t.particles = a.particles;
  t.table = a.table;
  t.block = a.block;
  t.offsets = a.offsets;
  t.index = a.index;
  t.schedule = a.schedule;
  t.schedule_size = a.schedule_size;
  return t;
}

// Columns of the history of all laws from the first one of a variable on, as [P, m]; as [P, D, D] with rows of `dim`.
template <class T>
Field<T> column(const Tensor& columns, int64_t first, int64_t dim) {
  Field<T> f = field<T>(columns);
  f.pointer += first * f.stride[1];
  f.stride[2] = f.stride[1];
  f.stride[1] *= dim;
  return f;
}

// The kernels of a step with their arguments, of which a call makes most once.
template <class T, int D>
struct Substeps {
  ActivateArguments<T, D> activation;
  std::vector<LawUpdateArguments<T, D>> laws;
  std::vector<LawEntry*> entries;
  P2GArguments<T, D> p2g;
  GridUpdateArguments<T, D> update;
  ContactArguments<T, D> contact;
  G2PAdvanceArguments<T, D> advance;
  Pool<T, D> pool;
  int64_t order = 2;
  bool obstacles = false;

  // What follows from the pool, after it was made.
  void use_pool() {
    const Topology<T, D> topology = topology_of(activation);
    p2g.topology = advance.gather.topology = topology;
    p2g.nodes = {static_cast<T*>(pool.nodes.data_ptr()), 1 + D, 1 + D};
    update.max_blocks = contact.max_blocks = topology.max_blocks;
    update.block = contact.block = topology.block;
    update.table = topology.table;
    update.nodes = static_cast<const NodeRow<T, D>*>(pool.nodes.data_ptr());
    update.updated = static_cast<NodeRow<T, D>*>(pool.updated.data_ptr());
    contact.velocity = static_cast<const T*>(pool.updated.data_ptr()) + 1;
    contact.stride = 1 + D;
    if (obstacles) contact.result = static_cast<T*>(pool.velocity.data_ptr());
    const Tensor& velocity = obstacles ? pool.velocity : pool.updated;
    advance.gather.nodes = {static_cast<const T*>(velocity.data_ptr()) + 1, 1 + D, D};
  }

  // Whether all blocks have a place. On CUDA nobody waits for the answer: the status tells.
  bool fits(const int* status) const {
    return MPM_BACKEND != MPM_BACKEND_IS_cpu || status[kBlocksNow] <= activation.max_blocks;
  }

  void move(backend::Stream stream) {
    for (size_t k = 0; k < laws.size(); k++) entries[k]->kernels<T, D>().update(laws[k], stream);
    torch::stable::zero_(pool.nodes);
    backend::p2g(order, p2g, stream);
    backend::grid_update(update, stream);
    if (obstacles) backend::contact(contact, stream);
    backend::g2p_advance(order, advance, stream);
  }
};

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> substeps(
    const Tensor& x, const Tensor& v, const Tensor& mass, const Tensor& volume, const OptionalTensor& C,
    const OptionalTensor& F, const OptionalTensor& J, const Tensors& history, const OptionalTensor& scene,
    const OptionalTensor& ids, const OptionalTensor& material, const OptionalTensor& previous_status, std::string laws,
    std::vector<int64_t> options, const Tensors& parameters, std::vector<int64_t> variables, int64_t n, double dt,
    bool apic, bool wants_C, int64_t stress_form, const OptionalTensor& gravity, MPM_WALLS_PARAMETERS,
    const OptionalTensor& obstacle_table, const OptionalTensor& obstacle_data, std::vector<int64_t> shape,
    std::vector<int64_t> sizes, std::vector<int64_t> contact_kind, std::vector<int64_t> obstacle_scene,
    std::vector<double> start, std::vector<double> end, double time, int64_t scenes, int64_t max_blocks, bool grows,
    const std::vector<double>& lattice, const std::vector<int64_t>& layout) {
  const PackedLattice packed(lattice, layout);
  check_positions(x);
  STD_TORCH_CHECK(n > 0 && n <= kMostSteps, "n must be 1 to ", kMostSteps, ", got ", n);
  STD_TORCH_CHECK(dt > 0 && std::isfinite(dt), "dt must be positive and finite, got ", dt);
  const int64_t P = x.size(0), D_ = x.size(1);
  const std::vector<LawCall> calls = law_calls(laws, options, parameters, history, variables, D_);
  STD_TORCH_CHECK(has(material) || calls.size() == 1, "several laws need material");
  STD_TORCH_CHECK(wants_C || !apic, "apic needs wants_C");
  bool plastic = false;
  int64_t columns = 0;
  for (const LawCall& call : calls) {
    plastic |= call.law->info.plastic;
    STD_TORCH_CHECK(wants_C || !call.law->info.viscous, "the viscous law ", call.law->info.name, " needs wants_C");
    columns = call.first_column + history_size(call.law->info, call.history, D_);
  }
  Tensor positions[] = {empty_particles(x, {P, D_}), result(x, n > 1, {P, D_})};
  Tensor F_[] = {result(x, has(F), {P, D_, D_}), result(x, has(F) && (n > 1 || plastic), {P, D_, D_})};
  Tensor J_[] = {result(x, has(J), {P}), result(x, has(J) && n > 1, {P})};
  Tensor velocity = empty_particles(x, {P, D_}), affine = result(x, wants_C, {P, D_, D_});
  Tensor kept = result(x, columns > 0, {P, columns}), stress = empty_particles(x, {P, D_, D_});
  Tensor status[] = {empty_int(x, {1 + scenes, kStatusSize}), empty_int(x, {1 + scenes, kStatusSize})};
  int64_t step = 0;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    const backend::Stream stream = device.stream();
    Substeps<T, D> s;
    s.order = packed.order();
    s.obstacles = has(obstacle_table);
    s.activation = activate_arguments<T, D>(packed, x, scene, ids, scenes, max_blocks);
    const int* before = nullptr;
    if (has(previous_status)) before = int_pointer(*previous_status, "previous_status", x, {1 + scenes, kStatusSize});

    s.p2g.mass = input<T>(mass, "mass", x, {P});
    s.p2g.volume = input<T>(volume, "volume", x, {P});
    s.p2g.stress = field<const T>(stress);
    s.p2g.dt = s.update.dt = s.advance.dt = dt;
    s.p2g.form = s.advance.form = stress_form_of(stress_form);
    s.p2g.deterministic = packed.deterministic();
    s.update.geometry = s.activation.geometry;
    s.update.block_count = s.activation.scenes * s.activation.geometry.blocks_per_scene;
    s.update.walls = walls<T, D>(wall_kind, wall_plane, wall_friction, packed);
    if (has(gravity)) {
      check_shape(*gravity, "gravity", {scenes, D});
      check_like(*gravity, "gravity", x);
      STD_TORCH_CHECK(gravity->is_contiguous(), "gravity must be contiguous");
      s.update.gravity = static_cast<const T*>(gravity->data_ptr());
    }
    STD_TORCH_CHECK(!s.obstacles || has(obstacle_data), "obstacles need data");
    if (s.obstacles)
      s.contact = obstacle_arguments<T, D>(x, packed, *obstacle_table, obstacle_data.value(), shape, sizes,
                                           contact_kind, obstacle_scene, start, end, {}, time);
    s.advance.gather.moment_scale = packed.inverse_inertia();
    s.advance.gather.lost = NAN;
    s.advance.gather.value = field<T>(velocity);
    s.advance.gather.moment = field<T>(affine);

    Field<const T> x_now = input<T>(x, "x", x, {P, D}), F_now = input<T>(F, "F", x, {P, D, D}),
                   J_now = input<T>(J, "J", x, {P}), C_now = input<T>(C, "C", x, {P, D, D});
    s.p2g.velocity = input<T>(v, "v", x, {P, D});
    if (has(material)) {
      check_shape(*material, "material", {P});
      check_type(*material, "material", ScalarType::Int, x);
      torch::stable::zero_(stress);  // of particles without a law
    }
    for (size_t k = 0; k < calls.size(); k++) {
      const LawInfo& info = calls[k].law->info;
      const OptionalTensor& state = info.field == Deformation::gradient ? F : J;
      STD_TORCH_CHECK(has(state), "the law ", info.name, " needs ", info.field == Deformation::gradient ? "F" : "J");
      kernels_of<T, D>(*calls[k].law);
      LawUpdateArguments<T, D> a;
      a.law = arguments<T, D>(info, *state, {}, calls[k].parameters, calls[k].history, scene, calls[k].options);
      if (has(material)) a.law.members = {static_cast<const int*>(material->data_ptr()), material->stride(0), int(k)};
      if (!calls[k].history.empty()) a.history = column<T>(kept, calls[k].first_column, 1);
      a.stress = field<T>(stress);
      s.laws.push_back(a);
      s.entries.push_back(calls[k].law);
    }
    int into = 0;
    if (plastic && has(F)) {  // which laws change where it stands
      torch::stable::copy_(F_[1], *F);
      F_now = field<const T>(F_[1]);
    }
    s.pool.make(x, s.activation, s.obstacles, stream);
    s.use_pool();

    for (; step < n; step++, into = 1 - into, time += dt) {
      s.activation.x = x_now;
      s.activation.previous_status = before;
      s.activation.status = static_cast<int*>(status[into].data_ptr());
      backend::activate(s.order, s.activation, stream);
      if (!s.fits(s.activation.status)) {
        if (!grows) break;  // and the status tells
        const int64_t most = std::min<int64_t>(s.update.block_count, INT32_MAX / kBlockNodes<D>);
        s.activation.max_blocks = int(std::min(with_headroom(s.activation.status[kBlocksNow]), most));
        s.pool.make(x, s.activation, s.obstacles, stream);
        s.use_pool();
        backend::activate(s.order, s.activation, stream);
      }
      for (size_t k = 0; k < s.laws.size(); k++) {
        const LawInfo& info = calls[k].law->info;
        LawUpdateArguments<T, D>& a = s.laws[k];
        a.law.state = info.field == Deformation::gradient ? F_now : J_now;
        if (info.viscous) a.law.C = C_now;
        if (info.plastic)
          a.state = {const_cast<T*>(F_now.pointer), {F_now.stride[0], F_now.stride[1], F_now.stride[2]}};
      }
      s.p2g.x = s.advance.gather.x = x_now;
      s.p2g.affine = apic ? C_now : Field<const T>{};
      s.advance.F = F_now;
      s.advance.J = J_now;
      s.advance.x_next = field<T>(positions[into]);
      s.advance.F_next = field<T>(F_[into]);
      s.advance.J_next = field<T>(J_[into]);
      s.contact.time = time;
      s.move(stream);
      x_now = field<const T>(positions[into]);
      F_now = field<const T>(F_[into]);
      J_now = field<const T>(J_[into]);
      if (step == 0) {  // from here on the call reads what it has written
        for (size_t k = 0; k < s.laws.size(); k++) {
          int64_t first = calls[k].first_column;
          for (size_t q = 0; q < calls[k].history.size(); q++) {
            const bool matrix = calls[k].law->info.history[q].matrix;
            s.laws[k].law.history[q] = column<const T>(kept, first, matrix ? D : 1);
            first += matrix ? D * D : 1;
          }
        }
        s.p2g.velocity = field<const T>(velocity);
        C_now = field<const T>(affine);
      }
      before = s.activation.status;
    }
  });
  if (step == 0) {  // the first activation found no room
    torch::stable::copy_(positions[0], x);
    torch::stable::copy_(velocity, v);
    if (F_[0].defined()) torch::stable::copy_(F_[0], *F);
    if (J_[0].defined()) torch::stable::copy_(J_[0], *J);
    if (affine.defined()) has(C) ? torch::stable::copy_(affine, *C) : torch::stable::zero_(affine);
    if (kept.defined()) torch::stable::zero_(kept);
    return {positions[0], velocity, affine, F_[0], J_[0], kept, status[0]};
  }
  const int last = int(step + 1) % 2;
  return {positions[last], velocity, affine, F_[last], J_[last], kept, status[step < n ? 1 - last : last]};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "substeps(Tensor x, Tensor v, Tensor mass, Tensor volume, Tensor? C, Tensor? F, Tensor? J, Tensor[] history, "
      "Tensor? scene, Tensor? ids, Tensor? material, Tensor? previous_status, str laws, int[] options, "
      "Tensor[] parameters, int[] variables, int n, float dt, bool apic, bool wants_C, int stress_form, "
      "Tensor? gravity, " MPM_WALLS_SCHEMA
      ", Tensor? obstacles, Tensor? data, int[] shape, int[] sizes, int[] contact, int[] obstacle_scene, "
      "float[] start, float[] end, float time, int scenes, int max_blocks, bool grows, " MPM_LATTICE_SCHEMA
      ") -> (Tensor x, Tensor v, Tensor C, Tensor F, Tensor J, Tensor history, Tensor status)");
}
#endif

MPM_LIBRARY_IMPL(m) { m.impl("substeps", TORCH_BOX(&mpm::substeps)); }
