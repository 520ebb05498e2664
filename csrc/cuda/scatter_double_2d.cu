#include "cuda/scatter.cuh"

namespace mpm::cuda {

INSTANTIATE_SCATTER(2, double, 2)
INSTANTIATE_SCATTER(3, double, 2)

}  // namespace mpm::cuda
