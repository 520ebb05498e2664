#include "cuda/heat.cuh"

namespace mpm::cuda {

INSTANTIATE_HEAT(float, 3)

}  // namespace mpm::cuda
