#include "heat/transfer.h"

#include "heat/local.h"
#include "heat/packs.cpu.h"
#include "transfer/gather.cpu.h"
#include "transfer/scatter.cpu.h"

// Temperature to the nodes and back, one pass over the particles each.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
void heat_volumes(const HeatVolumesArguments<T, D>& a) {
  constexpr int64_t grain = 4096;  // particles below which a range is not split
  parallel_ranges(a.particles, grain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; p++) heat_volume(a, p);
  });
}

template <int Order, class T, int D>
void heat_to_nodes(const HeatToNodesArguments<T, D>& a) {
  scatter_channels<Order, true, false>(
      a.topology, a.x, a.sums, 0, kHeatChannels, [&]<int N>(const GroupOf<N>& g, const Pack<T, N> f[D], int scene) {
        Largest<T> largest;
        const Pack<T, N> strain_rate = strain_rate_of(load_matrix_or_zero<T, D>(a.velocity_gradient, g));
        const Contribution<Pack<T, N>, D> c = heat_contribution(a, g, scene, f, strain_rate, largest);
        largest.raise(a.largest + scene);
        return c;
      });
  heat_outside(a);
}

template <int Order, class T, int D>
void heat_surface(const HeatSurfaceArguments<T, D>& a) {
  scatter_channels<Order, false, true>(
      a.topology, a.x, a.sums, 0, kHeatChannels, [&]<int N>(const GroupOf<N>& g, const Pack<T, N>*, int scene) {
        using P = Pack<T, N>;
        const P volume = values_of(a.volume, g), slope = P(a.topology.geometry.inverse_dx) * volume;
        Contribution<P, D> c;
        MPM_UNROLL for (int k = 0; k < kChannels; k++) {
          c.value[k] = P(0);
          MPM_UNROLL for (int d = 0; d < D; d++)
            c.slope[d][k] = P(0), c.gradient[d][k] = 1 + d == k ? slope : P(0);
        }
        if (a.power.pointer) c.value[0] = volume * values_of(a.power, g, scene);
        if (a.dissipated.pointer) {
          const P energy = P(a.share) * values_of(a.dissipated, g), dt(time_step(a.scene_dt, a.dt, scene));
          c.value[0] = c.value[0] + dissipated_power(energy, values_of(a.rest, g), dt);
        }
        return c;
      });
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
    const auto L = a.gradient.pointer ? load_matrix_or_zero<T, D>(a.velocity_gradient, g) : zero_matrix<P, D>();
    const P changing = finish_heat(a, g, scene, gathered, scale, L);
    if (!a.liquid.pointer) return;
    Largest<T> front;  // the lanes beyond the group may be other particles
    front.add(changing, g.count);
    front.raise(a.largest + scene * kHeatStatusSize);
  });
  // Particles outside the grid keep their temperature.
  for_outside(a.topology, [&](int64_t p) {
    at(a.theta, p) = at(a.particles.theta, p);
    for (int d = 0; a.gradient.pointer && d < D; d++) at(a.gradient, p, d) = at(a.particles.gradient, p, d);
    if (a.liquid.pointer) at(a.liquid, p) = at(a.particles.liquid, p);
  });
}

MPM_INSTANTIATE(heat_volumes, HeatVolumesArguments)
MPM_INSTANTIATE_ORDERS(heat_to_nodes, HeatToNodesArguments)
MPM_INSTANTIATE_ORDERS(heat_surface, HeatSurfaceArguments)
MPM_INSTANTIATE_ORDERS(heat_to_particles, HeatToParticlesArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
