#pragma once

#include "cuda/launchers.h"
#include "kinematics/advance.h"

namespace mpm::cuda {

template <int Order, class T, int D>
void g2p_advance(const G2PAdvanceArguments<T, D>&, Stream);

}  // namespace mpm::cuda
