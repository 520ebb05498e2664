#include "cuda/scatter.cuh"

namespace mpm::cuda {

INSTANTIATE_SCATTER(2, float, 3)
INSTANTIATE_SCATTER(3, float, 3)

}  // namespace mpm::cuda
