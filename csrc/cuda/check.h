#pragma once

#include "common/backend.h"

namespace mpm {

// Raises the error of a call of the CUDA runtime.
inline void check_cuda(cudaError_t error) {
  STD_TORCH_CHECK(error == cudaSuccess, "CUDA: ", cudaGetErrorString(error));
}

}  // namespace mpm
