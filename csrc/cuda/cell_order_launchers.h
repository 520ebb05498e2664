#pragma once

#include "cuda/launchers.h"
#include "transfer/cell_order.h"

namespace mpm::cuda {

template <int Order, class T, int D>
void cell_order(const CellOrderArguments<T, D>&, Stream);

}  // namespace mpm::cuda
