#pragma once

#include "boundary/grid_update.h"
#include "cpu/launchers.h"

namespace mpm::cpu {

template <class T, int D>
void grid_update(const GridUpdateArguments<T, D>&, Stream);
template <class T, int D>
void grid_update_backward(const GridUpdateBackwardArguments<T, D>&, Stream);

}  // namespace mpm::cpu
