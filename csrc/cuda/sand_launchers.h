#pragma once

#include "cuda/launchers.h"
#include "materials/quartic_kernels.h"

namespace mpm::cuda {

template <class T, int D>
void return_map(const ReturnMapArguments<T, D>&, Stream);
template <class T, int D>
void return_map_backward(const ReturnMapBackwardArguments<T, D>&, Stream);
template <class T, int D>
void sand_scalar(const SandScalarArguments<T, D>&, Stream);

}  // namespace mpm::cuda
