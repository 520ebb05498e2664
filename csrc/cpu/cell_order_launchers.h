#pragma once

#include "cpu/launchers.h"
#include "transfer/cell_order.h"

namespace mpm::cpu {

template <int Order, class T, int D>
void cell_order(const CellOrderArguments<T, D>&, Stream);

}  // namespace mpm::cpu
