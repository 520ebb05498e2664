#include "cuda/gather.cuh"

namespace mpm::cuda {

INSTANTIATE_GATHER(2, float, 2)
INSTANTIATE_GATHER(3, float, 2)

}  // namespace mpm::cuda
