#pragma once

#include "common/lanes.h"
#include "heat/local.h"
#include "transfer/contribution.cpu.h"
#include "transfer/gather.cpu.h"

// Transfers of temperature for packs of particles: what they add to their nodes, and their temperature afterwards.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, class G>
MPM_HD Pack<T, G::kSize> values_of(const Field<const T>& f, const G& g, int i = 0) {
  return load_row(row_of(f, i), f.stride[0], g);
}

template <class T, class G>
MPM_HD Pack<T, G::kSize> values_of(const HeatValue<T>& value, const G& g, int scene) {
  using P = Pack<T, G::kSize>;
  if (value.per_scene || value.stride == 0) return P(value.pointer[value.per_scene ? scene * value.stride : 0]);
  return load_row(value.pointer, value.stride, g);
}

template <class T, class P, class G>
MPM_HD void put(const P& value, const Field<T>& f, const G& g, int i = 0) {
  store_row(value, row_of(f, i), f.stride[0], g);
}

// Largest value of particles of a scene, zero at first; NaN where one is NaN.
template <class T>
class Largest {
 public:
  static constexpr int N = kWideLanes<T>;

  Largest() : most_(0), nan_(0) {}
  // Adds the first `count` values of a pack.
  template <int M>
  MPM_HD void add(const Pack<T, M>& value, int count = M) {
    if (M == N && count >= M) {
      if constexpr (M == N) {
        most_ = max(value, most_);
        nan_ += value - value;
      }
      return;
    }
    for (int l = 0; l < M && l < count; l++) {
      if (value[l] > most_[0]) most_.set(0, value[l]);
      if (!(value[l] - value[l] == T(0))) nan_.set(0, value[l] - value[l]);
    }
  }
  // Raises the number of the scene. Numbers that are not negative have the order of their bits, and NaN is above all
  // others.
  void raise(double* to) const {
    double most = 0;
    for (int l = 0; l < N; l++) {
      most = double(most_[l]) > most ? double(most_[l]) : most;
      if (nan_[l] != T(0)) most = __builtin_nan("");
    }
    const int64_t own = __builtin_bit_cast(int64_t, most);
    int64_t* const all = reinterpret_cast<int64_t*>(to);
    int64_t now = __atomic_load_n(all, __ATOMIC_RELAXED);
    while (now < own && !__atomic_compare_exchange_n(all, &now, own, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
    }
  }

 private:
  Pack<T, N> most_, nan_;  // and NaN in the lanes where a value is not finite
};

// Sums of packs of particles at distances f from their base nodes, and their results that the step needs later.
template <class T, int D, class G>
MPM_HD Contribution<Pack<T, G::kSize>, D> heat_contribution(const HeatToNodesArguments<T, D>& a, const G& g, int scene,
                                                            const Pack<T, G::kSize> f[D],
                                                            const Pack<T, G::kSize>& strain_rate, Largest<T>& largest) {
  using P = Pack<T, G::kSize>;
  const P dt(time_step(a.scene_dt, a.dt, scene)), dx(a.topology.geometry.dx);
  HeatWeights<P> w = heat_weights(values_of(a.particles.volume, g), values_of(a.specific_heat, g, scene),
                                  values_of(a.conductivity, g, scene), values_of(a.mass, g), dt, strain_rate, dx);
  w.blend = blend_of(a.transfer, w.blend);
  put(w.conductance, a.conductance, g);
  put(w.blend, a.blend, g);
  if (a.number.pointer) put(w.number, a.number, g);
  largest.add(w.number);
  const HeatSums<P> sums = heat_sums(w, values_of(a.particles.theta, g));
  Contribution<P, D> c;
  c.value[kHeatCapacity] = sums.capacity;
  c.value[kHeatVarying] = sums.varying;
  c.value[kHeatTheta] = sums.theta;
  c.value[kHeatMean] = sums.mean;
  MPM_UNROLL for (int d = 0; d < D; d++) {
    const P step = a.particles.gradient.pointer ? dx * values_of(a.particles.gradient, g, d) : P(0);
    const HeatSums<P> slope = heat_sums(w, step);
    MPM_UNROLL for (int k = 0; k < kHeatChannels; k++)
      c.gradient[d][k] = P(0);
    c.slope[d][kHeatCapacity] = c.slope[d][kHeatVarying] = P(0);
    c.slope[d][kHeatTheta] = slope.theta;
    c.slope[d][kHeatMean] = slope.mean;
    c.value[kHeatTheta] = c.value[kHeatTheta] - slope.theta * f[d];
    c.value[kHeatMean] = c.value[kHeatMean] - slope.mean * f[d];
  }
  return c;
}

// Results for particles that are not transferred.
template <class T, int D>
void heat_outside(const HeatToNodesArguments<T, D>& a) {
  for_outside(a.topology, [&](int64_t p) {
    at(a.conductance, p) = at(a.blend, p) = T(0);
    if (a.number.pointer) at(a.number, p) = T(0);
  });
}

// Stores θ, g and the liquid fraction of a pack of particles, from what it gathered: increment and θ̄. Reads L where
// there is a gradient. Returns the diffusion number where the liquid fraction changes, else zero.
template <class T, int D, class G>
Pack<T, G::kSize> finish_heat(const HeatToParticlesArguments<T, D>& a, const G& g, int scene,
                              const Sums<Pack<T, G::kSize>, D> gathered[2], const Pack<T, G::kSize>& scale,
                              const Matrix<Pack<T, G::kSize>, D>& L) {
  using P = Pack<T, G::kSize>;
  P changing(0);
  const P blend = values_of(a.blend, g), dt(time_step(a.scene_dt, a.dt, scene));
  P theta = blended(gathered[0].value, gathered[1].value, values_of(a.particles.theta, g), blend);
  if (a.gradient.pointer) {
    Vector<P, D> increment, average, before;
    MPM_UNROLL for (int d = 0; d < D; d++)
      increment[d] = scale * gathered[0].moment[d], average[d] = scale * gathered[1].moment[d],
      before[d] = values_of(a.particles.gradient, g, d);
    const Vector<P, D> after = gradient_after(increment, average, before, blend, L, dt);
    MPM_UNROLL for (int d = 0; d < D; d++)
      put(after[d], a.gradient, g, d);
  }
  if (a.liquid.pointer) {
    P liquid = values_of(a.particles.liquid, g);
    changing = melt(theta, liquid, values_of(a.melting_point, g, scene), values_of(a.specific_heat, g, scene),
                    values_of(a.latent_heat, g, scene), values_of(a.number, g));
    put(liquid, a.liquid, g);
  }
  put(theta, a.theta, g);
  return changing;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
