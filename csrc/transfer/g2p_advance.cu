#include "transfer/advance_gather.cuh"

namespace mpm::cuda {

template <int Order, class T, int D>
void g2p_advance(const G2PAdvanceArguments<T, D>& a, Stream stream) {
  const auto with = [&]<bool Gradient, bool Displaced>() {
    launch_gather(AdvanceGather<Order, T, D, Gradient, Displaced>(a), stream);
  };
  if constexpr (Order == 2 && sizeof(T) == sizeof(float)) {  // as for the kernels of laws in P2G
    if (a.own.rows > 0 && a.late) return launch_gather(OwnAdvanceGather<T, D, false>(a), stream);
    if (a.own.rows > 0) return launch_gather(OwnAdvanceGather<T, D, true>(a), stream);
    if (a.late) return launch_gather(AdvanceGather<Order, T, D, false, true, false>(a), stream);
  }
  if (a.form == StressForm::gradient)
    a.displacement ? with.template operator()<true, true>() : with.template operator()<true, false>();
  else
    a.displacement ? with.template operator()<false, true>() : with.template operator()<false, false>();
}

MPM_INSTANTIATE_ORDERS(g2p_advance, G2PAdvanceArguments)

}  // namespace mpm::cuda
