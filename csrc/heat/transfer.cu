#include "heat/largest.cuh"
#include "heat/local.h"
#include "transfer/advance_gather.cuh"
#include "transfer/scatter.cuh"

// Temperature to the nodes and back, one pass over the particles each.
namespace mpm::cuda {
namespace {

template <class T>
__device__ T read_value(const HeatValue<T>& v, int p, int scene) {
  return v.pointer[int64_t(v.per_scene ? scene : p) * v.stride];
}

template <class T>
struct TimeStep {
  Field<const T> scene_dt;
  T dt;

  __device__ T of(int scene) const { return scene_dt.pointer ? dt * scene_dt.pointer[scene * scene_dt.stride[0]] : dt; }
};

template <class T, int D>
__device__ Matrix<T, D> read_matrix_or_zero(const Columns<const T, D * D>& c, int p) {
  Matrix<T, D> m = zero_matrix<T, D>();
#pragma unroll
  for (int k = 0; k < D * D; k++)
    if (c.present()) m[k / D][k % D] = c.at(p, k);
  return m;
}

// load() also stores the conductance and the blend of the particle; and its diffusion number, where that has a
// destination.
template <int Order, class T, int D>
struct HeatSource {
  using Shape = ScatterShape<Order, T, D, 2, 2, false>;
  static constexpr int resident = 0;
  static constexpr bool displaced = true;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position, gradient;
  Columns<const T, D * D> velocity_gradient;
  Columns<const T, 1> theta, volume, mass;
  Columns<const T, 1> strain_rate;
  Columns<T, 1> conductance, blend, number;
  HeatValue<T> conductivity, specific_heat;
  HeatTransfer transfer;
  TimeStep<T> time_step;
  double* largest;

  explicit HeatSource(const HeatToNodesArguments<T, D>& a)
      : topology(a.topology),
        nodes(a.sums),
        position(a.x),
        gradient(a.particles.gradient),
        velocity_gradient(a.velocity_gradient, D),
        theta(a.particles.theta),
        volume(a.particles.volume),
        mass(a.mass),
        strain_rate(a.strain_rate),
        conductance(a.conductance),
        blend(a.blend),
        number(a.number),
        conductivity(a.conductivity),
        specific_heat(a.specific_heat),
        transfer(a.transfer),
        time_step{a.scene_dt, T(a.dt)},
        largest(a.largest) {}

  __device__ Contribution<T, D, 2, 2> load(int p, int scene) const {
    const T dx = topology.geometry.dx;
    const T rate =
        strain_rate.present() ? strain_rate.at(p) : strain_rate_of(read_matrix_or_zero<T, D>(velocity_gradient, p));
    HeatWeights<T> w = heat_weights(volume.at(p), read_value(specific_heat, p, scene),
                                    read_value(conductivity, p, scene), mass.at(p), time_step.of(scene), rate, dx);
    w.blend = blend_of(transfer, w.blend);
    conductance.at(p) = w.conductance;
    blend.at(p) = w.blend;
    if (number.present()) number.at(p) = w.number;
    if (largest) raise_by_warp(largest + scene, w.number);
    const HeatSums<T> sums = heat_sums(w, theta.at(p));
    Contribution<T, D, 2, 2> c{{sums.capacity, sums.varying}, {sums.theta, sums.mean}, {}, {}};
#pragma unroll
    for (int d = 0; d < D; d++) {
      const HeatSums<T> slope = heat_sums(w, gradient.present() ? dx * gradient.at(p, d) : T(0));
      c.moment[0][d] = slope.theta;
      c.moment[1][d] = slope.mean;
    }
    return c;
  }
  __device__ const Contribution<T, D, 2, 2>& contribution(const Contribution<T, D, 2, 2>& loaded) const {
    return loaded;
  }
  __device__ void skip(int p, int) const {
    conductance.at(p) = blend.at(p) = T(0);
    if (number.present()) number.at(p) = T(0);
  }
};
static_assert(kHeatCapacity == 0 && kHeatVarying == 1 && kHeatTheta == 2 && kHeatMean == 3);

template <int Order, class T, int D>
struct HeatSurfaceSource {
  using Shape = ScatterShape<Order, T, D, 1, D, true>;
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

// G2P of the motion, which also stores |sym ∇v| and the volume after the step.
template <int Order, class T, int D>
struct HeatAdvanceGather : AdvanceGather<Order, T, D, false, true> {
  using Base = AdvanceGather<Order, T, D, false, true>;
  Columns<const T, 1> rest, volume;
  Columns<T, 1> strain_rate, volume_next;

  explicit HeatAdvanceGather(const HeatAdvanceArguments<T, D>& a)
      : Base(a.advance), rest(a.rest), volume(a.volume), strain_rate(a.strain_rate), volume_next(a.volume_next) {}

  __device__ mpm::Vector<T, D> write(int p, const typename Base::Loaded& l, const typename Base::Result& s) const {
    return Base::write(p, p, p, l, s, [&](const Matrix<T, D>& L, const Matrix<T, D>& F, const T& J) {
      strain_rate.at(p) = strain_rate_of(L);
      volume_next.at(p) = rest.at(p) * (Base::J_next.present() ? J : Base::F_next.present() ? determinant(F) : T(1));
    });
  }
  __device__ void skip(int p) const {
    Base::skip(p);
    strain_rate.at(p) = T(0);
    volume_next.at(p) = volume.at(p);
  }
};

// The exchange of particles with a held surface.
template <int Order, class T, int D>
struct HeatExchangeSource {
  using Shape = ScatterShape<Order, T, D, 0, 1, false>;
  static constexpr int resident = 0;
  static constexpr bool displaced = true;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position;
  Columns<const T, 1> exchange;

  explicit HeatExchangeSource(const ScatterArguments<T, D>& a)
      : topology(a.topology), nodes(a.nodes), position(a.x), exchange(a.value) {}

  __device__ T load(int p, int) const { return exchange.at(p); }
  __device__ Contribution<T, D, 0, 1> contribution(const T& loaded) const { return {{}, {loaded}, {}, {}}; }
};

template <int Order_, class T_, int D_, bool Affine>
struct HeatGather {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = 2;
  static constexpr int resident = 6;
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
        largest(a.largest) {}

  __device__ Loaded load(int, int scene) const { return {scene}; }
  template <class Support>
  __device__ Result compute(const Loaded&, const Weights<Order, T, D>& w, const Support& support) const {
    const T constant[K] = {}, linear[K][D] = {};
    Result s;
    sum_axis<Shape, 0>(support, support.rows, 0, w, constant, linear, s);
    return s;
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
  }
  // Particles outside the grid keep their temperature.
  __device__ void skip(int p) const {
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
void heat_g2p_advance(const HeatAdvanceArguments<T, D>& a, Stream stream) {
  launch_gather(HeatAdvanceGather<Order, T, D>(a), stream);
}

template <int Order, class T, int D>
void heat_exchange(const ScatterArguments<T, D>& a, Stream stream) {
  launch_scatter(HeatExchangeSource<Order, T, D>(a), a.deterministic, stream);
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
MPM_INSTANTIATE_ORDERS(heat_g2p_advance, HeatAdvanceArguments)
MPM_INSTANTIATE_ORDERS(heat_exchange, ScatterArguments)
MPM_INSTANTIATE_ORDERS(heat_to_particles, HeatToParticlesArguments)

}  // namespace mpm::cuda
