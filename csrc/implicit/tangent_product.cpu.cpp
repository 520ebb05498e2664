#include "cpu/lanes.h"
#include "implicit/arguments.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
void tangent_product(const TangentProductArguments<T, D>& a) {
  const Field<const T> given = {a.gradient.pointer, {a.gradient.stride[0], a.gradient.stride[1], a.gradient.stride[2]}};
  for_groups<T>(a.particles, [&](const auto& at) {
    const auto tangent = load_tangent<std::decay_t<decltype(at)>, T, D>(at, a.tangent);
    store_matrix<D>(at, a.gradient, apply_tangent(tangent, load_matrix<D>(at, given)));
  });
}

MPM_INSTANTIATE(tangent_product, TangentProductArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
