#pragma once

#include "laws/sand.h"

// Sand with the quadratic energy of Klár et al. 2016, whose exact flow is the radial one.
namespace mpm {
inline namespace TORCH_MPM_ISA {

struct SandHencky : Sand<Quadratic> {
  static constexpr const char* name = "sand_hencky";
};

MPM_REGISTER_LAW(SandHencky)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
