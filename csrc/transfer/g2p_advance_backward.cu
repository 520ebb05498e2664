#include "transfer/advance.h"
#include "transfer/scatter.cuh"

namespace mpm::cuda {

template <class T, int D>
void advance_backward(const AdvanceBackwardArguments<T, D>&, Stream);
template <int Order, class T, int D>
void scatter(const ScatterArguments<T, D>&, Stream);

namespace {

// P2G stages the adjoints of the motion of a particle, as computed by the adjoint of the end of the step.
template <int Order, class T, int D>
struct MotionAdjointSource {
  using Shape = ScatterShape<Order, T, D, 0, D, false>;
  static constexpr int resident = 0;
  static constexpr bool displaced = false;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position;
  AdvanceBackwardArguments<T, D> advance;
  T moment_scale;  // converts to cells

  explicit MotionAdjointSource(const G2PAdvanceBackwardArguments<T, D>& a)
      : topology(a.scatter.topology),
        nodes(a.scatter.nodes),
        position(a.scatter.x),
        advance(a.advance),
        moment_scale(T(a.scatter.moment_scale * double(topology.geometry.dx))) {}

  __device__ Contribution<T, D, 0, D> load(int p, int) const {
    const MotionAdjoint<T, D> motion = advance_particle_backward(advance, One<T>{p});
    Contribution<T, D, 0, D> c;
#pragma unroll
    for (int i = 0; i < D; i++) {
      c.value[i] = motion.velocity[i];
#pragma unroll
      for (int j = 0; j < D; j++) c.moment[i][j] = moment_scale * motion.affine[i][j];
    }
    return c;
  }
  __device__ const Contribution<T, D, 0, D>& contribution(const Contribution<T, D, 0, D>& loaded) const {
    return loaded;
  }
};

}  // namespace

// In one pass where the affine field updates the deformation; in a fixed order P2G passes over some particles many
// times.
template <int Order, class T, int D>
void g2p_advance_backward(const G2PAdvanceBackwardArguments<T, D>& a, Stream stream) {
  const bool moves = a.scatter.moment.pointer && !a.scatter.gradient.pointer && a.scatter.topology.max_blocks > 0;
  if (moves && !a.scatter.deterministic) return launch_scatter(MotionAdjointSource<Order, T, D>(a), stream);
  advance_backward(a.advance, stream);
  scatter<Order>(a.scatter, stream);
}

MPM_INSTANTIATE_ORDERS(g2p_advance_backward, G2PAdvanceBackwardArguments)

}  // namespace mpm::cuda
