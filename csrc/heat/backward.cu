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

// Adjoint of P2G with the gradients of θ + d and of λ, and the position gradient of all forms. The positions of the
// particles are those of the activation. Without gradients of the particles the moments of P2G and G2P are zero.
template <int Order_, class T_, int D_>
struct HeatToNodesPullBack {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = kHeatChannels, Others = kHeatSolved;
  static constexpr int resident = 3;
  static constexpr int first_gradient = kHeatAfter - K;
  static_assert(kHeatTheta == 2 && kHeatMean == 3 && first_gradient == 2 && Others == K);  // channels with moments
  using OfSums = SumShape<Order, T, D, K, kHeatTheta, true, false, SlopeForm::none>;
  using OfSolved = SumShape<Order, T, D, K, first_gradient, true, false, SlopeForm::none>;
  using Slope = SumShape<Order, T, D, K, K, false, false, SlopeForm::affine>;
  struct Loaded {
    int p, scene;
  };
  using Result = Vector<T, D>;
  struct Factors {
    T value[K] = {}, moment[K][D] = {};  // per cell
  };
  Topology<T, D> topology;
  NodeField<const T> nodes, others;
  Columns<const T, D> position;
  Columns<T, D> x_term;
  T dx, inverse_dx;
  HeatToNodesBackwardArguments<T, D> a;

  explicit HeatToNodesPullBack(const HeatToNodesBackwardArguments<T, D>& a)
      : topology(a.forward.topology),
        nodes(a.nodes),
        others(a.solved),
        position(a.forward.x),
        x_term(a.x_term),
        dx(topology.geometry.dx),
        inverse_dx(topology.geometry.inverse_dx),
        a(a) {}

  __device__ Loaded load(int p, int scene) const { return {p, scene}; }
  template <class Support, class OtherSupport>
  __device__ Result compute(const Loaded& l, const Weights<Order, T, D>& w, const Support& support,
                            const OtherSupport& solved) const {
    const HeatForms<T, D> forms = pull_back(l, w, support, solved);
    Factors of_sums, of_solved;
#pragma unroll
    for (int k = 0; k < K; k++) of_sums.value[k] = forms.value[k];
    const One<T> at{l.p};
#pragma unroll
    for (int k = 0; k < first_gradient; k++) of_solved.value[k] = load_scalar(at, constant(entry(a.value, K + k)));
#pragma unroll
    for (int d = 0; d < D; d++) {
      of_sums.moment[kHeatTheta][d] = dx * forms.theta[d];
      of_sums.moment[kHeatMean][d] = dx * forms.mean[d];
      of_solved.moment[first_gradient][d] = dx * forms.after[d];
      of_solved.moment[first_gradient + 1][d] = dx * forms.multiplier[d];
    }
    if (a.gradient.pointer) {
#pragma unroll
      for (int k = 0; k < first_gradient; k++) {
        const Vector<T, D> moment = load_vector<D>(at, constant(entry(a.moment, K + k)));
#pragma unroll
        for (int d = 0; d < D; d++) of_solved.moment[k][d] = dx * moment[d];
      }
    }
    return slope(w, support, of_sums) + slope(w, solved, of_solved);
  }
  __device__ void write(int p, const Loaded&, const Result& x) const {
#pragma unroll
    for (int d = 0; d < D; d++) x_term.at(p, d) = x[d];
  }
  __device__ void skip(int p) const {
    write(p, {}, zero_vector<T, D>());
    skip_heat_of_nodes_backward(a, p);
  }

 private:
  template <class Support, class OtherSupport>
  __device__ HeatForms<T, D> pull_back(const Loaded& l, const Weights<Order, T, D>& w, const Support& support,
                                       const OtherSupport& solved) const {
    const Sums<OfSums> sums = sum_support<OfSums>(support, w);
    forget_nodes();
    const Sums<OfSolved> of_solved = sum_support<OfSolved>(solved, w);
    const T scale = T(a.inverse_inertia) * dx;
    HeatGathered<T, D, K> gathered;
    HeatGradients<T, D> gradients;
#pragma unroll
    for (int k = 0; k < K; k++) {
      gathered.value[k] = sums.value[k];
#pragma unroll
      for (int d = 0; d < D; d++) gathered.moment[k][d] = k >= kHeatTheta ? dx * sums.moment[k][d] : T(0);
    }
#pragma unroll
    for (int d = 0; d < D; d++) {
      gradients.after[d] = scale * of_solved.moment[first_gradient][d];
      gradients.multiplier[d] = scale * of_solved.moment[first_gradient + 1][d];
    }
    const T dt = step_of_scene(a.forward.scene_dt, a.forward.dt, l.scene);
    return heat_of_nodes_backward(a, One<T>{l.p}, l.scene, dt, gathered, gradients);
  }
  template <class Support>
  __device__ Vector<T, D> slope(const Weights<Order, T, D>& w, const Support& support, const Factors& f) const {
    forget_nodes();
    const T none[K][D] = {};
    Sums<Slope> sums;
    position_slope<Slope, false>(support, w, f.value, f.moment, none, sums);
    Vector<T, D> x;
#pragma unroll
    for (int d = 0; d < D; d++) x[d] = inverse_dx * sums.slope[d];
    return x;
  }
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
  launch_gather_of_vectors(HeatToNodesPullBack<Order, T, D>(a), stream);
}

MPM_HEAT_BACKWARD_KERNELS(MPM_INSTANTIATE, MPM_INSTANTIATE_ORDERS, MPM_INSTANTIATE_SIZE)

}  // namespace mpm::cuda
