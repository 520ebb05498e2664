#pragma once

#include "laws/sand.h"

// Sand with the full quartic energy at yield and the unilateral one for the stress.
namespace mpm {
inline namespace TORCH_MPM_ISA {

struct SandMixed : Sand<MixedQuartic> {
  static constexpr const char* name = "sand_mixed";
};

MPM_REGISTER_LAW(SandMixed)

struct SandMixedExact : Sand<ExactFlow<MixedQuartic>> {
  static constexpr const char* name = "sand_mixed_exact";
};

MPM_REGISTER_LAW(SandMixedExact)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
