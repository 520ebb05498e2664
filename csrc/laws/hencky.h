#pragma once

#include "laws/elasticity.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Elastic solid with the quadratic energy of the Hencky strains: St. Venant-Kirchhoff's in logarithmic strain.
struct HenckyElastic : HenckyElasticity {
  static constexpr const char* name = "hencky";
  static constexpr std::array parameters = {not_negative("mu", "Pa"), real("lam", "Pa")};
  static constexpr bool twice_differentiable_energy = true;
};

MPM_REGISTER_LAW(HenckyElastic)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
