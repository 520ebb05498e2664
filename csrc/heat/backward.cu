#include "heat/local_backward.h"

#include "cuda/for_each.cuh"
#include "heat/blocks.cuh"
#include "heat/kernels.h"
#include "transfer/gather.cuh"

// Adjoint of a step of heat, one pass over the particles for G2P and one for P2G.
namespace mpm::cuda {
namespace {

// The sums of the first K channels, with moments from channel `Plain` on; the particles of a call are those of its
// activation.
template <int Order_, class T_, int D_, int K_, int Plain, bool Affine>
struct HeatAdjointSums {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_;
  static constexpr int resident = 5;
  using Shape = SumShape<Order, T, D, K, Plain, Affine, false, SlopeForm::none>;
  struct Loaded {
    int scene;
  };
  using Result = Sums<Shape>;
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  T moment_scale;

  HeatAdjointSums(const Topology<T, D>& t, const NodeField<const T>& n, const Field<const T>& x, double scale)
      : topology(t), nodes(n), position(x), moment_scale(T(scale * double(t.geometry.dx))) {}

  __device__ Loaded load(int, int scene) const { return {scene}; }
  template <class Support>
  __device__ Result compute(const Loaded&, const Weights<Order, T, D>& w, const Support& support) const {
    return sum_support<Shape>(support, w);
  }
  __device__ HeatGathered<T, D, K> gathered(const Result& s) const {
    HeatGathered<T, D, K> g;
#pragma unroll
    for (int k = 0; k < K; k++) {
      g.value[k] = s.value[k];
#pragma unroll
      for (int d = 0; d < D; d++) g.moment[k][d] = Affine && k >= Plain ? moment_scale * s.moment[k][d] : T(0);
    }
    return g;
  }
};

template <int Order, class T, int D, bool Affine>
struct HeatToParticlesPullBack : HeatAdjointSums<Order, T, D, 2, 0, Affine> {
  using Base = HeatAdjointSums<Order, T, D, 2, 0, Affine>;
  HeatToParticlesBackwardArguments<T, D> a;

  explicit HeatToParticlesPullBack(const HeatToParticlesBackwardArguments<T, D>& arguments)
      : Base(arguments.forward.topology, arguments.forward.nodes, arguments.forward.x, arguments.forward.moment_scale),
        a(arguments) {}

  __device__ void write(int p, const typename Base::Loaded& l, const typename Base::Result& s) const {
    const T dt = step_of_scene(a.forward.scene_dt, a.forward.dt, l.scene);
    heat_of_particles_backward<Affine>(a, One<T>{p}, l.scene, dt, this->gathered(s));
  }
  __device__ void skip(int) const {}
};

static_assert(kHeatTheta == 2 && kHeatMean == 3);  // the channels with moments
template <int Order, class T, int D, bool Affine>
struct HeatToNodesPullBack : HeatAdjointSums<Order, T, D, kHeatChannels, kHeatTheta, Affine> {
  using Base = HeatAdjointSums<Order, T, D, kHeatChannels, kHeatTheta, Affine>;
  HeatToNodesBackwardArguments<T, D> a;

  explicit HeatToNodesPullBack(const HeatToNodesBackwardArguments<T, D>& arguments)
      : Base(arguments.forward.topology, arguments.nodes, arguments.forward.x, 1), a(arguments) {}

  __device__ void write(int p, const typename Base::Loaded& l, const typename Base::Result& s) const {
    const T dt = step_of_scene(a.forward.scene_dt, a.forward.dt, l.scene);
    heat_of_nodes_backward(a, One<T>{p}, l.scene, dt, this->gathered(s));
  }
  __device__ void skip(int p) const { skip_heat_of_nodes_backward(a, p); }
};

template <class T, int D>
MPM_HD void term_backward(const HeatTermBackwardArguments<T, D>& a, int64_t i) {
  at_node<heat_of_term_backward<T, D>>(a.forward.topology, a, i);
}

template <class T, int D>
MPM_HD void node_backward(const HeatNodesBackwardArguments<T, D>& a, int64_t i) {
  at_node<heat_of_node_backward<T, D>>(a.topology, a, i);
}

template <class T, int D>
MPM_HD void numbers_backward(const HeatNumbersBackwardArguments<T, D>& a, int64_t slot) {
  at_slot<heat_numbers_of_slot<T, D>>(a.term.forward.topology, a, slot);
}

template <class T, int D>
MPM_HD void held_backward(const HeatHeldBackwardArguments<T, D>& a, int64_t slot) {
  at_slot<held_temperature_of_slot<T, D>>(a.hold.topology, a, slot);
}

// An entry of a slot for each thread: the particles of a slot are many.
template <class T, int D>
MPM_HD void surface_row_backward(const HeatSurfaceRowBackwardArguments<T, D>& a, int64_t i) {
  const int64_t slot = i / ObstacleRow<T, D>::width;
  int corner[D];
  if (scene_of_slot(a.topology, slot, corner) >= 0)
    heat_surface_row_backward(a, slot, int(i % ObstacleRow<T, D>::width));
}

template <class T, int D>
MPM_HD void surface_temperature_backward(const HeatSurfaceTemperatureBackwardArguments<T, D>& a, int64_t slot) {
  at_slot<surface_temperature_of_slot<T, D>>(a.topology, a, slot);
}

}  // namespace

template <int Order, class T, int D>
void heat_to_particles_backward(const HeatToParticlesBackwardArguments<T, D>& a, Stream stream) {
  if (a.gradient.pointer)
    launch_gather(HeatToParticlesPullBack<Order, T, D, true>(a), stream);
  else
    launch_gather(HeatToParticlesPullBack<Order, T, D, false>(a), stream);
}

template <class T, int D>
void heat_term_backward(const HeatTermBackwardArguments<T, D>& a, Stream stream) {
  for_each<term_backward<T, D>>(nodes_of(a.forward.topology), a, stream);
}

template <class T, int D>
void heat_numbers_backward(const HeatNumbersBackwardArguments<T, D>& a, Stream stream) {
  for_each<numbers_backward<T, D>>(a.term.forward.topology.max_blocks, a, stream);
}

template <class T, int D>
void heat_held_backward(const HeatHeldBackwardArguments<T, D>& a, Stream stream) {
  for_each<held_backward<T, D>>(a.hold.topology.max_blocks, a, stream);
}

template <class T, int D>
void heat_surface_temperature_backward(const HeatSurfaceTemperatureBackwardArguments<T, D>& a, Stream stream) {
  for_each<surface_temperature_backward<T, D>>(a.topology.max_blocks, a, stream);
}

template <class T, int D>
void heat_nodes_backward(const HeatNodesBackwardArguments<T, D>& a, Stream stream) {
  for_each<node_backward<T, D>>(nodes_of(a.topology), a, stream);
}

template <class T, int D>
void heat_layers_backward(const HeatLayersBackwardArguments<T, D>& a, Stream stream) {
  for_each<heat_layer_backward<T, D>>(a.layers.particles, a, stream);
}

template <class T, int D>
void heat_surface_row_backward(const HeatSurfaceRowBackwardArguments<T, D>& a, Stream stream) {
  for_each<surface_row_backward<T, D>>(int64_t(a.topology.max_blocks) * ObstacleRow<T, D>::width, a, stream);
}

template <int Order, class T, int D>
void heat_to_nodes_backward(const HeatToNodesBackwardArguments<T, D>& a, Stream stream) {
  if (a.gradient.pointer)
    launch_gather(HeatToNodesPullBack<Order, T, D, true>(a), stream);
  else
    launch_gather(HeatToNodesPullBack<Order, T, D, false>(a), stream);
}

MPM_HEAT_BACKWARD_KERNELS(MPM_INSTANTIATE, MPM_INSTANTIATE_ORDERS, MPM_INSTANTIATE_SIZE)

}  // namespace mpm::cuda
