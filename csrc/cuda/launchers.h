#pragma once

#include <cuda_runtime_api.h>

#include "grid/status.h"
#include "transfer/arguments.h"

// Entry points of the CUDA kernels; defined for float and double, D = 2 and 3, Order = 2 and 3.
namespace mpm::cuda {

using Stream = cudaStream_t;

template <class T, int D>
int64_t activate_workspace(const ActivateArguments<T, D>&);
template <int Order, class T, int D>
void activate(const ActivateArguments<T, D>&, Stream);
template <int Order, class T, int D>
void p2g(const P2GArguments<T, D>&, Stream);
template <int Order, class T, int D>
void p2g_backward(const P2GBackwardArguments<T, D>&, Stream);
template <int Order, class T, int D>
void scatter(const ScatterArguments<T, D>&, Stream);
template <int Order, class T, int D>
void gather(const GatherArguments<T, D>&, Stream);
template <int Order, class T, int D>
void position_gradient(const PositionGradientArguments<T, D>&, Stream);

}  // namespace mpm::cuda
