#pragma once

#include "boundary/grid_update.h"
#include "cuda/launchers.h"

namespace mpm::cuda {

template <class T, int D>
void grid_update(const GridUpdateArguments<T, D>&, Stream);
template <class T, int D>
void grid_update_backward(const GridUpdateBackwardArguments<T, D>&, Stream);

}  // namespace mpm::cuda
