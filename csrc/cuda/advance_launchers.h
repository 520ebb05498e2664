#pragma once

#include "cuda/launchers.h"
#include "kinematics/advance.h"

namespace mpm::cuda {

template <class T, int D>
void advance(const AdvanceArguments<T, D>&, Stream);
template <class T, int D>
void advance_backward(const AdvanceBackwardArguments<T, D>&, Stream);

}  // namespace mpm::cuda
