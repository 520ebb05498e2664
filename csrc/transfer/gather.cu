#include "transfer/gather.cuh"

// Gather, its position gradient, and the adjoint of P2G.
namespace mpm::cuda {

// Channels [first, ...) of a node field.
template <class T>
NodeField<const T> nodes_from(NodeField<const T> n, int first) {
  n.pointer += first;
  return n;
}

// ---- Gather

template <int Order_, class T_, int D_, int K_, bool Gradient>
struct FieldGather {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_;
  static constexpr int resident = Gradient ? 5 : 6;
  using Shape = SumShape<Order, T, D, K, 0, true, Gradient, SlopeForm::none>;
  struct Loaded {};
  using Result = Sums<Shape>;
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  Columns<T, K> value;
  Columns<T, K * D> moment, gradient;
  T moment_scale, gradient_scale;  // converts from cells
  T lost;

  FieldGather(const GatherArguments<T, D>& a, int first)
      : topology(a.topology),
        nodes(nodes_from(a.nodes, first)),
        position(a.x),
        value(channels_from(a.value, first)),
        moment(channels_from(a.moment, first), D),
        gradient(channels_from(a.gradient, first), D),
        moment_scale(T(a.moment_scale * double(a.topology.geometry.dx))),
        gradient_scale(a.topology.geometry.inverse_dx),
        lost(T(a.lost)) {}

  __device__ Loaded load(int, int) const { return {}; }
  template <class Support>
  __device__ Result compute(Loaded, const Weights<Order, T, D>& w, const Support& support) const {
    return sum_support<Shape>(support, w);
  }
  __device__ void write(int p, const Loaded&, const Result& s) const {
#pragma unroll
    for (int k = 0; k < K; k++) {
      value.write(p, k, s.value[k]);
#pragma unroll
      for (int i = 0; i < D; i++) {
        moment.write(p, k * D + i, moment_scale * s.moment[k][i]);
        if (Gradient) gradient.write(p, k * D + i, gradient_scale * s.gradient[k][i]);
      }
    }
  }
  __device__ void skip(int p) const {
    const T nothing = is_finite<D>(read_vector(position, p).e) ? T(0) : lost;
#pragma unroll
    for (int k = 0; k < K; k++) value.write(p, k, nothing);
#pragma unroll
    for (int k = 0; k < K * D; k++) {
      moment.write(p, k, nothing);
      gradient.write(p, k, nothing);
    }
  }
};

template <int Order, class T, int D>
void gather(const GatherArguments<T, D>& a, Stream stream) {
  constexpr int increment_and_mean = 2;  // the channels of a heat step
  for_channels<D, increment_and_mean>(a.nodes.channels, a.gradient.pointer, [&]<int K, bool Gradient>(int first) {
    launch_gather(FieldGather<Order, T, D, K, Gradient>(a, first), stream);
  });
}

// ---- Position gradient

template <int Order_, class T_, int D_, int K_, bool Gradient>
struct FieldPositionGradient {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = K_;
  static constexpr int resident = Gradient ? 3 : 5;
  using Shape = SumShape<Order, T, D, K, K, false, false, SlopeForm::affine>;
  struct Loaded {
    T value[K], moment[K][D], gradient[K][D];  // moments and gradients per cell
  };
  using Result = mpm::Vector<T, D>;
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  Columns<const T, K> value;
  Columns<const T, K * D> moment, gradient;
  Columns<T, D> out;
  T moment_scale, inverse_dx;
  bool adds;  // added to the present values, or to those of the previous channels

  FieldPositionGradient(const PositionGradientArguments<T, D>& a, int first)
      : topology(a.topology),
        nodes(nodes_from(a.nodes, first)),
        position(a.x),
        value(channels_from(a.value, first)),
        moment(channels_from(a.moment, first), D),
        gradient(channels_from(a.gradient, first), D),
        out(a.position_gradient),
        moment_scale(T(a.moment_scale * double(a.topology.geometry.dx))),
        inverse_dx(a.topology.geometry.inverse_dx),
        adds(a.adds || first > 0) {}

  __device__ Loaded load(int p, int) const {
    Loaded l;
#pragma unroll
    for (int k = 0; k < K; k++) {
      l.value[k] = value.at(p, k);
#pragma unroll
      for (int i = 0; i < D; i++) {
        l.moment[k][i] = moment.present() ? moment_scale * moment.at(p, k * D + i) : T(0);
        l.gradient[k][i] = Gradient ? inverse_dx * gradient.at(p, k * D + i) : T(0);
      }
    }
    return l;
  }
  template <class Support>
  __device__ Result compute(const Loaded& l, const Weights<Order, T, D>& w, const Support& support) const {
    Sums<Shape> s;
    position_slope<Shape, Gradient>(support, w, l.value, l.moment, l.gradient, s);
    Result r;
#pragma unroll
    for (int i = 0; i < D; i++) r[i] = inverse_dx * s.slope[i];
    return r;
  }
  // Present values are loaded before any is stored, as in common/lanes.h.
  __device__ void write(int p, const Loaded&, const Result& r) const {
    Result sum = r;
#pragma unroll
    for (int i = 0; i < D; i++) sum[i] = adds ? out.at(p, i) + r[i] : r[i];
#pragma unroll
    for (int i = 0; i < D; i++) out.at(p, i) = sum[i];
  }
  __device__ void skip(int p) const { write(p, {}, {}); }
};

template <int Order, class T, int D>
void position_gradient(const PositionGradientArguments<T, D>& a, Stream stream) {
  for_channels<D>(a.nodes.channels, a.gradient.pointer, [&]<int K, bool Gradient>(int first) {
    launch_gather(FieldPositionGradient<Order, T, D, K, Gradient>(a, first), stream);
  });
}

// ---- Adjoint of P2G

template <int Order_, class T_, int D_, bool Gradient>
struct MomentumAdjoint {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = 1 + D;
  static constexpr int resident = Gradient ? 2 : 4;
  using Shape = SumShape<Order, T, D, K, 1, true, Gradient, SlopeForm::affine>;
  using Loaded = ParticleMomentum<T, D>;
  struct Result {
    mpm::Vector<T, D> x;
    ParticleMomentum<T, D> particle;
  };
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  MomentumFields<Order, T, D> fields;
  Columns<T, 1> mass, volume, dt;
  Columns<T, D> x, velocity;
  Columns<T, D * D> affine, stress;
  bool adds;

  explicit MomentumAdjoint(const P2GBackwardArguments<T, D>& a)
      : topology(a.forward.topology),
        nodes(a.grad_nodes),
        position(a.forward.x),
        fields(a.forward),
        mass(a.mass),
        volume(a.volume),
        dt(a.dt),
        x(a.x),
        velocity(a.velocity),
        affine(a.affine, D),
        stress(a.stress, D),
        adds(a.adds) {}

  __device__ Loaded load(int p, int scene) const { return fields.read(p, scene, fields.stress.present()); }
  template <class Support>
  __device__ Result compute(const Loaded& particle, const Weights<Order, T, D>& w, const Support& support) const {
    const NodeMomentum<T, D> m = fields.to_nodes(particle, fields.form, fields.stress.present());
    T value[K], moment[K][D], gradient[K][D];
    value[0] = m.mass;
#pragma unroll
    for (int i = 0; i < D; i++) {
      value[1 + i] = m.momentum[i];
      moment[0][i] = gradient[0][i] = T(0);
#pragma unroll
      for (int j = 0; j < D; j++) {
        moment[1 + i][j] = m.moment[i][j];
        gradient[1 + i][j] = m.gradient[i][j];
      }
    }
    Sums<Shape> s;
    position_slope<Shape, Gradient>(support, w, value, moment, gradient, s);
    Result r;
    NodeMomentum<T, D> sums;
    sums.mass = s.value[0];
#pragma unroll
    for (int i = 0; i < D; i++) {
      sums.momentum[i] = s.value[1 + i];
#pragma unroll
      for (int j = 0; j < D; j++) {
        sums.moment[i][j] = s.moment[1 + i][j];
        sums.gradient[i][j] = Gradient ? s.gradient[1 + i][j] : T(0);
      }
    }
#pragma unroll
    for (int j = 0; j < D; j++) r.x[j] = fields.inverse_dx * s.slope[j];
    r.particle = fields.adjoint(particle, sums);
    return r;
  }
  template <int N>
  __device__ T sum(const Columns<T, N>& to, int p, int k, const T& value) const {
    return adds && to.present() ? to.at(p, k) + value : value;
  }
  // Present values are loaded before any is stored, as in common/lanes.h.
  __device__ void write(int p, const Loaded&, const Result& r) const {
    const T by_mass = sum(mass, p, 0, r.particle.mass), by_volume = sum(volume, p, 0, r.particle.volume);
    mpm::Vector<T, D> by_x;
#pragma unroll
    for (int i = 0; i < D; i++) by_x[i] = sum(x, p, i, r.x[i]);
    mass.write(p, 0, by_mass);
    volume.write(p, 0, by_volume);
    dt.write(p, 0, r.particle.dt);
#pragma unroll
    for (int i = 0; i < D; i++) {
      x.write(p, i, by_x[i]);
      velocity.write(p, i, r.particle.velocity[i]);
#pragma unroll
      for (int j = 0; j < D; j++) {
        affine.write(p, i * D + j, r.particle.affine[i][j]);
        stress.write(p, i * D + j, r.particle.stress[i][j]);
      }
    }
  }
  __device__ void skip(int p) const { write(p, {}, {}); }
};

// The same after the position gradient of the motion, in one pass.
template <int Order, class T, int D>
struct StepAdjoint : MomentumAdjoint<Order, T, D, false> {
  using Momentum = MomentumAdjoint<Order, T, D, false>;
  using Motion = FieldPositionGradient<Order, T, D, D, false>;
  using Result = typename Momentum::Result;
  static constexpr int Others = D, resident = 4;
  struct Loaded {
    typename Momentum::Loaded momentum;
    typename Motion::Loaded motion;
  };
  Motion motion;
  NodeField<const T> others;

  explicit StepAdjoint(const P2GBackwardArguments<T, D>& a) : Momentum(a), motion(a.motion, 0), others(motion.nodes) {}

  __device__ Loaded load(int p, int scene) const { return {Momentum::load(p, scene), motion.load(p, scene)}; }
  template <class Support, class OtherSupport>
  __device__ Result compute(const Loaded& l, const Weights<Order, T, D>& w, const Support& support,
                            const OtherSupport& other) const {
    const mpm::Vector<T, D> x = motion.compute(l.motion, w, other);
    Result r = Momentum::compute(l.momentum, w, support);
    r.x = x + r.x;
    return r;
  }
  __device__ void write(int p, const Loaded& l, const Result& r) const { Momentum::write(p, l.momentum, r); }
};

template <int Order, class T, int D>
void p2g_backward(const P2GBackwardArguments<T, D>& a, Stream stream) {
  const bool motion = a.motion.nodes.pointer, gradient = has_gradient(a.forward);
  const bool adds = a.adds && a.motion.adds && a.x.pointer && a.motion.position_gradient.pointer == a.x.pointer;
  if (motion && adds && !gradient && !a.motion.gradient.pointer)
    return launch_gather(StepAdjoint<Order, T, D>(a), stream);
  if (motion) position_gradient<Order>(a.motion, stream);
  if (gradient)
    launch_gather(MomentumAdjoint<Order, T, D, true>(a), stream);
  else
    launch_gather(MomentumAdjoint<Order, T, D, false>(a), stream);
}

MPM_INSTANTIATE_ORDERS(gather, GatherArguments)
MPM_INSTANTIATE_ORDERS(p2g_backward, P2GBackwardArguments)
MPM_INSTANTIATE_ORDERS(position_gradient, PositionGradientArguments)

}  // namespace mpm::cuda
