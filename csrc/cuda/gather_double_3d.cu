#include "cuda/gather.cuh"

namespace mpm::cuda {

INSTANTIATE_GATHER(2, double, 3)
INSTANTIATE_GATHER(3, double, 3)

}  // namespace mpm::cuda
