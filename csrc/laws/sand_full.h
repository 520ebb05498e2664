#pragma once

#include "laws/sand.h"

// Sand with the full quartic energy.
namespace mpm {
inline namespace TORCH_MPM_ISA {

struct SandFull : Sand<FullQuartic> {
  static constexpr const char* name = "sand_full";
};

MPM_REGISTER_LAW(SandFull)

struct SandFullExact : Sand<ExactFlow<FullQuartic>> {
  static constexpr const char* name = "sand_full_exact";
};

MPM_REGISTER_LAW(SandFullExact)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
