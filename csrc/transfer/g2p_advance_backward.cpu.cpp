#include "common/instantiate.h"
#include "transfer/advance.h"

// Adjoint of G2P with the end of the step, one after the other: sums of a chunk would wait for its particles.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
void advance_backward(const AdvanceBackwardArguments<T, D>&);
template <int Order, class T, int D>
void scatter(const ScatterArguments<T, D>&);

template <int Order, class T, int D>
void g2p_advance_backward(const G2PAdvanceBackwardArguments<T, D>& a) {
  advance_backward(a.advance);
  scatter<Order>(a.scatter);
}

MPM_INSTANTIATE_ORDERS(g2p_advance_backward, G2PAdvanceBackwardArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
