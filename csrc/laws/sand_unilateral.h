#pragma once

#include "laws/sand.h"

// Sand with the quartic energy without tension.
namespace mpm {
inline namespace TORCH_MPM_ISA {

struct SandUnilateral : Sand<UnilateralQuartic> {
  static constexpr const char* name = "sand_unilateral";
};

MPM_REGISTER_LAW(SandUnilateral)

struct SandUnilateralExact : Sand<ExactFlow<UnilateralQuartic>> {
  static constexpr const char* name = "sand_unilateral_exact";
};

MPM_REGISTER_LAW(SandUnilateralExact)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
