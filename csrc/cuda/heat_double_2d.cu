#include "cuda/heat.cuh"

namespace mpm::cuda {

INSTANTIATE_HEAT(double, 2)

}  // namespace mpm::cuda
