#pragma once

#include "laws/fluid.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

MPM_REGISTER_LAW(WeaklyCompressible)
MPM_REGISTER_LAW(ViscousFluid)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
