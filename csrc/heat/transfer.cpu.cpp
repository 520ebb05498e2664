#include "heat/transfer.h"
#include <algorithm>
#include <mutex>
#include <vector>

#include "common/lanes.h"
#include "heat/local.h"
#include "transfer/gather.cpu.h"
#include "transfer/scatter.cpu.h"

// Temperature to the nodes and back, one pass over the particles each.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, class G>
MPM_HD Pack<T, G::kSize> load(const HeatValue<T>& value, const G& g, int scene) {
  using P = Pack<T, G::kSize>;
  if (value.per_scene || value.stride == 0) return P(value.pointer[value.per_scene ? scene * value.stride : 0]);
  return load(Field<const T>{value.pointer, {value.stride, 0, 0}}, g);
}

template <class T, class P, class G>
MPM_HD void put(const P& value, const Field<T>& f, const G& g, int i = 0) {
  store_row(value, row_of(f, i), f.stride[0], g);
}

template <class T, int D>
void heat_volumes(const HeatVolumesArguments<T, D>& a) {
  constexpr int64_t grain = 4096;  // particles below which a range is not split
  parallel_ranges(a.particles, grain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; p++) heat_volume(a, p);
  });
}

template <int Order, class T, int D>
void heat_to_nodes(const HeatToNodesArguments<T, D>& a) {
  const Geometry<T, D>& geometry = a.topology.geometry;
  const auto weights = [&](const auto& g, int scene) {
    constexpr int N = std::remove_cvref_t<decltype(g)>::kSize;
    using P = Pack<T, N>;
    const P dt(time_step(a.scene_dt, a.dt, scene));
    const P strain_rate = strain_rate_of(load_matrix_or_zero<T, D>(a.velocity_gradient, g));
    HeatWeights<P> w = heat_weights(load(a.particles.volume, g), load(a.specific_heat, g, scene),
                                    load(a.conductivity, g, scene), load(a.mass, g), dt, strain_rate, P(geometry.dx));
    w.blend = blend_of(a.transfer, w.blend);
    put(w.conductance, a.conductance, g);
    put(w.blend, a.blend, g);
    put(w.number, a.number, g);
    return w;
  };
  scatter_channels<Order, true, false>(
      a.topology, a.x, a.sums, 0, kHeatChannels, [&]<int N>(const GroupOf<N>& g, const Pack<T, N> f[D], int scene) {
        using P = Pack<T, N>;
        const HeatWeights<P> w = weights(g, scene);
        const HeatSums<P> sums = heat_sums(w, load(a.particles.theta, g));
        Contribution<P, D> c{};
        c.value[kHeatCapacity] = sums.capacity;
        c.value[kHeatVarying] = sums.varying;
        c.value[kHeatTheta] = sums.theta;
        c.value[kHeatMean] = sums.mean;
        MPM_UNROLL for (int d = 0; d < D; d++) {
          const P step = a.particles.gradient.pointer ? P(geometry.dx) * load(a.particles.gradient, g, d) : P(0);
          const HeatSums<P> slope = heat_sums(w, step);
          c.slope[d][kHeatCapacity] = c.slope[d][kHeatVarying] = P(0);
          c.slope[d][kHeatTheta] = slope.theta;
          c.slope[d][kHeatMean] = slope.mean;
          c.value[kHeatTheta] = c.value[kHeatTheta] - slope.theta * f[d];
          c.value[kHeatMean] = c.value[kHeatMean] - slope.mean * f[d];
        }
        return c;
      });
  for_outside(a.topology, [&](int64_t p) { at(a.conductance, p) = at(a.blend, p) = at(a.number, p) = T(0); });
}

template <int Order, class T, int D>
void heat_surface(const HeatSurfaceArguments<T, D>& a) {
  scatter_channels<Order, false, true>(
      a.topology, a.x, a.sums, 0, kHeatChannels, [&]<int N>(const GroupOf<N>& g, const Pack<T, N>*, int scene) {
        using P = Pack<T, N>;
        const P volume = load(a.volume, g), slope = P(a.topology.geometry.inverse_dx) * volume;
        Contribution<P, D> c;
        MPM_UNROLL for (int k = 0; k < kChannels; k++) {
          c.value[k] = P(0);
          MPM_UNROLL for (int d = 0; d < D; d++)
            c.slope[d][k] = P(0), c.gradient[d][k] = 1 + d == k ? slope : P(0);
        }
        if (a.power.pointer) c.value[0] = volume * load(a.power, g, scene);
        if (a.dissipated.pointer) {
          const P energy = P(a.share) * load(a.dissipated, g), dt(time_step(a.scene_dt, a.dt, scene));
          c.value[0] = c.value[0] + dissipated_power(energy, load(a.rest, g), dt);
        }
        return c;
      });
}

template <class T, int D>
void heat_largest(const HeatLargestArguments<T, D>& a) {
  constexpr int64_t grain = 16384;  // particles below which a range is not split
  std::mutex mutex;
  const auto raise = [](auto& most, auto value) {
    if (!(value <= most)) most = value;
  };
  parallel_ranges(a.particles, grain, [&](int64_t begin, int64_t end) {
    std::vector<T> most(size_t(a.scenes), T(0));
    for (int64_t p = begin; p < end; p++) {
      const int64_t scene = a.scene.pointer ? at(a.scene, p) : 0;
      raise(most[size_t(std::clamp<int64_t>(scene, 0, a.scenes - 1))], at(a.value, p));
    }
    const std::lock_guard<std::mutex> lock(mutex);
    for (int64_t b = 0; b < a.scenes; b++) raise(a.largest[b * a.stride], double(most[size_t(b)]));
  });
}

template <class T, int D>
void heat_means(const HeatMeansArguments<T, D>& a) {
  constexpr int64_t grain = 16384;  // nodes below which a range is not split
  parallel_ranges(a.nodes, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i++) heat_mean(a, i);
  });
}

template <class T, int D>
void heat_increments(const HeatIncrementsArguments<T, D>& a) {
  constexpr int64_t grain = 16384;  // nodes below which a range is not split
  parallel_ranges(a.nodes, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i++) heat_increment(a, i);
  });
}

template <class T, int D>
void heat_count(const HeatCountArguments<T, D>& a) {
  for (int64_t scene = 0; scene < a.scenes; scene++) count_solve(a, scene);
}

// θ, g and the liquid fraction of a particle or a pack of them, from what it gathered: increment and θ̄.
template <class T, int D, class G>
void finish_heat(const HeatToParticlesArguments<T, D>& a, const G& g, int scene,
                 const Sums<Pack<T, G::kSize>, D> gathered[2], const Pack<T, G::kSize>& scale) {
  using P = Pack<T, G::kSize>;
  const P blend = load(a.blend, g), dt(time_step(a.scene_dt, a.dt, scene));
  P theta = blended(gathered[0].value, gathered[1].value, load(a.particles.theta, g), blend);
  if (a.gradient.pointer) {
    Vector<P, D> increment, average, before;
    MPM_UNROLL for (int d = 0; d < D; d++)
      increment[d] = scale * gathered[0].moment[d], average[d] = scale * gathered[1].moment[d],
      before[d] = load(a.particles.gradient, g, d);
    const Matrix<P, D> L = load_matrix_or_zero<T, D>(a.velocity_gradient, g);
    const Vector<P, D> after = gradient_after(increment, average, before, blend, L, dt);
    MPM_UNROLL for (int d = 0; d < D; d++)
      put(after[d], a.gradient, g, d);
  }
  if (a.liquid.pointer) {
    P liquid = load(a.particles.liquid, g);
    const P changing = melt(theta, liquid, load(a.melting_point, g, scene), load(a.specific_heat, g, scene),
                            load(a.latent_heat, g, scene), load(a.number, g));
    put(liquid, a.liquid, g);
    put(changing, a.changing, g);
  }
  put(theta, a.theta, g);
}

template <int Order, class T, int D>
void heat_to_particles(const HeatToParticlesArguments<T, D>& a) {
  using P = Lanes<T>;
  const P scale(a.moment_scale * double(a.topology.geometry.dx));
  gather_groups<Order>(a.topology, a.x, a.nodes, 0, 2, [&](const Group& g, const P f[D], int scene, const T* tile) {
    Sums<P, D> gathered[2];
    if (a.gradient.pointer)
      gather_channels<Order, 2, true, false, T, D>(f, tile, gathered);
    else
      gather_channels<Order, 2, false, false, T, D>(f, tile, gathered);
    finish_heat<T, D>(a, g, scene, gathered, scale);
  });
  // Particles outside the grid keep their temperature.
  for_outside(a.topology, [&](int64_t p) {
    at(a.theta, p) = at(a.particles.theta, p);
    for (int d = 0; a.gradient.pointer && d < D; d++) at(a.gradient, p, d) = at(a.particles.gradient, p, d);
    if (a.liquid.pointer) at(a.liquid, p) = at(a.particles.liquid, p), at(a.changing, p) = T(0);
  });
}

MPM_INSTANTIATE(heat_volumes, HeatVolumesArguments)
MPM_INSTANTIATE_ORDERS(heat_to_nodes, HeatToNodesArguments)
MPM_INSTANTIATE_ORDERS(heat_surface, HeatSurfaceArguments)
MPM_INSTANTIATE(heat_means, HeatMeansArguments)
MPM_INSTANTIATE(heat_largest, HeatLargestArguments)
MPM_INSTANTIATE(heat_count, HeatCountArguments)
MPM_INSTANTIATE(heat_increments, HeatIncrementsArguments)
MPM_INSTANTIATE_ORDERS(heat_to_particles, HeatToParticlesArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
