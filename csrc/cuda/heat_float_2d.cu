#include "cuda/heat.cuh"

namespace mpm::cuda {

INSTANTIATE_HEAT(float, 2)

}  // namespace mpm::cuda
