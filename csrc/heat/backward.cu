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
  using OfSums = SumShape<Order, T, D, K, kHeatTheta, true, false, SlopeForm::affine>;
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
    const One<T> at{l.p};
    const HeatOfParticle<T, D> heat = load_heat(a.forward, at, l.scene);
    HeatForms<T, D> forms = heat.forms();
    HeatGathered<T, D, K> gathered;
    const Vector<T, D> slope_of_sums = sum(w, support, forms, gathered);
    const HeatGradients<T, D> gradients = gradients_of(w, solved);
    Factors of_solved = load_factors(at);  // before results are stored, as in common/lanes.h
    heat_of_nodes_backward(a, at, l.scene, heat, gathered, gradients, forms);
#pragma unroll
    for (int d = 0; d < D; d++) {
      of_solved.moment[first_gradient][d] = dx * forms.after[d];
      of_solved.moment[first_gradient + 1][d] = dx * forms.multiplier[d];
    }
    forget_nodes();
    Sums<Slope> sums;
    return inverse_dx * (slope_of_sums + slope(w, solved, of_solved, sums));
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
  // Factors of the forms of G2P.
  __device__ Factors load_factors(const One<T>& at) const {
    Factors f;
#pragma unroll
    for (int k = 0; k < first_gradient; k++) {
      f.value[k] = load_scalar(at, constant(entry(a.value, K + k)));
      const Vector<T, D> moment =
          a.gradient.pointer ? load_vector<D>(at, constant(entry(a.moment, K + k))) : zero_vector<T, D>();
#pragma unroll
      for (int d = 0; d < D; d++) f.moment[k][d] = dx * moment[d];
    }
    return f;
  }
  // Gathers the adjoints of the sums. Returns the slope of the forms of P2G per cell.
  template <class Support>
  __device__ Vector<T, D> sum(const Weights<Order, T, D>& w, const Support& support, const HeatForms<T, D>& forms,
                              HeatGathered<T, D, K>& gathered) const {
    Factors f;
#pragma unroll
    for (int k = 0; k < K; k++) f.value[k] = forms.value[k];
#pragma unroll
    for (int d = 0; d < D; d++) {
      f.moment[kHeatTheta][d] = dx * forms.theta[d];
      f.moment[kHeatMean][d] = dx * forms.mean[d];
    }
    Sums<OfSums> sums;
    const Vector<T, D> r = slope(w, support, f, sums);
#pragma unroll
    for (int k = 0; k < K; k++) {
      gathered.value[k] = sums.value[k];
#pragma unroll
      for (int d = 0; d < D; d++) gathered.moment[k][d] = k >= kHeatTheta ? dx * sums.moment[k][d] : T(0);
    }
    return r;
  }
  template <class Support>
  __device__ HeatGradients<T, D> gradients_of(const Weights<Order, T, D>& w, const Support& solved) const {
    const Sums<OfSolved> sums = sum_support<OfSolved>(solved, w);
    const T scale = T(a.inverse_inertia) * dx;
    HeatGradients<T, D> g;
#pragma unroll
    for (int d = 0; d < D; d++) {
      g.after[d] = scale * sums.moment[first_gradient][d];
      g.multiplier[d] = scale * sums.moment[first_gradient + 1][d];
    }
    return g;
  }
  // Slope of forms per cell. The sums of the shape are set, too.
  template <class Support, class S>
  __device__ Vector<T, D> slope(const Weights<Order, T, D>& w, const Support& support, const Factors& f,
                                Sums<S>& sums) const {
    const T none[K][D] = {};
    position_slope<S, false>(support, w, f.value, f.moment, none, sums);
    Vector<T, D> x;
#pragma unroll
    for (int d = 0; d < D; d++) x[d] = sums.slope[d];
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
