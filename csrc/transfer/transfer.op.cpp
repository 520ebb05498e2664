#include <cmath>

#include "grid/topology.op.h"
#include "transfer/kernels.h"

// P2G, G2P and the underlying channel-wise scatter and gather.
namespace mpm {
namespace {

template <class T, int D>
P2GArguments<T, D> p2g_arguments(const Tensor& x, const Tensor& mass, const Tensor& v, const OptionalTensor& affine,
                                 const OptionalTensor& stress, const OptionalTensor& volume,
                                 const OptionalTensor& scene_dt, double dt, int64_t stress_form,
                                 const PackedTopology& blocks) {
  const int64_t P = x.size(0);
  STD_TORCH_CHECK(!has(stress) || has(volume), "stress needs volume");
  P2GArguments<T, D> a;
  a.topology = blocks.unpack<T, D>(x);
  a.x = input<T>(x, "x", x, {P, D});
  a.mass = input<T>(mass, "mass", x, {P});
  a.velocity = input<T>(v, "v", x, {P, D});
  a.affine = input<T>(affine, "C", x, {P, D, D});
  a.stress = input<T>(stress, "stress", x, {P, D, D});
  a.volume = has(stress) ? input<T>(volume, "volume", x, {P}) : Field<const T>{};
  a.scene_dt = input<T>(scene_dt, "scene_dt", x, {a.topology.scenes});
  a.dt = dt;
  a.form = stress_form_of(stress_form);
  a.deterministic = blocks.deterministic();
  return a;
}

Tensor p2g(const Tensor& x, const Tensor& mass, const Tensor& v, const OptionalTensor& C, const OptionalTensor& stress,
           const OptionalTensor& volume, const OptionalTensor& scene_dt, double dt, int64_t stress_form,
           const std::vector<Tensor>& topology, const std::vector<double>& lattice,
           const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  Tensor nodes;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    auto a = p2g_arguments<T, D>(x, mass, v, C, stress, volume, scene_dt, dt, stress_form, blocks);
    nodes = zeros(x, {blocks.node_count<D>(), 1 + D});
    a.nodes = {static_cast<T*>(nodes.data_ptr()), 1 + D, 1 + D};
    backend::p2g(blocks.order(), a, device.stream());
  });
  return nodes;
}

// Bits of `needs`, in the order of the returned tensors.
enum Need { kX = 1, kMass = 2, kVelocity = 4, kAffine = 8, kStress = 16, kVolume = 32, kDt = 64 };

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> p2g_backward(
    const Tensor& grad_nodes, const Tensor& x, const Tensor& mass, const Tensor& v, const OptionalTensor& C,
    const OptionalTensor& stress, const OptionalTensor& volume, const OptionalTensor& scene_dt, double dt,
    int64_t stress_form, int64_t needs, const std::vector<Tensor>& topology, const std::vector<double>& lattice,
    const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  check_positions(x);
  const int64_t P = x.size(0), D_ = x.size(1);
  const int64_t of_stress = has(stress) ? needs : 0;
  Tensor gx = result(x, needs & kX, {P, D_}), gm = result(x, needs & kMass, {P}),
         gv = result(x, needs & kVelocity, {P, D_}), gC = result(x, (needs & kAffine) && has(C), {P, D_, D_}),
         gs = result(x, of_stress & kStress, {P, D_, D_}), gV = result(x, of_stress & kVolume, {P}),
         gt = result(x, of_stress & kDt, {P});
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    P2GBackwardArguments<T, D> a;
    a.forward = p2g_arguments<T, D>(x, mass, v, C, stress, volume, scene_dt, dt, stress_form, blocks);
    a.grad_nodes = node_input<T>(grad_nodes, "grad_nodes", x, blocks.node_count<D>());
    STD_TORCH_CHECK(a.grad_nodes.channels == 1 + D, "grad_nodes must have 1 + D channels, got ", a.grad_nodes.channels);
    a.x = field<T>(gx);
    a.mass = field<T>(gm);
    a.velocity = field<T>(gv);
    a.affine = field<T>(gC);
    a.stress = field<T>(gs);
    a.volume = field<T>(gV);
    a.dt = field<T>(gt);
    backend::p2g_backward(blocks.order(), a, device.stream());
  });
  return {gx, gm, gv, gC, gs, gV, gt};
}

Tensor scatter(const Tensor& x, const Tensor& value, const OptionalTensor& moment, const OptionalTensor& gradient,
               double moment_scale, const std::vector<Tensor>& topology, const std::vector<double>& lattice,
               const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  Tensor nodes;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    check_rank(value, "value", 2);
    const int64_t P = x.size(0), K = value.size(1);
    check_count(K, "value", "channels");
    ScatterArguments<T, D> a;
    a.topology = blocks.unpack<T, D>(x);
    a.x = input<T>(x, "x", x, {P, D});
    a.value = input<T>(value, "value", x, {P, K});
    a.moment = input<T>(moment, "moment", x, {P, K, D});
    a.gradient = input<T>(gradient, "gradient", x, {P, K, D});
    a.moment_scale = moment_scale;
    a.deterministic = blocks.deterministic();
    nodes = zeros(x, {blocks.node_count<D>(), K});
    a.nodes = {static_cast<T*>(nodes.data_ptr()), K, int(K)};
    backend::scatter(blocks.order(), a, device.stream());
  });
  return nodes;
}

std::tuple<Tensor, Tensor, Tensor> gather_with(const Tensor& x, const Tensor& nodes, double moment_scale, double lost,
                                               bool moment, bool gradient, const PackedTopology& blocks) {
  check_positions(x);
  check_rank(nodes, "nodes", 2);
  check_count(nodes.size(1), "nodes", "channels");
  const int64_t P = x.size(0), K = nodes.size(1), D_ = x.size(1);
  Tensor value = empty_particles(x, {P, K}), moments = result(x, moment, {P, K, D_}),
         gradients = result(x, gradient, {P, K, D_});
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    GatherArguments<T, D> a;
    a.topology = blocks.unpack<T, D>(x);
    a.x = input<T>(x, "x", x, {P, D});
    a.nodes = node_input<T>(nodes, "nodes", x, blocks.node_count<D>());
    a.moment_scale = moment_scale;
    a.lost = lost;
    a.value = field<T>(value);
    a.moment = field<T>(moments);
    a.gradient = field<T>(gradients);
    backend::gather(blocks.order(), a, device.stream());
  });
  return {value, moments, gradients};
}

std::tuple<Tensor, Tensor, Tensor> gather(const Tensor& x, const Tensor& nodes, double moment_scale, bool moment,
                                          bool gradient, const std::vector<Tensor>& topology,
                                          const std::vector<double>& lattice, const std::vector<int64_t>& layout) {
  return gather_with(x, nodes, moment_scale, 0, moment, gradient, PackedTopology(topology, lattice, layout));
}

std::tuple<Tensor, Tensor, Tensor> g2p(const Tensor& x, const Tensor& velocity, bool affine, bool gradient,
                                       const std::vector<Tensor>& topology, const std::vector<double>& lattice,
                                       const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  check_positions(x);
  check_shape(velocity, "velocity", {blocks.node_count(x.size(1)), x.size(1)});
  return gather_with(x, velocity, blocks.inverse_inertia(), NAN, affine, gradient, blocks);
}

Tensor position_gradient(const Tensor& x, const Tensor& value, const OptionalTensor& moment,
                         const OptionalTensor& gradient, const Tensor& nodes, double moment_scale,
                         const std::vector<Tensor>& topology, const std::vector<double>& lattice,
                         const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  check_positions(x);
  check_rank(nodes, "nodes", 2);
  Tensor result = empty_particles(x, {x.size(0), x.size(1)});
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    const int64_t P = x.size(0), K = nodes.size(1);
    PositionGradientArguments<T, D> a;
    a.topology = blocks.unpack<T, D>(x);
    a.x = input<T>(x, "x", x, {P, D});
    a.value = input<T>(value, "value", x, {P, K});
    a.moment = input<T>(moment, "moment", x, {P, K, D});
    a.gradient = input<T>(gradient, "gradient", x, {P, K, D});
    a.nodes = node_input<T>(nodes, "nodes", x, blocks.node_count<D>());
    a.moment_scale = moment_scale;
    a.position_gradient = field<T>(result);
    backend::position_gradient(blocks.order(), a, device.stream());
  });
  return result;
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "p2g(Tensor x, Tensor mass, Tensor v, Tensor? C, Tensor? stress, Tensor? volume, Tensor? scene_dt, float dt, "
      "int stress_form, " MPM_TOPOLOGY_SCHEMA ") -> Tensor");
  m.def(
      "p2g_backward(Tensor grad_nodes, Tensor x, Tensor mass, Tensor v, Tensor? C, Tensor? stress, Tensor? volume, "
      "Tensor? scene_dt, float dt, int stress_form, int needs, " MPM_TOPOLOGY_SCHEMA
      ") -> (Tensor x, Tensor mass, Tensor v, Tensor C, Tensor stress, Tensor volume, Tensor dt)");
  m.def("scatter(Tensor x, Tensor value, Tensor? moment, Tensor? gradient, float moment_scale, " MPM_TOPOLOGY_SCHEMA
        ") -> Tensor");
  m.def("gather(Tensor x, Tensor nodes, float moment_scale, bool moment, bool gradient, " MPM_TOPOLOGY_SCHEMA
        ") -> (Tensor value, Tensor moment, Tensor gradient)");
  m.def("g2p(Tensor x, Tensor velocity, bool affine, bool gradient, " MPM_TOPOLOGY_SCHEMA
        ") -> (Tensor v, Tensor C, Tensor grad_v)");
  m.def(
      "position_gradient(Tensor x, Tensor value, Tensor? moment, Tensor? gradient, Tensor nodes, float "
      "moment_scale, " MPM_TOPOLOGY_SCHEMA ") -> Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("p2g", TORCH_BOX(&mpm::p2g));
  m.impl("p2g_backward", TORCH_BOX(&mpm::p2g_backward));
  m.impl("scatter", TORCH_BOX(&mpm::scatter));
  m.impl("gather", TORCH_BOX(&mpm::gather));
  m.impl("g2p", TORCH_BOX(&mpm::g2p));
  m.impl("position_gradient", TORCH_BOX(&mpm::position_gradient));
}
