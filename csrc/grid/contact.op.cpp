#include "grid/impulse.op.h"
#include "grid/kernels.h"
#include "grid/obstacle.op.h"

// Contact of the grid with rigid obstacles, and the impulses on these.
namespace mpm {
namespace {

// Callers that know no walls and no mass leave the last arguments out.
#define MPM_CONTACT_SCHEMA \
  "Tensor velocity, " MPM_OBSTACLES_SCHEMA ", " MPM_TOPOLOGY_SCHEMA ", int[] wall_kind=[], float[] wall_plane=[]"
#define MPM_CONTACT_PARAMETERS                                                          \
  const Tensor &velocity, MPM_OBSTACLES_PARAMETERS, const std::vector<Tensor>&topology, \
      const std::vector<double>&lattice, const std::vector<int64_t>&layout, MPM_CONTACT_WALLS_PARAMETERS
#define MPM_CONTACT_ARGUMENTS velocity, MPM_OBSTACLES_ARGUMENTS, topology, lattice, layout, wall_kind, wall_plane

void check_velocity(const Tensor& velocity) {
  STD_TORCH_CHECK(velocity.dim() == 2 && (velocity.size(1) == 2 || velocity.size(1) == 3),
                  "velocity must have shape [N, 2] or [N, 3], got ", shape_of(velocity));
  check_count(velocity.size(0), "velocity", "nodes");
}

template <class T, int D>
ContactArguments<T, D> contact_arguments(MPM_CONTACT_PARAMETERS) {
  const PackedTopology blocks(topology, lattice, layout);
  auto a = obstacle_arguments<T, D>(velocity, blocks, MPM_OBSTACLES_ARGUMENTS);
  check_scenes(a, blocks.scenes<T, D>(velocity));
  set_walls(a, wall_kind, wall_plane);
  a.max_blocks = blocks.max_blocks<D>();
  a.block = blocks.block_pointer(velocity);
  const auto v = node_input<T>(velocity, "velocity", velocity, blocks.node_count<D>());
  a.velocity = v.pointer;
  a.stride = v.stride;
  return a;
}

// Of the nodes [N]; all of them have mass where it is not given.
template <class T, int D>
void set_mass(ContactArguments<T, D>& a, const OptionalTensor& mass, const Tensor& velocity) {
  if (!has(mass)) return;
  check_shape(*mass, "mass", {velocity.size(0)});
  check_like(*mass, "mass", velocity);
  a.mass = static_cast<const T*>(mass->data_ptr());
  a.mass_stride = mass->stride(0);
}

Tensor contact(MPM_CONTACT_PARAMETERS, const OptionalTensor& mass) {
  const DeviceScope device(velocity);
  check_velocity(velocity);
  Tensor rows = empty(velocity, {velocity.size(0), 1 + velocity.size(1)});
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    auto a = contact_arguments<T, D>(MPM_CONTACT_ARGUMENTS);
    set_mass(a, mass, velocity);
    a.result = static_cast<T*>(rows.data_ptr());
    backend::contact(a, device.stream());
  });
  return rows;
}

// `rows` is the adjoint of the obstacles by each slot, empty unless it is wanted.
std::tuple<Tensor, Tensor> contact_backward(const Tensor& grad, bool wants_rows, MPM_CONTACT_PARAMETERS,
                                            const OptionalTensor& mass) {
  const DeviceScope device(velocity);
  check_velocity(velocity);
  Tensor grad_velocity = empty(velocity, {velocity.size(0), 1 + velocity.size(1)}), rows;
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    auto a = contact_arguments<T, D>(MPM_CONTACT_ARGUMENTS);
    check_shape(grad, "grad", {velocity.size(0), D});
    const auto g = node_input<T>(grad, "grad", velocity, velocity.size(0));
    a.grad = g.pointer;
    a.grad_stride = g.stride;
    set_mass(a, mass, velocity);
    a.result = static_cast<T*>(grad_velocity.data_ptr());
    rows = empty(velocity, {wants_rows ? a.max_blocks : 0, a.obstacles, ObstacleRow<T, D>::width});
    if (wants_rows) a.row_grad = static_cast<T*>(rows.data_ptr());
    backend::contact_backward(a, device.stream());
  });
  return {grad_velocity, rows};
}

// With the mass of nodes [N]. `scenes` becomes the number of scenes of the table.
template <class T, int D>
ContactImpulsesArguments<T, D> impulses_arguments(int64_t& scenes, const Tensor& mass, MPM_CONTACT_PARAMETERS) {
  ContactImpulsesArguments<T, D> a;
  a.contact = contact_arguments<T, D>(MPM_CONTACT_ARGUMENTS);
  check_shape(mass, "mass", {velocity.size(0)});
  check_like(mass, "mass", velocity);
  a.contact.mass = a.mass = static_cast<const T*>(mass.data_ptr());
  a.contact.mass_stride = a.mass_stride = mass.stride(0);
  scenes = PackedTopology(topology, lattice, layout).scenes<T, D>(velocity);
  return a;
}

Tensor contact_impulses(const Tensor& mass, MPM_CONTACT_PARAMETERS) {
  const DeviceScope device(velocity);
  check_velocity(velocity);
  Tensor sums, slots;
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    int64_t scenes;
    auto a = impulses_arguments<T, D>(scenes, mass, MPM_CONTACT_ARGUMENTS);
    sums = no_impulses(velocity, scenes, a.contact.obstacles, D);
    a.impulse =
        impulse_arguments<D>(PackedLattice(lattice, layout), sums, 0, a.contact.obstacles, a.contact.max_blocks, slots);
    backend::contact_impulses(a, device.stream());
  });
  return sums;
}

// Rows [adjoint of the mass, that of the velocity]; `rows` as in the adjoint of contact.
std::tuple<Tensor, Tensor> contact_impulses_backward(const Tensor& grad_impulse, bool wants_rows, const Tensor& mass,
                                                     MPM_CONTACT_PARAMETERS) {
  const DeviceScope device(velocity);
  check_velocity(velocity);
  Tensor grad_nodes = empty(velocity, {velocity.size(0), 1 + velocity.size(1)}), rows;
  const Tensor grad_after = zeros(velocity, {velocity.size(0), velocity.size(1)});
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    int64_t scenes;
    auto a = impulses_arguments<T, D>(scenes, mass, MPM_CONTACT_ARGUMENTS);
    ContactArguments<T, D>& c = a.contact;
    c.grad = static_cast<const T*>(grad_after.data_ptr());
    c.grad_stride = D;
    c.result = static_cast<T*>(grad_nodes.data_ptr());
    rows = empty(velocity, {wants_rows ? c.max_blocks : 0, c.obstacles, ObstacleRow<T, D>::width});
    if (wants_rows) c.row_grad = static_cast<T*>(rows.data_ptr());
    a.impulse = impulse_gradient<D>(PackedLattice(lattice, layout), grad_impulse, 0, c.obstacles,
                                    {scenes, c.obstacles, kImpulse<D>}, velocity);
    backend::contact_impulses_backward(a, device.stream());
  });
  return {grad_nodes, rows};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("contact(" MPM_CONTACT_SCHEMA ", Tensor? mass=None) -> Tensor");
  m.def("contact_backward(Tensor grad, bool wants_rows, " MPM_CONTACT_SCHEMA
        ", Tensor? mass=None) -> (Tensor velocity, Tensor rows)");
  m.def("contact_impulses(Tensor mass, " MPM_CONTACT_SCHEMA ") -> Tensor");
  m.def("contact_impulses_backward(Tensor grad_impulse, bool wants_rows, Tensor mass, " MPM_CONTACT_SCHEMA
        ") -> (Tensor nodes, Tensor rows)");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("contact", TORCH_BOX(&mpm::contact));
  m.impl("contact_backward", TORCH_BOX(&mpm::contact_backward));
  m.impl("contact_impulses", TORCH_BOX(&mpm::contact_impulses));
  m.impl("contact_impulses_backward", TORCH_BOX(&mpm::contact_impulses_backward));
}
