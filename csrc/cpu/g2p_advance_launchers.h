#pragma once

#include "cpu/launchers.h"
#include "kinematics/advance.h"

namespace mpm::cpu {

template <int Order, class T, int D>
void g2p_advance(const G2PAdvanceArguments<T, D>&, Stream);

}  // namespace mpm::cpu
