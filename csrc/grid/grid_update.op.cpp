#include <algorithm>

#include "grid/impulse.op.h"
#include "grid/kernels.h"
#include "grid/walls.op.h"

// Node mass and momentum to mass and velocity, with gravity and the walls of the domain, and the impulses on these.
namespace mpm {
namespace {

#define MPM_GRID_UPDATE_SCHEMA \
  "Tensor nodes, Tensor? gravity, Tensor? scene_dt, float dt, " MPM_WALLS_SCHEMA ", " MPM_TOPOLOGY_SCHEMA
#define MPM_GRID_UPDATE_PARAMETERS                                                                                     \
  const Tensor &nodes, const OptionalTensor &gravity, const OptionalTensor &scene_dt, double dt, MPM_WALLS_PARAMETERS, \
      const std::vector<Tensor>&topology, const std::vector<double>&lattice, const std::vector<int64_t>&layout
#define MPM_GRID_UPDATE_ARGUMENTS \
  nodes, gravity, scene_dt, dt, wall_kind, wall_plane, wall_friction, topology, lattice, layout

void check_nodes(const Tensor& nodes) {
  STD_TORCH_CHECK(nodes.dim() == 2 && (nodes.size(1) == 3 || nodes.size(1) == 4),
                  "nodes must have shape [N, 3] or [N, 4], got ", shape_of(nodes));
  check_count(nodes.size(0), "nodes", "rows");
}

// Kernels read whole rows with vector loads.
Tensor packed_rows(const Tensor& t) {
  const bool packed = t.is_contiguous() && reinterpret_cast<uintptr_t>(t.data_ptr()) % 16 == 0;
  if (packed) return t;
  Tensor copy = empty(t, {t.size(0), t.size(1)});
  torch::stable::copy_(copy, t);
  return copy;
}

template <class T, int D>
const NodeRow<T, D>* rows(const Tensor& t, const char* name, const Tensor& nodes) {
  check_shape(t, name, {nodes.size(0), 1 + D});
  check_like(t, name, nodes);
  return static_cast<const NodeRow<T, D>*>(t.data_ptr());
}

template <class T>
const T* scene_values(const OptionalTensor& t, const char* name, const Tensor& nodes, const Shape& shape) {
  if (!has(t)) return nullptr;
  check_shape(*t, name, shape);
  check_like(*t, name, nodes);
  STD_TORCH_CHECK(t->is_contiguous(), name, " must be contiguous");
  return static_cast<const T*>(t->data_ptr());
}

template <class T, int D>
GridUpdateArguments<T, D> grid_update_arguments(MPM_GRID_UPDATE_PARAMETERS) {
  const PackedTopology blocks(topology, lattice, layout);
  GridUpdateArguments<T, D> a;
  a.geometry = blocks.geometry<T, D>();
  a.max_blocks = blocks.max_blocks<D>();
  a.block = blocks.block_pointer(nodes);
  check_shape(nodes, "nodes", {blocks.node_count<D>(), 1 + D});
  a.nodes = rows<T, D>(nodes, "nodes", nodes);
  int64_t table_size;
  a.table = blocks.table_pointer(nodes, table_size);
  const int64_t scenes = blocks.scenes<T, D>(nodes);
  a.block_count = int(table_size);
  a.gravity = scene_values<T>(gravity, "gravity", nodes, {scenes, D});
  a.scene_dt = scene_values<T>(scene_dt, "scene_dt", nodes, {scenes});
  a.dt = dt;
  a.walls = walls<T, D>(wall_kind, wall_plane, wall_friction, blocks);
  return a;
}

Tensor grid_update(MPM_GRID_UPDATE_PARAMETERS) {
  check_nodes(nodes);
  const DeviceScope device(nodes);
  const Tensor packed = packed_rows(nodes);
  Tensor updated = empty(packed, {packed.size(0), packed.size(1)});
  dispatch(nodes, "nodes", nodes.size(1) - 1, [&]<class T, int D>() {
    auto a = grid_update_arguments<T, D>(MPM_GRID_UPDATE_ARGUMENTS);
    a.nodes = rows<T, D>(packed, "nodes", nodes);
    a.updated = static_cast<NodeRow<T, D>*>(updated.data_ptr());
    backend::grid_update(a, device.stream());
  });
  return updated;
}

// `change` is the adjoint of the velocity change by gravity, summed over the nodes of each slot.
std::tuple<Tensor, Tensor> grid_update_backward(const Tensor& grad, bool wants_change, MPM_GRID_UPDATE_PARAMETERS) {
  check_nodes(nodes);
  check_shape(grad, "grad", {nodes.size(0), nodes.size(1)});
  const DeviceScope device(nodes);
  const Tensor packed = packed_rows(nodes), packed_grad = packed_rows(grad);
  Tensor grad_nodes = empty(packed, {packed.size(0), packed.size(1)}), change;
  dispatch(nodes, "nodes", nodes.size(1) - 1, [&]<class T, int D>() {
    GridUpdateBackwardArguments<T, D> a;
    a.forward = grid_update_arguments<T, D>(MPM_GRID_UPDATE_ARGUMENTS);
    a.forward.nodes = rows<T, D>(packed, "nodes", nodes);
    a.grad_updated = rows<T, D>(packed_grad, "grad", nodes);
    a.grad_nodes = static_cast<NodeRow<T, D>*>(grad_nodes.data_ptr());
    change = empty(nodes, {wants_change ? a.forward.max_blocks : 0, D});
    if (wants_change) a.change = static_cast<Vector<T, D>*>(change.data_ptr());
    backend::grid_update_backward(a, device.stream());
  });
  return {grad_nodes, change};
}

// Scenes of the table.
template <class T, int D>
int64_t scenes_of(const GridUpdateArguments<T, D>& a) {
  return a.block_count / a.geometry.blocks_per_scene;
}

Tensor wall_impulses(MPM_GRID_UPDATE_PARAMETERS) {
  check_nodes(nodes);
  const DeviceScope device(nodes);
  const Tensor packed = packed_rows(nodes);
  Tensor sums, slots;
  dispatch(nodes, "nodes", nodes.size(1) - 1, [&]<class T, int D>() {
    WallImpulsesArguments<T, D> a;
    a.update = grid_update_arguments<T, D>(MPM_GRID_UPDATE_ARGUMENTS);
    a.update.nodes = rows<T, D>(packed, "nodes", nodes);
    sums = no_impulses(nodes, scenes_of(a.update), 2 * D, D);
    a.impulse =
        impulse_arguments<D>(PackedLattice(lattice, layout), sums, 0, 2 * D, int64_t(a.update.max_blocks), slots);
    backend::wall_impulses(a, device.stream());
  });
  return sums;
}

// `change` as in the adjoint of the grid update.
std::tuple<Tensor, Tensor> wall_impulses_backward(const Tensor& grad_impulse, bool wants_change,
                                                  MPM_GRID_UPDATE_PARAMETERS) {
  check_nodes(nodes);
  const DeviceScope device(nodes);
  const Tensor packed = packed_rows(nodes), grad_updated = zeros(packed, {packed.size(0), packed.size(1)});
  Tensor grad_nodes = empty(packed, {packed.size(0), packed.size(1)}), change;
  dispatch(nodes, "nodes", nodes.size(1) - 1, [&]<class T, int D>() {
    WallImpulsesBackwardArguments<T, D> a;
    a.update.forward = grid_update_arguments<T, D>(MPM_GRID_UPDATE_ARGUMENTS);
    a.update.forward.nodes = rows<T, D>(packed, "nodes", nodes);
    a.update.grad_updated = rows<T, D>(grad_updated, "grad", nodes);
    a.update.grad_nodes = static_cast<NodeRow<T, D>*>(grad_nodes.data_ptr());
    change = empty(nodes, {wants_change ? a.update.forward.max_blocks : 0, D});
    if (wants_change) a.update.change = static_cast<Vector<T, D>*>(change.data_ptr());
    a.impulse = impulse_gradient<D>(PackedLattice(lattice, layout), grad_impulse, 0, 2 * D,
                                    {scenes_of(a.update.forward), 2 * D, kImpulse<D>}, nodes);
    backend::wall_impulses_backward(a, device.stream());
  });
  return {grad_nodes, change};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("grid_update(" MPM_GRID_UPDATE_SCHEMA ") -> Tensor");
  m.def("grid_update_backward(Tensor grad, bool wants_change, " MPM_GRID_UPDATE_SCHEMA
        ") -> (Tensor nodes, Tensor change)");
  m.def("wall_impulses(" MPM_GRID_UPDATE_SCHEMA ") -> Tensor");
  m.def("wall_impulses_backward(Tensor grad_impulse, bool wants_change, " MPM_GRID_UPDATE_SCHEMA
        ") -> (Tensor nodes, Tensor change)");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("grid_update", TORCH_BOX(&mpm::grid_update));
  m.impl("grid_update_backward", TORCH_BOX(&mpm::grid_update_backward));
  m.impl("wall_impulses", TORCH_BOX(&mpm::wall_impulses));
  m.impl("wall_impulses_backward", TORCH_BOX(&mpm::wall_impulses_backward));
}
