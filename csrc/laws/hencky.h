#pragma once

#include "laws/principal_law.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Elastic solid with the quadratic energy of the Hencky strains: St. Venant-Kirchhoff's in logarithmic strain.
struct HenckyElastic : HenckyElasticity {
  static constexpr const char* name = "hencky";
  static constexpr int parameters = 2;  // μ, λ [Pa]
  static constexpr int history = 0;
  static constexpr bool plastic = false;
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
