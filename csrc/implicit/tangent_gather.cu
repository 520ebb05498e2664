#include "transfer/gather.cuh"

// Included after it: mpm::min of laws/hencky_strain.h would otherwise replace that of CUDA.
#include "implicit/arguments.h"

namespace mpm::cuda {

// Stress of the tangents for velocity gradients, computed where these are gathered: there the loads of tangents overlap
// those of nodes, while a scatter would stall for them.
template <int Order_, class T_, int D_, bool Gradient>
struct TangentGather {
  using T = T_;
  static constexpr int Order = Order_, D = D_, K = D;
  static constexpr int resident = 4;
  using Shape = SumShape<Order, T, D, K, 0, !Gradient, Gradient, SlopeForm::none>;
  struct Loaded {
    Tangent<T, D> tangent;
  };
  using Result = Matrix<T, D>;
  Topology<T, D> topology;
  NodeField<const T> nodes;
  Columns<const T, D> position;
  Columns<const T, kTangentEntries<D>> tangent;
  Columns<T, D * D> stress;
  T scale;  // converts from cells

  explicit TangentGather(const TangentGatherArguments<T, D>& a)
      : topology(a.gather.topology),
        nodes(a.gather.nodes),
        position(a.gather.x),
        tangent(a.tangent),
        stress(Gradient ? a.gather.gradient : a.gather.moment, D),
        scale(Gradient ? topology.geometry.inverse_dx : T(a.gather.moment_scale * double(topology.geometry.dx))) {}

  __device__ Loaded load(int p, int) const {
    Loaded l;
    for_entries(l.tangent, [&](int k, T& entry) { entry = tangent.at(p, k); });
    mirror_diagonal(l.tangent);
    return l;
  }
  template <class Support>
  __device__ Result compute(const Loaded& l, const Weights<Order, T, D>& w, const Support& support) const {
    const Sums<Shape> s = sum_support<Shape>(support, w);
    Result L;
#pragma unroll
    for (int k = 0; k < D; k++)
#pragma unroll
      for (int i = 0; i < D; i++) L[k][i] = scale * (Gradient ? s.gradient[k][i] : s.moment[k][i]);
    return apply_tangent(l.tangent, L);
  }
  __device__ void write(int p, const Loaded&, const Result& r) const {
#pragma unroll
    for (int k = 0; k < D; k++)
#pragma unroll
      for (int i = 0; i < D; i++) stress.at(p, k * D + i) = r[k][i];
  }
  __device__ void skip(int p) const { write(p, {}, zero_matrix<T, D>()); }
};

template <int Order, class T, int D>
void tangent_gather(const TangentGatherArguments<T, D>& a, Stream stream) {
  if (a.gather.gradient.pointer)
    launch_gather(TangentGather<Order, T, D, true>(a), stream);
  else
    launch_gather(TangentGather<Order, T, D, false>(a), stream);
}

MPM_INSTANTIATE_ORDERS(tangent_gather, TangentGatherArguments)

}  // namespace mpm::cuda
