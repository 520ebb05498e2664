#include "cuda/g2p_advance.cuh"

namespace mpm::cuda {

INSTANTIATE_G2P_ADVANCE(double, 2)
INSTANTIATE_G2P_ADVANCE(double, 3)

}  // namespace mpm::cuda
