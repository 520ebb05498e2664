#include "heat/source.cuh"
#include "transfer/gather.cuh"

// Temperature to the nodes and back, one pass over the particles each.
namespace mpm::cuda {
namespace {

template <int Order, class T, int D>
struct HeatSurfaceSource {
  using Shape = SmallScatterShape<Order, T, D, 1, D, true>;
  static constexpr int resident = 0;
  static constexpr bool displaced = true;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position;
  Columns<const T, 1> volume;
  HeatValue<T> power;
  Columns<const T, 1> dissipated, rest;
  T share;
  TimeStep<T> time_step;

  explicit HeatSurfaceSource(const HeatSurfaceArguments<T, D>& a)
      : topology(a.topology),
        nodes(a.sums),
        position(a.x),
        volume(a.volume),
        power(a.power),
        dissipated(a.dissipated),
        rest(a.rest),
        share(T(a.share)),
        time_step{a.scene_dt, T(a.dt)} {}

  __device__ Contribution<T, D, 1, D> load(int p, int scene) const {
    Contribution<T, D, 1, D> c{};
    const T v = volume.at(p);
    c.plain[0] = power.pointer ? v * read_value(power, p, scene) : T(0);
    if (dissipated.present()) c.plain[0] += dissipated_power(share * dissipated.at(p), rest.at(p), time_step.of(scene));
#pragma unroll
    for (int d = 0; d < D; d++) c.gradient[d][d] = topology.geometry.inverse_dx * v;
    return c;
  }
  __device__ const Contribution<T, D, 1, D>& contribution(const Contribution<T, D, 1, D>& loaded) const {
    return loaded;
  }
};

// The exchange of particles with a held surface, and the rest of their conductance.
template <int Order, class T, int D>
struct HeatExchangeSource {
  using Shape = SmallScatterShape<Order, T, D, 0, 1, false>;
  static constexpr int resident = 0;
  static constexpr bool displaced = true;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position;
  HeatLayersArguments<T, D> layers;

  explicit HeatExchangeSource(const HeatExchangeArguments<T, D>& a)
      : topology(a.topology), nodes(a.nodes), position(a.layers.x), layers(a.layers) {}

  __device__ T load(int p, int scene) const {
    return heat_layer_of(layers, pose_of(layers.contact, layers.obstacle, scene), p);
  }
  __device__ Contribution<T, D, 0, 1> contribution(const T& loaded) const { return {{}, {loaded}, {}, {}}; }
  // A particle outside the grid does not conduct.
  __device__ void skip(int p, int) const { store_scalar(One<T>{p}, layers.exchange, T(0)); }
};

// Two sums in one launch: even thread blocks process the items of the first, odd ones those of the second.
template <class First, class Second>
__global__ void __launch_bounds__(First::Shape::threads) scatter_both_kernel(const First first, const Second second) {
  static_assert(First::Shape::threads == Second::Shape::threads);
  grid_dependency_sync();
  extern __shared__ __align__(16) char memory[];
  const unsigned block = blockIdx.x / 2, blocks = gridDim.x / 2;
  if (blockIdx.x % 2 == 0) {
    __shared__ ScatterMemory<typename First::Shape, First::displaced> shared;
    scatter_items(first, kNoOrder, block, blocks, memory, shared);
  } else {
    __shared__ ScatterMemory<typename Second::Shape, Second::displaced> shared;
    scatter_items(second, kNoOrder, block, blocks, memory, shared);
  }
}

template <class First, class Second>
void launch_scatter_both(const First& first, const Second& second, Stream stream) {
  const int64_t items = most_items(first.topology.max_blocks, first.topology.particles);
  if (items == 0) return;
  launch_in_chain(scatter_both_kernel<First, Second>, 2 * grid_size(items), First::Shape::threads,
                  std::max(First::Shape::shared_bytes, Second::Shape::shared_bytes), stream, first, second);
}

template <int Order_, class T_, int D_, bool Affine>
struct HeatGather {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = 2;
  static constexpr int resident = 7;
  static constexpr bool displaced = true;
  using Shape = SumShape<Order, T, D, K, 0, Affine, false, SlopeForm::none>;
  struct Loaded {
    int scene;
  };
  using Result = Sums<Shape>;
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position, gradient_before;
  Columns<const T, D * D> velocity_gradient;
  Columns<const T, 1> blend, number, theta_before, liquid_before;
  HeatValue<T> specific_heat, melting_point, latent_heat;
  TimeStep<T> time_step;
  T moment_scale;
  Columns<T, 1> theta, liquid;
  Columns<T, D> gradient;
  HeatVolumesArguments<T, D> volumes;
  double* largest;

  explicit HeatGather(const HeatToParticlesArguments<T, D>& a)
      : topology(a.topology),
        nodes(a.nodes),
        position(a.x),
        gradient_before(a.particles.gradient),
        velocity_gradient(a.velocity_gradient, D),
        blend(a.blend),
        number(a.number),
        theta_before(a.particles.theta),
        liquid_before(a.particles.liquid),
        specific_heat(a.specific_heat),
        melting_point(a.melting_point),
        latent_heat(a.latent_heat),
        time_step{a.scene_dt, T(a.dt)},
        moment_scale(T(a.moment_scale * double(a.topology.geometry.dx))),
        theta(a.theta),
        liquid(a.liquid),
        gradient(a.gradient),
        volumes(a.volumes),
        largest(a.largest) {}

  __device__ Loaded load(int, int scene) const { return {scene}; }
  template <class Support>
  __device__ Result compute(const Loaded&, const Weights<Order, T, D>& w, const Support& support) const {
    return sum_support<Shape>(support, w);
  }
  __device__ void write(int p, const Loaded& l, const Result& s) const {
    const T beta = blend.at(p);
    T warm = blended(s.value[0], s.value[1], theta_before.at(p), beta);
    if constexpr (Affine) {
      Vector<T, D> increment, average;
#pragma unroll
      for (int d = 0; d < D; d++) {
        increment[d] = moment_scale * s.moment[0][d];
        average[d] = moment_scale * s.moment[1][d];
      }
      const Vector<T, D> after = gradient_after(increment, average, read_vector(gradient_before, p), beta,
                                                read_matrix_or_zero<T, D>(velocity_gradient, p), time_step.of(l.scene));
#pragma unroll
      for (int d = 0; d < D; d++) gradient.at(p, d) = after[d];
    }
    if (liquid.present()) {
      T molten = liquid_before.at(p);
      const T front = melt(warm, molten, read_value(melting_point, p, l.scene), read_value(specific_heat, p, l.scene),
                           read_value(latent_heat, p, l.scene), number.at(p));
      if (front != T(0)) raise(largest + l.scene * kHeatStatusSize, ordered_bits(double(front)));
      liquid.at(p) = molten;
    }
    theta.at(p) = warm;
    if (volumes.volume.pointer) heat_volume(volumes, p);
  }
  // Particles outside the grid keep their temperature.
  __device__ void skip(int p) const {
    if (volumes.volume.pointer) heat_volume(volumes, p);
    theta.at(p) = theta_before.at(p);
#pragma unroll
    for (int d = 0; d < D; d++)
      if (Affine) gradient.at(p, d) = gradient_before.at(p, d);
    if (!liquid.present()) return;
    liquid.at(p) = liquid_before.at(p);
  }
};

}  // namespace

template <int Order, class T, int D>
void heat_to_nodes(const HeatToNodesArguments<T, D>& a, Stream stream) {
  launch_scatter(HeatSource<Order, T, D>(a), a.deterministic, stream);
}

template <int Order, class T, int D>
void heat_surface(const HeatSurfaceArguments<T, D>& a, Stream stream) {
  launch_scatter(HeatSurfaceSource<Order, T, D>(a), a.deterministic, stream);
}

template <int Order, class T, int D>
void heat_exchange(const HeatExchangeArguments<T, D>& a, Stream stream) {
  launch_scatter(HeatExchangeSource<Order, T, D>(a), a.deterministic, stream);
}

template <int Order, class T, int D>
void heat_exchange_and_surface(const HeatExchangeAndSurfaceArguments<T, D>& a, Stream stream) {
  launch_scatter_both(HeatExchangeSource<Order, T, D>(a.exchange), HeatSurfaceSource<Order, T, D>(a.surface), stream);
}

template <int Order, class T, int D>
void heat_to_particles(const HeatToParticlesArguments<T, D>& a, Stream stream) {
  const auto launch = [&](const auto& task) {
    // The kernel only requires this constant, which nvcc reports as unused.
    static_assert(std::remove_cvref_t<decltype(task)>::displaced);
    launch_gather(task, stream);
  };
  if (a.gradient.pointer)
    launch(HeatGather<Order, T, D, true>(a));
  else
    launch(HeatGather<Order, T, D, false>(a));
}

MPM_INSTANTIATE_ORDERS(heat_to_nodes, HeatToNodesArguments)
MPM_INSTANTIATE_ORDERS(heat_surface, HeatSurfaceArguments)
MPM_INSTANTIATE_ORDERS(heat_exchange, HeatExchangeArguments)
MPM_INSTANTIATE_ORDERS(heat_exchange_and_surface, HeatExchangeAndSurfaceArguments)
MPM_INSTANTIATE_ORDERS(heat_to_particles, HeatToParticlesArguments)

}  // namespace mpm::cuda
