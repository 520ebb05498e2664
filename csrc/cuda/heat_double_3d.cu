#include "cuda/heat.cuh"

namespace mpm::cuda {

INSTANTIATE_HEAT(double, 3)

}  // namespace mpm::cuda
