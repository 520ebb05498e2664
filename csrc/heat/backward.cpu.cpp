#include "heat/blocks.cpu.h"
#include "heat/kernels.h"
#include "heat/local_backward.h"
#include "transfer/gather.cpu.h"

// Adjoint of a step of heat, one pass over the particles for G2P and one for P2G.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

// A group as the particles of a body. It stores no lane beyond the group, whose particles others still read.
template <class T>
struct AtGroup {
  using Value = Lanes<T>;
  const Group& g;

  MPM_HD Value load(const T* pointer, int64_t stride) const { return load_row(pointer, stride, g); }
  MPM_HD void store(T* pointer, int64_t stride, const Value& value) const {
    if (g.consecutive && g.count < kLanes)
      store_row_exactly(value, pointer, stride, g);
    else
      store_row(value, pointer, stride, g);
  }
};

// The bodies are calls, which do not depend on the order of the B-spline.
template <bool Affine, class T, int D>
[[gnu::noinline]] void pull_back(const HeatToParticlesBackwardArguments<T, D>& a, const Group& g, int scene,
                                 const HeatGathered<Lanes<T>, D, 2>& gathered) {
  const Lanes<T> dt(step_of_scene(a.forward.scene_dt, a.forward.dt, scene));
  heat_of_particles_backward<Affine>(a, AtGroup<T>{g}, scene, dt, gathered);
}

template <class T, int D>
[[gnu::noinline]] void pull_back(const HeatToNodesBackwardArguments<T, D>& a, const Group& g, int scene,
                                 const HeatGathered<Lanes<T>, D, kHeatChannels>& gathered) {
  using P = Lanes<T>;
  const AtGroup<T> at{g};
  const Field<T> after = entry(a.moment, kHeatAfter), multiplier = entry(a.moment, kHeatMultiplier);
  const HeatGradients<P, D> gradients{load_vector<D>(at, constant(after)), load_vector<D>(at, constant(multiplier))};
  const HeatOfParticle<P, D> heat = load_heat(a.forward, at, scene);
  HeatForms<P, D> forms = heat.forms();
  heat_of_nodes_backward(a, at, scene, heat, gathered, gradients, forms);
  for (int k = 0; k < kHeatChannels; k++) store_scalar(at, entry(a.value, k), forms.value[k]);
  store_vector<D>(at, entry(a.moment, kHeatTheta), forms.theta);
  store_vector<D>(at, entry(a.moment, kHeatMean), forms.mean);
  store_vector<D>(at, after, forms.after);
  store_vector<D>(at, multiplier, forms.multiplier);
}

// What particles gather, with moments times a scale.
template <int Order, int Channels, bool Affine, class T, int D>
MPM_HD HeatGathered<Lanes<T>, D, Channels> gathered(const Lanes<T> f[D], const T* tile, double scale) {
  Sums<Lanes<T>, D> sums[Channels];
  gather_channels<Order, Channels, Affine, false, T, D>(f, tile, sums);
  HeatGathered<Lanes<T>, D, Channels> r;
  MPM_UNROLL for (int k = 0; k < Channels; k++) {
    r.value[k] = sums[k].value;
    MPM_UNROLL for (int d = 0; d < D; d++)
      r.moment[k][d] = Affine ? Lanes<T>(scale) * sums[k].moment[d] : Lanes<T>(0);
  }
  return r;
}

template <int Order, bool Affine, class T, int D>
void from_particles(const HeatToParticlesBackwardArguments<T, D>& a) {
  const HeatToParticlesArguments<T, D>& in = a.forward;
  const double scale = in.moment_scale * double(in.topology.geometry.dx);
  gather_groups<Order>(in.topology, in.x, in.nodes, 0, 2,
                       [&](const Group& g, const Lanes<T> f[D], int scene, const T* tile) {
                         pull_back<Affine>(a, g, scene, gathered<Order, 2, Affine, T, D>(f, tile, scale));
                       });
}

template <int Order, bool Affine, class T, int D>
void from_nodes(const HeatToNodesBackwardArguments<T, D>& a) {
  const HeatToNodesArguments<T, D>& in = a.forward;
  const double dx = double(in.topology.geometry.dx);
  gather_groups<Order>(in.topology, in.x, a.nodes, 0, kHeatChannels,
                       [&](const Group& g, const Lanes<T> f[D], int scene, const T* tile) {
                         pull_back(a, g, scene, gathered<Order, kHeatChannels, Affine, T, D>(f, tile, dx));
                       });
}

}  // namespace

template <int Order, class T, int D>
void heat_to_particles_backward(const HeatToParticlesBackwardArguments<T, D>& a) {
  a.gradient.pointer ? from_particles<Order, true>(a) : from_particles<Order, false>(a);
}

template <class T, int D>
void heat_term_backward(const HeatTermBackwardArguments<T, D>& a) {
  for_nodes(a.forward.topology, [&](int scene, int64_t i) { heat_of_term_backward(a, scene, i); });
}

template <class T, int D>
void heat_numbers_backward(const HeatNumbersBackwardArguments<T, D>& a) {
  for_blocks(a.term.forward.topology,
             [&](int scene, const int (&corner)[D], int64_t slot) { heat_numbers_of_slot(a, scene, corner, slot); });
}

template <class T, int D>
void heat_held_backward(const HeatHeldBackwardArguments<T, D>& a) {
  for_blocks(a.hold.topology, [&](int scene, const int (&corner)[D], int64_t slot) {
    held_temperature_of_slot(a, scene, corner, slot);
  });
}

template <class T, int D>
void heat_surface_temperature_backward(const HeatSurfaceTemperatureBackwardArguments<T, D>& a) {
  for_blocks(a.topology, [&](int scene, const int (&corner)[D], int64_t slot) {
    surface_temperature_of_slot(a, scene, corner, slot);
  });
}

template <class T, int D>
void heat_nodes_backward(const HeatNodesBackwardArguments<T, D>& a) {
  for_nodes(a.topology, [&](int scene, int64_t i) { heat_of_node_backward(a, scene, i); });
}

template <class T, int D>
void heat_layers_backward(const HeatLayersBackwardArguments<T, D>& a) {
  constexpr int64_t grain = 512;  // particles below which a range is not split
  parallel_ranges(a.layers.particles, grain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; p++) heat_layer_backward(a, p);
  });
}

template <class T, int D>
void heat_surface_row_backward(const HeatSurfaceRowBackwardArguments<T, D>& a) {
  for_blocks(a.topology, [&](int, const int (&)[D], int64_t slot) {
    for (int entry = 0; entry < ObstacleRow<T, D>::width; entry++) heat_surface_row_backward(a, slot, entry);
  });
}

template <int Order, class T, int D>
void heat_to_nodes_backward(const HeatToNodesBackwardArguments<T, D>& a) {
  a.gradient.pointer ? from_nodes<Order, true>(a) : from_nodes<Order, false>(a);
  for_outside(a.forward.topology, [&](int64_t p) { skip_heat_of_nodes_backward(a, p); });
}

MPM_HEAT_BACKWARD_KERNELS(MPM_INSTANTIATE, MPM_INSTANTIATE_ORDERS, MPM_INSTANTIATE_SIZE)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
