#pragma once

#include "common/matrix.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Length with derivative zero at the zero vector, from its square.
template <class T>
MPM_HD T safe_root(const T& squared) {
  const auto positive = squared > T(0);
  return select(positive, sqrt(select(positive, squared, T(1))), T(0));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
