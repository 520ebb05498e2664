#include <cmath>

#include "grid/topology.op.h"
#include "transfer/kernels.h"

// G2P and the end of the step in one op.
namespace mpm {
namespace {

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> g2p_advance(
    const Tensor& x, const Tensor& velocity, const OptionalTensor& F, const OptionalTensor& J,
    const OptionalTensor& residual, const OptionalTensor& scene_dt, double dt, bool affine, int64_t stress_form,
    const std::vector<Tensor>& topology, const std::vector<double>& lattice, const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  check_positions(x);
  const int64_t P = x.size(0), D_ = x.size(1);
  Tensor x_next = empty_particles(x, {P, D_}), v = empty_particles(x, {P, D_}), C = result(x, affine, {P, D_, D_}),
         F_next = result(x, has(F), {P, D_, D_}), J_next = result(x, has(J), {P}),
         residual_next = result(x, has(residual), {P, D_});
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    G2PAdvanceArguments<T, D> a;
    a.gather.topology = blocks.unpack<T, D>(x);
    a.gather.x = input<T>(x, "x", x, {P, D});
    check_shape(velocity, "velocity", {blocks.node_count<D>(), D});
    a.gather.nodes = node_input<T>(velocity, "velocity", x, blocks.node_count<D>());
    a.gather.moment_scale = blocks.inverse_inertia();
    a.gather.lost = NAN;
    a.gather.value = field<T>(v);
    a.gather.moment = field<T>(C);
    a.F = input<T>(F, "F", x, {P, D, D});
    a.J = input<T>(J, "J", x, {P});
    a.residual = input<T>(residual, "residual", x, {P, D});
    a.scene_dt = input<T>(scene_dt, "scene_dt", x, {a.gather.topology.scenes});
    a.dt = dt;
    a.form = stress_form_of(stress_form);
    a.x_next = field<T>(x_next);
    a.F_next = field<T>(F_next);
    a.J_next = field<T>(J_next);
    a.residual_next = field<T>(residual_next);
    backend::g2p_advance(blocks.order(), a, device.stream());
  });
  return {x_next, v, C, F_next, J_next, residual_next};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "g2p_advance(Tensor x, Tensor velocity, Tensor? F, Tensor? J, Tensor? residual, Tensor? scene_dt, float dt, "
      "bool affine, int stress_form, " MPM_TOPOLOGY_SCHEMA
      ") -> (Tensor x, Tensor v, Tensor C, Tensor F, Tensor J, Tensor residual)");
}
#endif

MPM_LIBRARY_IMPL(m) { m.impl("g2p_advance", TORCH_BOX(&mpm::g2p_advance)); }
