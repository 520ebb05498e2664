#include "cuda/gather.cuh"

namespace mpm::cuda {

INSTANTIATE_GATHER(2, float, 3)
INSTANTIATE_GATHER(3, float, 3)

}  // namespace mpm::cuda
