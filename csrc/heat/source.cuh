#pragma once

#include "heat/largest.cuh"
#include "heat/local.h"
#include "transfer/scatter.cuh"

// What the particles contribute to the nodes of heat.
namespace mpm::cuda {

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

// The particles store their conductance and blend; and their diffusion number, where that has a destination.
template <int Order, class T, int D>
struct HeatSource {
  using Shape = SmallScatterShape<Order, T, D, 2, 2, false>;
  using OfNodes = Contribution<T, D, 2, 2>;
  static constexpr int resident = 0;
  static constexpr bool displaced = true;
  struct Particle {
    T theta, slope[D], volume, mass, specific_heat, conductivity, dt;  // the slope is per cell
  };
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position, gradient;
  Columns<const T, D * D> velocity_gradient;
  Columns<const T, 1> theta, volume, mass;
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
        conductance(a.conductance),
        blend(a.blend),
        number(a.number),
        conductivity(a.conductivity),
        specific_heat(a.specific_heat),
        transfer(a.transfer),
        time_step{a.scene_dt, T(a.dt)},
        largest(a.largest) {}

  __device__ Particle read(int p, int scene) const {
    Particle q{theta.at(p),
               {},
               volume.at(p),
               mass.at(p),
               read_value(specific_heat, p, scene),
               read_value(conductivity, p, scene),
               time_step.of(scene)};
#pragma unroll
    for (int d = 0; d < D; d++) q.slope[d] = gradient.present() ? topology.geometry.dx * gradient.at(p, d) : T(0);
    return q;
  }
  // The contribution of a particle, whose conductance and diffusion number are in `w` then.
  __device__ OfNodes contribution(int p, const Particle& q, const T& strain_rate, HeatWeights<T>& w) const {
    w = heat_weights(q.volume, q.specific_heat, q.conductivity, q.mass, q.dt, strain_rate, topology.geometry.dx);
    w.blend = blend_of(transfer, w.blend);
    conductance.at(p) = w.conductance;
    blend.at(p) = w.blend;
    if (number.present()) number.at(p) = w.number;
    const HeatSums<T> sums = heat_sums(w, q.theta);
    OfNodes c{{sums.capacity, sums.varying}, {sums.theta, sums.mean}, {}, {}};
#pragma unroll
    for (int d = 0; d < D; d++) {
      const HeatSums<T> slope = heat_sums(w, q.slope[d]);
      c.moment[0][d] = slope.theta;
      c.moment[1][d] = slope.mean;
    }
    return c;
  }
  __device__ OfNodes load(int p, int scene) const {
    HeatWeights<T> w;
    const T rate = strain_rate_of(read_matrix_or_zero<T, D>(velocity_gradient, p));
    const OfNodes c = contribution(p, read(p, scene), rate, w);
    if (largest) raise_by_warp(largest + scene, w.number);
    return c;
  }
  __device__ const OfNodes& contribution(const OfNodes& loaded) const { return loaded; }
  __device__ void skip(int p, int) const {
    conductance.at(p) = blend.at(p) = T(0);
    if (number.present()) number.at(p) = T(0);
  }
};
static_assert(kHeatCapacity == 0 && kHeatVarying == 1 && kHeatTheta == 2 && kHeatMean == 3);

}  // namespace mpm::cuda
