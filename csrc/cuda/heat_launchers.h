#pragma once

#include "cuda/launchers.h"
#include "heat/patches.h"
#include "heat/solve.h"

namespace mpm::cuda {

template <class T, int D>
int64_t heat_workspace(const HeatArguments<T, D>&);
template <int Order, class T, int D>
void heat_cg(const HeatArguments<T, D>&, Stream);
template <class T, int D>
int64_t heat_operator_workspace(const HeatOperatorArguments<T, D>&);
template <int Order, class T, int D>
void heat_operator(const HeatOperatorArguments<T, D>&, Stream);
template <int Order, class T, int D>
void heat_stencil(const HeatOperatorArguments<T, D>&, Stream);
template <class T, int D>
void heat_patches(const PatchArguments<T, D>&, Stream);

}  // namespace mpm::cuda
