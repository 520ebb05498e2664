#include "grid/kernels.h"
#include "grid/obstacle.op.h"

// Contact of the grid with rigid obstacles.
namespace mpm {
namespace {

#define MPM_CONTACT_SCHEMA "Tensor velocity, " MPM_OBSTACLES_SCHEMA ", " MPM_TOPOLOGY_SCHEMA
#define MPM_CONTACT_PARAMETERS                                                          \
  const Tensor &velocity, MPM_OBSTACLES_PARAMETERS, const std::vector<Tensor>&topology, \
      const std::vector<double>&lattice, const std::vector<int64_t>&layout
#define MPM_CONTACT_ARGUMENTS velocity, MPM_OBSTACLES_ARGUMENTS, topology, lattice, layout

void check_velocity(const Tensor& velocity) {
  STD_TORCH_CHECK(velocity.dim() == 2 && (velocity.size(1) == 2 || velocity.size(1) == 3),
                  "velocity must have shape [N, 2] or [N, 3], got ", shape_of(velocity));
  check_count(velocity.size(0), "velocity", "nodes");
}

template <class T, int D>
ContactArguments<T, D> contact_arguments(MPM_CONTACT_PARAMETERS) {
  const PackedTopology blocks(topology, lattice, layout);
  auto a = obstacle_arguments<T, D>(velocity, blocks, MPM_OBSTACLES_ARGUMENTS);
  a.max_blocks = blocks.max_blocks<D>();
  a.block = blocks.block_pointer(velocity);
  const auto v = node_input<T>(velocity, "velocity", velocity, blocks.node_count<D>());
  a.velocity = v.pointer;
  a.stride = v.stride;
  return a;
}

Tensor contact(MPM_CONTACT_PARAMETERS) {
  const DeviceScope device(velocity);
  check_velocity(velocity);
  Tensor rows = empty(velocity, {velocity.size(0), 1 + velocity.size(1)});
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    auto a = contact_arguments<T, D>(MPM_CONTACT_ARGUMENTS);
    a.result = static_cast<T*>(rows.data_ptr());
    backend::contact(a, device.stream());
  });
  return rows;
}

// `rows` is the adjoint of the obstacles by each slot, empty unless it is wanted.
std::tuple<Tensor, Tensor> contact_backward(const Tensor& grad, bool wants_rows, MPM_CONTACT_PARAMETERS) {
  const DeviceScope device(velocity);
  check_velocity(velocity);
  Tensor grad_velocity = empty(velocity, {velocity.size(0), 1 + velocity.size(1)}), rows;
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    auto a = contact_arguments<T, D>(MPM_CONTACT_ARGUMENTS);
    check_shape(grad, "grad", {velocity.size(0), D});
    const auto g = node_input<T>(grad, "grad", velocity, velocity.size(0));
    a.grad = g.pointer;
    a.grad_stride = g.stride;
    a.result = static_cast<T*>(grad_velocity.data_ptr());
    rows = empty(velocity, {wants_rows ? a.max_blocks : 0, a.obstacles, ObstacleRow<T, D>::width});
    if (wants_rows) a.row_grad = static_cast<T*>(rows.data_ptr());
    backend::contact_backward(a, device.stream());
  });
  return {grad_velocity, rows};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("contact(" MPM_CONTACT_SCHEMA ") -> Tensor");
  m.def("contact_backward(Tensor grad, bool wants_rows, " MPM_CONTACT_SCHEMA ") -> (Tensor velocity, Tensor rows)");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("contact", TORCH_BOX(&mpm::contact));
  m.impl("contact_backward", TORCH_BOX(&mpm::contact_backward));
}
