#pragma once

#include "cuda/launchers.h"
#include "math/svd_kernels.h"

namespace mpm::cuda {

template <class T, int D>
void svd(const SVDArguments<T, D>&, Stream);
template <class T, int D>
void polar(const PolarArguments<T, D>&, Stream);

}  // namespace mpm::cuda
