#include "bodies/bodies.op.h"

// One step of free bodies in contact with the nodes.
namespace mpm {
namespace {

using Step = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;

// Velocities of the nodes after contact [N, D], rows of the bodies at the end of the step, and their report; where it
// is wanted the solution [B, K, n], and the derivatives of the impulses by it [B, K n, K n].
Step free_bodies(const Tensor& velocity, const Tensor& mass, MPM_BODIES_PARAMETERS, double dt, bool wants_solution,
                 const std::vector<Tensor>& topology, const std::vector<double>& lattice,
                 const std::vector<int64_t>& layout, MPM_CONTACT_WALLS_PARAMETERS) {
  const DeviceScope device(velocity);
  STD_TORCH_CHECK(velocity.dim() == 2 && (velocity.size(1) == 2 || velocity.size(1) == 3),
                  "velocity must have shape [N, 2] or [N, 3], got ", shape_of(velocity));
  Tensor after, rows, report, motion, slopes;
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    const PackedTopology blocks(topology, lattice, layout);
    const int64_t nodes = blocks.node_count<D>();
    check_shape(velocity, "velocity", {nodes, D});
    check_shape(mass, "mass", {nodes});
    check_like(mass, "mass", velocity);
    BodiesCall<T, D> call(
        {bodies, body_shape, body_sizes, body_contact, body_owner, body_joint, max_iterations, tolerance}, velocity,
        blocks, wall_kind, wall_plane, blocks.scenes<T, D>(velocity), dt);
    if (wants_solution) {
      const int64_t scenes = call.rows().size(0), K = call.rows().size(1), n = kMotions<D>;
      motion = empty(velocity, {scenes, K, n}, ScalarType::Double);
      slopes = empty(velocity, {scenes, K * n, K * n}, ScalarType::Double);
      call.set_solution(motion, slopes);
    }
    after = empty(velocity, sizes_of(velocity));
    torch::stable::copy_(after, velocity);
    const int slots = blocks.max_blocks<D>();
    call.run(blocks.block_pointer(velocity), slots, slots, static_cast<const T*>(mass.data_ptr()), mass.stride(0),
             static_cast<T*>(after.data_ptr()), D, device.stream());
    rows = call.rows();
    report = call.report();
  });
  return {after, rows, report, motion, slopes};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("free_bodies(Tensor velocity, Tensor mass, " MPM_BODIES_SCHEMA
        ", float dt, bool wants_solution, " MPM_TOPOLOGY_SCHEMA
        ", int[] wall_kind=[], float[] wall_plane=[]) -> (Tensor velocity, Tensor rows, Tensor report, Tensor motion, "
        "Tensor slopes)");
}
#endif

MPM_LIBRARY_IMPL(m) { m.impl("free_bodies", TORCH_BOX(&mpm::free_bodies)); }
