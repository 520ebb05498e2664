#include "cuda/scatter.cuh"

namespace mpm::cuda {

INSTANTIATE_SCATTER(2, float, 2)
INSTANTIATE_SCATTER(3, float, 2)

}  // namespace mpm::cuda
