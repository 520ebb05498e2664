#include "transfer/scatter.cuh"

// After it: mpm::min of laws/hencky_strain.h would take the place of CUDA's.
#include "implicit/arguments.h"

namespace mpm::cuda {

// The stress that the tangents make of velocity gradients, computed where the scatter loads its particles.
template <int Order, class T, int D, bool Gradient>
struct TangentSource {
  using Shape = ScatterShape<Order, T, D, 0, D, Gradient>;
  static constexpr int resident = 0;
  static constexpr bool drifts = false;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position;
  Field<const T> tangent, gradient;
  T scale;  // to cells

  explicit TangentSource(const TangentScatterArguments<T, D>& a)
      : topology(a.topology),
        nodes(a.nodes),
        position(a.x),
        tangent(a.tangent),
        gradient(a.gradient),
        scale(stress_scale<Order>(a.form, a.topology.geometry.inverse_dx)) {}

  __device__ Contribution<T, D, 0, D> load(int p, int) const {
    const One<T> at{p};
    const Matrix<T, D> stress =
        scale * apply_tangent(load_tangent<One<T>, T, D>(at, tangent), load_matrix<D>(at, gradient));
    Contribution<T, D, 0, D> c;
#pragma unroll
    for (int k = 0; k < D; k++) {
      c.value[k] = T(0);
#pragma unroll
      for (int i = 0; i < D; i++) {
        c.moment[k][i] = Gradient ? T(0) : stress[k][i];
        c.gradient[k][i] = Gradient ? stress[k][i] : T(0);
      }
    }
    return c;
  }
  __device__ const Contribution<T, D, 0, D>& contribution(const Contribution<T, D, 0, D>& loaded) const {
    return loaded;
  }
};

template <int Order, class T, int D>
void tangent_scatter(const TangentScatterArguments<T, D>& a, Stream stream) {
  if (a.form == StressForm::mls)
    launch_scatter(TangentSource<Order, T, D, false>(a), a.deterministic, stream);
  else
    launch_scatter(TangentSource<Order, T, D, true>(a), a.deterministic, stream);
}

MPM_INSTANTIATE_ORDERS(tangent_scatter, TangentScatterArguments)

}  // namespace mpm::cuda
