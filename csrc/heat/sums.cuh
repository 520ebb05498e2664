#pragma once

#include "heat/solve.h"

// Particles in the form of the heat kernels, and sums over lanes and thread blocks in a fixed order.
namespace mpm::cuda {

template <class T, int D>
struct alignas(16) PackedParticle {
  T f[D], conductance;
};

__device__ inline int lane_index() { return threadIdx.x % 32; }

// Sum over neighbouring lanes, in each of them.
template <int Lanes, class V>
__device__ V sum_of_lanes(V s) {
  constexpr int words = sizeof(V) / 4;
  const unsigned mask = Lanes == 32 ? ~0u : ((1u << Lanes % 32) - 1) << lane_index() / Lanes * Lanes;
#pragma unroll
  for (int o = Lanes / 2; o > 0; o /= 2) {
    V other;
#pragma unroll
    for (int k = 0; k < words; k++)
      reinterpret_cast<int*>(&other)[k] = __shfl_xor_sync(mask, reinterpret_cast<const int*>(&s)[k], o);
    s.add(other);
  }
  return s;
}

struct Curvature {
  double value;
  __device__ void add(const Curvature& o) { value += o.value; }
};

// Sum over the threads of a block; valid in thread 0.
template <class V>
__device__ V sum_of_block(V value) {
  __shared__ V parts[32];
  value = sum_of_lanes<32>(value);
  __syncthreads();
  if (threadIdx.x % 32 == 0) parts[threadIdx.x / 32] = value;
  __syncthreads();
  if (threadIdx.x == 0)
    for (int k = 1; k < blockDim.x / 32; k++) value.add(parts[k]);
  return value;
}

// Sum over the threads of a block before this one.
__device__ inline int64_t sum_before(int64_t value) {
  __shared__ int64_t parts[32];
  int64_t sum = value;
#pragma unroll
  for (int o = 1; o < 32; o *= 2) {
    const int64_t v = __shfl_up_sync(~0u, sum, o);
    if (lane_index() >= o) sum += v;
  }
  __syncthreads();
  if (lane_index() == 31) parts[threadIdx.x / 32] = sum;
  __syncthreads();
  for (int k = 0; k < threadIdx.x / 32; k++) sum += parts[k];
  return sum - value;
}

}  // namespace mpm::cuda
