#pragma once

#include "laws/neo_hookean_solid.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

MPM_REGISTER_LAW(NeoHookean)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
