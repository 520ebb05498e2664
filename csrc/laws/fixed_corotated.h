#pragma once

#include "laws/elasticity.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Fixed corotated elastic solid (Stomakhin et al. 2012, section 4).
struct FixedCorotated : FixedCorotatedElasticity {
  static constexpr const char* name = "fixed_corotated";
  static constexpr std::array parameters = {not_negative("mu", "Pa"), real("lam", "Pa")};
  static constexpr bool twice_differentiable_energy = true;
};

MPM_REGISTER_LAW(FixedCorotated)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
