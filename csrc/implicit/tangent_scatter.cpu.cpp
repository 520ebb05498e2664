#include "implicit/arguments.h"
#include "implicit/grouped.cpu.h"
#include "transfer/scatter.cpu.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

template <int Order, bool Gradient, class T, int D>
void scatter_with(const TangentScatterArguments<T, D>& a) {
  const T scale = stress_scale<Order>(a.form, a.topology.geometry.inverse_dx);
  scatter_channels<Order, !Gradient, Gradient>(
      a.topology, a.x, a.nodes, 0, D, [&]<int N>(const GroupOf<N>& g, const Pack<T, N> f[D], int) {
        using P = Pack<T, N>;
        const Grouped<T, N> at{g};
        const auto tangent = load_tangent<Grouped<T, N>, T, D>(at, a.tangent);
        const Matrix<P, D> stress = P(scale) * apply_tangent(tangent, load_matrix<D>(at, a.gradient));
        Contribution<P, D> contribution;
        MPM_UNROLL for (int c = 0; c < kChannels; c++) {
          contribution.value[c] = P(0);
          MPM_UNROLL for (int d = 0; d < D; d++) {
            const P entry = c < D ? stress[c < D ? c : 0][d] : P(0);
            contribution.slope[d][c] = Gradient ? P(0) : entry;
            contribution.gradient[d][c] = Gradient ? entry : P(0);
            if (!Gradient) contribution.value[c] = contribution.value[c] - entry * f[d];
          }
        }
        return contribution;
      });
}

}  // namespace

template <int Order, class T, int D>
void tangent_scatter(const TangentScatterArguments<T, D>& a) {
  a.form == StressForm::mls ? scatter_with<Order, false>(a) : scatter_with<Order, true>(a);
}

MPM_INSTANTIATE_ORDERS(tangent_scatter, TangentScatterArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
