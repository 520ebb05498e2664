#include "cuda/scatter.cuh"

namespace mpm::cuda {

INSTANTIATE_SCATTER(2, double, 3)
INSTANTIATE_SCATTER(3, double, 3)

}  // namespace mpm::cuda
