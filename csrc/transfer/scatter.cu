#include "transfer/scatter.cuh"

namespace mpm::cuda {

// Channels [first, first + K).
template <int Order, class T, int D, int K, bool Gradient>
struct FieldSource {
  using Shape = ScatterShape<Order, T, D, 0, K, Gradient>;
  static constexpr int resident = 0;
  static constexpr bool displaced = false;
  Topology<T, D> topology;
  NodeField<T> nodes;
  Columns<const T, D> position;
  Columns<const T, K> value;
  Columns<const T, K * D> moment, gradient;
  T moment_scale, gradient_scale;  // converts to cells

  FieldSource(const ScatterArguments<T, D>& a, int first)
      : topology(a.topology),
        nodes(a.nodes),
        position(a.x),
        value(channels_from(a.value, first)),
        moment(channels_from(a.moment, first), D),
        gradient(channels_from(a.gradient, first), D),
        moment_scale(T(a.moment_scale * double(a.topology.geometry.dx))),
        gradient_scale(a.topology.geometry.inverse_dx) {
    nodes.pointer += first;
  }

  __device__ Contribution<T, D, 0, K> load(int p, int) const {
    Contribution<T, D, 0, K> c;
#pragma unroll
    for (int k = 0; k < K; k++) {
      c.value[k] = value.present() ? value.at(p, k) : T(0);
#pragma unroll
      for (int i = 0; i < D; i++) {
        c.moment[k][i] = moment.present() ? moment_scale * moment.at(p, k * D + i) : T(0);
        c.gradient[k][i] = Gradient ? gradient_scale * gradient.at(p, k * D + i) : T(0);
      }
    }
    return c;
  }
  __device__ const Contribution<T, D, 0, K>& contribution(const Contribution<T, D, 0, K>& loaded) const {
    return loaded;
  }
};

template <int Order, class T, int D>
void p2g(const P2GArguments<T, D>& a, Stream stream) {
  const auto with = [&]<Stress Kind, bool Displaced>() {
    launch_scatter(MomentumSource<Order, T, D, Kind, Displaced>(a), a.deterministic, stream);
  };
  if (!a.stress.pointer)
    with.template operator()<Stress::none, false>();
  else if (a.form == StressForm::mls)
    a.displaced ? with.template operator()<Stress::moment, true>() : with.template operator()<Stress::moment, false>();
  else
    a.displaced ? with.template operator()<Stress::gradient, true>()
                : with.template operator()<Stress::gradient, false>();
}

template <int Order, class T, int D>
void scatter(const ScatterArguments<T, D>& a, Stream stream) {
  constexpr int two_averages = 4;  // the channels of a heat step
  for_channels<D, two_averages>(a.nodes.channels, a.gradient.pointer, [&]<int K, bool Gradient>(int first) {
    launch_scatter(FieldSource<Order, T, D, K, Gradient>(a, first), a.deterministic, stream);
  });
}

MPM_INSTANTIATE_ORDERS(p2g, P2GArguments)
MPM_INSTANTIATE_ORDERS(scatter, ScatterArguments)

}  // namespace mpm::cuda
