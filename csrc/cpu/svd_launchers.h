#pragma once

#include "cpu/launchers.h"
#include "math/svd_kernels.h"

namespace mpm::cpu {

template <class T, int D>
void svd(const SVDArguments<T, D>&, Stream);
template <class T, int D>
void polar(const PolarArguments<T, D>&, Stream);

}  // namespace mpm::cpu
