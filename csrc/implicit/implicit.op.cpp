#include "common/team.h"
#include "grid/topology.op.h"
#include "implicit/kernels.h"
#include "transfer/kernels.h"
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
#include "cuda/graph.h"
#endif

// Hessian of an implicit step: its product with node vectors, its diagonal blocks, and the solve.
namespace mpm {
namespace {

// Product of the tangents alone: a gather and a scatter, on the CPU with the tangents in the scatter, on CUDA in the
// gather, where their loads overlap with others. Intermediate values have a buffer for many products.
template <class T, int D>
class TangentProduct {
 public:
  TangentProduct(const Tensor& x, const Tensor& tangent, int64_t stress_form, const PackedTopology& blocks)
      : order_(blocks.order()), between_(empty_particles(x, {x.size(0), D, D})) {
    const int64_t P = x.size(0);
    const StressForm form = stress_form_of(stress_form);
    const Field<const T> tangents = input<T>(tangent, "tangent", x, {P, kTangentEntries<D>});
    GatherArguments<T, D> gather;
    gather.topology = scatter_.topology = blocks.unpack<T, D>(x);
    gather.x = scatter_.x = input<T>(x, "x", x, {P, D});
    gather.moment_scale = blocks.inverse_inertia();
    (form == StressForm::mls ? gather.moment : gather.gradient) = field<T>(between_);
    scatter_.deterministic = blocks.deterministic();
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
    gather_ = gather;
    scatter_.form = form;
    scatter_.gradient = field<const T>(between_);
    scatter_.tangent = tangents;
#else
    gather_ = {gather, tangents};
    scatter_.moment_scale = gather.moment_scale;
    (form == StressForm::mls ? scatter_.moment : scatter_.gradient) = field<const T>(between_);
#endif
  }

  // Adds to `to`.
  void operator()(const T* direction, T* to, backend::Stream stream) {
    scatter_.nodes = {to, D, D};
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
    gather_.nodes = {direction, D, D};
    backend::gather(order_, gather_, stream);
    backend::tangent_scatter(order_, scatter_, stream);
#else
    gather_.gather.nodes = {direction, D, D};
    backend::tangent_gather(order_, gather_, stream);
    backend::scatter(order_, scatter_, stream);
#endif
  }

 private:
  int64_t order_;
  Tensor between_;
#if MPM_BACKEND == MPM_BACKEND_IS_cpu
  GatherArguments<T, D> gather_;
  TangentScatterArguments<T, D> scatter_;
#else
  TangentGatherArguments<T, D> gather_;
  ScatterArguments<T, D> scatter_;
#endif
};

// A contiguous node tensor [N, ...].
template <class T>
const T* node_pointer(const Tensor& t, const char* name, const Tensor& x, const Shape& shape) {
  check_shape(t, name, shape);
  check_like(t, name, x);
  STD_TORCH_CHECK(t.is_contiguous(), name, " must be contiguous");
  return static_cast<const T*>(t.data_ptr());
}

Tensor implicit_apply(const Tensor& x, const Tensor& direction, const Tensor& tangent, int64_t stress_form,
                      const std::vector<Tensor>& topology, const std::vector<double>& lattice,
                      const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  Tensor result;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    const int64_t N = blocks.node_count<D>();
    const T* along = node_pointer<T>(direction, "direction", x, {N, D});
    result = zeros(x, {N, D});
    TangentProduct<T, D>(x, tangent, stress_form, blocks)(along, static_cast<T*>(result.data_ptr()), device.stream());
  });
  return result;
}

Tensor implicit_node_blocks(const Tensor& x, const Tensor& tangent, int64_t stress_form,
                            const std::vector<Tensor>& topology, const std::vector<double>& lattice,
                            const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  Tensor result;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    const int64_t P = x.size(0);
    result = zeros(x, {blocks.node_count<D>(), kSymmetric<D>});
    NodeBlocksArguments<T, D> a;
    a.topology = blocks.unpack<T, D>(x);
    a.x = input<T>(x, "x", x, {P, D});
    a.tangent = input<T>(tangent, "tangent", x, {P, kTangentEntries<D>});
    a.form = stress_form_of(stress_form);
    a.deterministic = blocks.deterministic();
    a.nodes = {static_cast<T*>(result.data_ptr()), kSymmetric<D>, kSymmetric<D>};
    backend::node_blocks(blocks.order(), a, device.stream());
  });
  return result;
}

template <class T, int D>
void set_images(ConjugateGradientsArguments<T, D>& a, const Tensor& images, const Tensor& x) {
  check_rank(images, "images", 2);
  check_count(images.size(0), "images", "groups");
  a.image_groups = int(images.size(0));
  a.images = int_pointer(images, "images", x, {images.size(0), 1 << D});
}

// Minimum number of iterations of a solve whose duration matters.
constexpr int kWorthATeam = 16;

// Iterations until all scenes are done: of a graph that the device ends, or with checks by the host.
template <class T, int D, class Iteration>
void iterate(ConjugateGradientsArguments<T, D> a, [[maybe_unused]] const Tensor& x, backend::Stream stream,
             const Iteration& iteration) {
#if MPM_BACKEND == MPM_BACKEND_IS_cuda && CUDART_VERSION >= 13000
  if (a.max_iterations == 0 || a.max_blocks == 0 || a.scenes == 0) return;
  const auto once = [&](cudaStream_t captured, unsigned long long condition) {
    iteration(captured);
    a.loop = condition;
    backend::cg_look(a, captured);
  };
  repeat(stream, once, [&] {
    for (const ConjugateGradients& scene : on_host(a.scene, a.scenes, stream))
      if (scene.state == kSolving && scene.iterations < a.max_iterations) return true;
    return false;
  });
#else
  int left = 0;
  const Tensor unfinished = empty_int(x, {1});
  a.unfinished = static_cast<int*>(unfinished.data_ptr());
  a.unfinished_on_host = &left;
  constexpr int between_looks = MPM_BACKEND == MPM_BACKEND_IS_cpu ? 1 : 8;
  for (int k = 0; k < a.max_iterations; k++) {
    if (k % between_looks == 0) {
      backend::cg_look(a, stream);
      if (left == 0) break;
    }
    iteration(stream);
  }
#endif
}

std::tuple<Tensor, Tensor> implicit_cg(const Tensor& x, const Tensor& rhs, const Tensor& mass, const Tensor& inverse,
                                       const OptionalTensor& local, const OptionalTensor& held,
                                       const OptionalTensor& images, const Tensor& tangent, const Tensor& relative,
                                       int64_t max_iterations, int64_t stress_form, const std::vector<Tensor>& topology,
                                       const std::vector<double>& lattice, const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  STD_TORCH_CHECK(max_iterations >= 0 && max_iterations <= INT32_MAX, "max_iterations must be 0 to 2^31 - 1, got ",
                  max_iterations);
  Tensor solution, scalars;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    const int64_t N = blocks.node_count<D>();
    const Topology<T, D> t = blocks.unpack<T, D>(x);
    ConjugateGradientsArguments<T, D> a;
    a.max_blocks = t.max_blocks;
    a.scenes = t.scenes;
    a.blocks_per_scene = t.geometry.blocks_per_scene;
    a.block = t.block;
    a.mass = node_pointer<T>(mass, "mass", x, {N});
    a.inverse = node_pointer<T>(inverse, "inverse", x, {N, kSymmetric<D>});
    if (local) a.local = node_pointer<T>(*local, "local", x, {N, kSymmetric<D>});
    if (held) a.held = node_pointer<T>(*held, "held", x, {N, D});
    if (images) set_images(a, *images, x);
    a.rhs = node_pointer<T>(rhs, "rhs", x, {N, D});
    a.relative = node_pointer<T>(relative, "relative", x, {t.scenes});
    static_assert(sizeof(ConjugateGradients) == 5 * sizeof(double));
    solution = zeros(x, {N, D});
    scalars = empty(x, {t.scenes, 5}, ScalarType::Double);
    Tensor r = zeros(x, {N, D}), p = zeros(x, {N, D}), q = zeros(x, {N, D});
    const Tensor slots = empty(x, {int64_t(t.max_blocks) + t.scenes}, ScalarType::Double);
    a.x = static_cast<T*>(solution.data_ptr());
    a.r = static_cast<T*>(r.data_ptr());
    a.p = static_cast<T*>(p.data_ptr());
    a.q = static_cast<T*>(q.data_ptr());
    a.slots = static_cast<double*>(slots.data_ptr());
    a.scene = static_cast<ConjugateGradients*>(scalars.data_ptr());
    TangentProduct<T, D> product(x, tangent, stress_form, blocks);
    a.max_iterations = int(max_iterations);
    backend::cg_begin(a, device.stream());
    with_team(x.size(0) * kWorthATeam, [&] {
      iterate(a, x, device.stream(), [&](backend::Stream stream) {
        backend::clear(q, stream);
        product(a.p, a.q, stream);
        backend::cg_advance(a, stream);
      });
    });
  });
  return {solution, scalars};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("implicit_apply(Tensor x, Tensor direction, Tensor tangent, int stress_form, " MPM_TOPOLOGY_SCHEMA
        ") -> Tensor");
  m.def("implicit_node_blocks(Tensor x, Tensor tangent, int stress_form, " MPM_TOPOLOGY_SCHEMA ") -> Tensor");
  m.def(
      "implicit_cg(Tensor x, Tensor rhs, Tensor mass, Tensor inverse, Tensor? local, Tensor? held, Tensor? images, "
      "Tensor tangent, Tensor relative, int max_iterations, int stress_form, " MPM_TOPOLOGY_SCHEMA
      ") -> (Tensor solution, Tensor scalars)");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("implicit_apply", TORCH_BOX(&mpm::implicit_apply));
  m.impl("implicit_node_blocks", TORCH_BOX(&mpm::implicit_node_blocks));
  m.impl("implicit_cg", TORCH_BOX(&mpm::implicit_cg));
}
