#include "cuda/gather.cuh"

namespace mpm::cuda {

INSTANTIATE_GATHER(2, double, 2)
INSTANTIATE_GATHER(3, double, 2)

}  // namespace mpm::cuda
