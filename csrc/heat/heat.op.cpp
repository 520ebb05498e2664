#include "grid/topology.op.h"
#include "heat/cell.h"
#include "heat/kernels.h"

// Implicit heat step on the nodes, and its operator alone.
namespace mpm {
namespace {

// Values per node or per scene, packed and aligned for loads of four.
template <class T>
class Values {
 public:
  Values(const OptionalTensor& t, const char* name, const Tensor& x, ScalarType type, int64_t size) {
    if (!has(t)) return;
    check_shape(*t, name, {size});
    check_type(*t, name, type, x);
    packed_ = *t;
    if (size > 1 && (t->stride(0) != 1 || reinterpret_cast<uintptr_t>(t->data_ptr()) % 16 != 0)) {
      packed_ = empty(*t, {size});
      torch::stable::copy_(packed_, *t);
    }
    pointer = static_cast<const T*>(packed_.data_ptr());
  }
  const T* pointer = nullptr;

 private:
  Tensor packed_;
};

std::tuple<Tensor, Tensor, Tensor, Tensor> heat_cg(
    const Tensor& x, const Tensor& conductance, const Tensor& heat_capacity, const OptionalTensor& theta,
    const OptionalTensor& source, const OptionalTensor& exchange, const OptionalTensor& fixed,
    const OptionalTensor& scene_dt, double dt, const OptionalTensor& scene_tolerance, double tolerance,
    double relative_tolerance, const OptionalTensor& scene_most, int64_t max_iterations, int64_t method,
    double /*adjoint_tolerance*/, const std::vector<Tensor>& topology, const std::vector<double>& lattice,
    const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  STD_TORCH_CHECK(method == 0 || method == 1, "method must be 0 (conjugate gradients) or 1 (Chebyshev), got ", method);
  STD_TORCH_CHECK(max_iterations >= 0 && max_iterations <= INT32_MAX, "max_iterations must be 0 to 2^31 - 1, got ",
                  max_iterations);
  STD_TORCH_CHECK(heat_capacity.defined(), "heat_capacity must be a tensor, got None");
  Tensor increment, iterations, residual, converged;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    HeatArguments<T, D> a;
    a.topology = blocks.unpack<T, D>(x);
    const int64_t N = blocks.node_count<D>(), scenes = a.topology.scenes;
    a.x = input<T>(x, "x", x, {x.size(0), D});
    a.conductance = input<T>(conductance, "conductance", x, {x.size(0)});
    const ScalarType type = x.scalar_type();
    const Values<T> M(heat_capacity, "heat_capacity", x, type, N), u(theta, "theta", x, type, N),
        h(source, "source", x, type, N), X(exchange, "exchange", x, type, N),
        steps(scene_dt, "scene_dt", x, type, scenes), limit(scene_tolerance, "scene_tolerance", x, type, scenes);
    const Values<bool> held(fixed, "fixed", x, ScalarType::Bool, N);
    const Values<int> most(scene_most, "scene_max_iterations", x, ScalarType::Int, scenes);
    a.heat_capacity = M.pointer;
    a.theta = u.pointer;
    a.source = h.pointer;
    a.exchange = X.pointer;
    a.fixed = held.pointer;
    a.dt = dt;
    a.scene_dt = steps.pointer;
    a.tolerance = tolerance;
    a.scene_tolerance = limit.pointer;
    a.relative_tolerance = relative_tolerance;
    a.most = int(max_iterations);
    a.scene_most = most.pointer;
    a.method = HeatMethod(method);
    a.deterministic = blocks.deterministic();
    increment = empty(x, {N});
    iterations = empty_int(x, {scenes});
    residual = empty(x, {scenes});
    converged = empty(x, {scenes}, ScalarType::Bool);
    a.increment = static_cast<T*>(increment.data_ptr());
    a.iterations = static_cast<int*>(iterations.data_ptr());
    a.residual = static_cast<T*>(residual.data_ptr());
    a.converged = static_cast<bool*>(converged.data_ptr());
    const Tensor workspace = empty(x, {backend::heat_workspace(a, device.stream())}, ScalarType::Byte);
    a.workspace = workspace.data_ptr();
    backend::heat_cg(blocks.order(), a, device.stream());
  });
  return {increment, iterations, residual, converged};
}

// Inputs of the operator and its stencil.
template <class T, int D>
HeatOperatorArguments<T, D> operator_arguments(const PackedTopology& blocks, const Tensor& x,
                                               const Tensor& conductance) {
  HeatOperatorArguments<T, D> a;
  a.topology = blocks.unpack<T, D>(x);
  a.x = input<T>(x, "x", x, {x.size(0), D});
  a.conductance = input<T>(conductance, "conductance", x, {x.size(0)});
  a.deterministic = blocks.deterministic();
  return a;
}

Tensor heat_operator(const Tensor& x, const Tensor& conductance, const OptionalTensor& nodes,
                     const std::vector<Tensor>& topology, const std::vector<double>& lattice,
                     const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  Tensor sum;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    auto a = operator_arguments<T, D>(blocks, x, conductance);
    const int64_t N = blocks.node_count<D>();
    const Values<T> u(nodes, "nodes", x, x.scalar_type(), N);
    a.nodes = u.pointer;
    sum = zeros(x, {N});
    a.sum = static_cast<T*>(sum.data_ptr());
    const Tensor workspace = empty(x, {backend::heat_operator_workspace(a, device.stream())}, ScalarType::Byte);
    a.workspace = workspace.data_ptr();
    backend::heat_operator(blocks.order(), a, device.stream());
  });
  return sum;
}

Tensor heat_stencil(const Tensor& x, const Tensor& conductance, const std::vector<Tensor>& topology,
                    const std::vector<double>& lattice, const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  Tensor sum;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    auto a = operator_arguments<T, D>(blocks, x, conductance);
    sum = zeros(x, {kPairs<D>, blocks.node_count<D>()});
    a.sum = static_cast<T*>(sum.data_ptr());
    backend::heat_stencil(blocks.order(), a, device.stream());
  });
  return sum;
}

Tensor heat_patches(const Tensor& inverse, const Tensor& rows, const Tensor& patches, const Tensor& r) {
  check_rank(r, "r", 1);
  check_count(r.size(0), "r", "nodes");
  check_rank(rows, "rows", 2);
  check_like(inverse, "inverse", r);
  const int64_t N = r.size(0), K = rows.size(1);
  STD_TORCH_CHECK(K == 4 || K == 8, "rows must have shape [N, 4] or [N, 8], got ", shape_of(rows));
  check_shape(inverse, "inverse", {N, K, K});
  STD_TORCH_CHECK(inverse.is_contiguous(), "inverse must be contiguous");
  STD_TORCH_CHECK(r.is_contiguous(), "r must be contiguous");
  const Tensor sum = empty(r, {N}), solved = empty(r, {N, K});
  const DeviceScope device(r);
  dispatch(r, "r", K == 4 ? 2 : 3, [&]<class T, int D>() {
    PatchArguments<T, D> a;
    a.count = N;
    a.inverse = static_cast<const T*>(inverse.data_ptr());
    a.rows = int_pointer(rows, "rows", r, {N, K});
    a.patches = int_pointer(patches, "patches", r, {N, K});
    a.r = static_cast<const T*>(r.data_ptr());
    a.solved = static_cast<T*>(solved.data_ptr());
    a.sum = static_cast<T*>(sum.data_ptr());
    backend::heat_patches(a, device.stream());
  });
  return sum;
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "heat_cg(Tensor x, Tensor conductance, Tensor heat_capacity, Tensor? theta, Tensor? source, Tensor? exchange, "
      "Tensor? fixed, Tensor? scene_dt, float dt, Tensor? scene_tolerance, float tolerance, float relative_tolerance, "
      "Tensor? scene_max_iterations, int max_iterations, int method, float adjoint_tolerance, " MPM_TOPOLOGY_SCHEMA
      ") -> (Tensor increment, Tensor iterations, Tensor residual, Tensor converged)");
  m.def("heat_operator(Tensor x, Tensor conductance, Tensor? nodes, " MPM_TOPOLOGY_SCHEMA ") -> Tensor");
  m.def("heat_stencil(Tensor x, Tensor conductance, " MPM_TOPOLOGY_SCHEMA ") -> Tensor");
  m.def("heat_patches(Tensor inverse, Tensor rows, Tensor patches, Tensor r) -> Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("heat_cg", TORCH_BOX(&mpm::heat_cg));
  m.impl("heat_operator", TORCH_BOX(&mpm::heat_operator));
  m.impl("heat_stencil", TORCH_BOX(&mpm::heat_stencil));
  m.impl("heat_patches", TORCH_BOX(&mpm::heat_patches));
}
