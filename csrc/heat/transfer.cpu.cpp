#include "heat/transfer.h"
#include <algorithm>
#include <mutex>
#include <vector>

#include "common/lanes.h"
#include "heat/particle.h"
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
    for (int64_t p = begin; p < end; p++) {
      const One<T> particle{p};
      T volume = at(a.rest, p);
      if (a.J.pointer)
        volume = volume * at(a.J, p);
      else if (a.F.pointer)
        volume = volume * determinant(load_matrix<D>(particle, a.F));
      at(a.volume, p) = volume;
    }
  });
}

template <class P>
MPM_HD P blend_of(HeatTransfer transfer, const P& hybrid) {
  return transfer == HeatTransfer::hybrid ? hybrid : P(transfer == HeatTransfer::flip ? 0 : 1);
}

template <int Order, class T, int D>
void heat_to_nodes(const HeatToNodesArguments<T, D>& a) {
  const Geometry<T, D>& geometry = a.topology.geometry;
  const auto weights = [&](const auto& g, int scene) {
    constexpr int N = std::remove_cvref_t<decltype(g)>::kSize;
    using P = Pack<T, N>;
    const P dt(time_step(a.scene_dt, a.dt, scene));
    HeatWeights<P> w =
        heat_weights<P, D>(load(a.particles.volume, g), load(a.specific_heat, g, scene), load(a.conductivity, g, scene),
                           load(a.mass, g), dt, load_matrix_or_zero<T, D>(a.velocity_gradient, g), P(geometry.dx));
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
        const P theta = load(a.particles.theta, g), varying = w.capacity * w.blend;
        Contribution<P, D> c{};
        c.value[0] = w.capacity * theta;
        c.value[1] = varying * theta;
        c.value[2] = w.capacity;
        c.value[3] = varying;
        MPM_UNROLL for (int d = 0; d < D; d++) {
          const P slope = a.particles.gradient.pointer ? P(geometry.dx) * load(a.particles.gradient, g, d) : P(0);
          c.slope[d][0] = w.capacity * slope;
          c.slope[d][1] = varying * slope;
          c.slope[d][2] = c.slope[d][3] = P(0);
          c.value[0] = c.value[0] - c.slope[d][0] * f[d];
          c.value[1] = c.value[1] - c.slope[d][1] * f[d];
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
            c.slope[d][k] = P(0), c.gradient[d][k] = d == k ? slope : P(0);
        }
        if (a.power.pointer) c.value[kHeatChannels - 1] = volume * load(a.power, g, scene);
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
    for (int64_t i = begin; i < end; i++) {
      T* const sum = a.sums + i * kHeatChannels;
      const T weight = sum[2], varying = sum[3];
      a.theta[i] = weight > T(0) ? sum[0] / weight : T(0);
      a.capacity[i] = weight;
      sum[1] = varying > T(0) ? sum[1] / varying : T(0);
    }
  });
}

template <class T, int D>
void heat_increments(const HeatIncrementsArguments<T, D>& a) {
  constexpr int64_t grain = 16384;  // nodes below which a range is not split
  parallel_ranges(a.nodes, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i++) a.sums[i * kHeatChannels] = a.increment[i] + (a.start[i] - a.theta[i]);
  });
}

// θ, g and the liquid fraction of a particle or a pack of them, from what it gathered: increment and θ̄.
template <class T, int D, class G>
void finish_heat(const HeatToParticlesArguments<T, D>& a, const G& g, int scene,
                 const Sums<Pack<T, G::kSize>, D> gathered[2], const Pack<T, G::kSize>& scale) {
  using P = Pack<T, G::kSize>;
  const P blend = load(a.blend, g), dt(time_step(a.scene_dt, a.dt, scene));
  P theta = blended(gathered[0].value, gathered[1].value, load(a.particles.theta, g), blend);
  if (a.gradient.pointer) {
    Vector<P, D> after;
    MPM_UNROLL for (int d = 0; d < D; d++)
      after[d] = blended(scale * gathered[0].moment[d], scale * gathered[1].moment[d], load(a.particles.gradient, g, d),
                         blend);
    const Matrix<P, D> L = load_matrix_or_zero<T, D>(a.velocity_gradient, g);
    const Vector<P, D> transported = transported_gradient(after, L, dt);
    MPM_UNROLL for (int d = 0; d < D; d++)
      put(transported[d], a.gradient, g, d);
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
MPM_INSTANTIATE(heat_increments, HeatIncrementsArguments)
MPM_INSTANTIATE_ORDERS(heat_to_particles, HeatToParticlesArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
