#include "common/lanes.h"
#include "cuda/base_block.cuh"
#include "cuda/launch.cuh"
#include "implicit/arguments.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

// Place of a particle: the slot of its base node's block, -1 where it is not transferred.
template <int Order, class T, int D>
__device__ int locate_particle(const NodeBlocksArguments<T, D>& a, const Schedule<const int>& s, int p, int* base,
                               T* f) {
  const int slot = s.base_slot[p];
  if (slot < 0) return -1;
  const Vector<T, D> x = load_vector<D>(One<T>{p}, a.x);
  const int block = a.topology.block[slot];
  return locate_in_block<Order>(a.topology, scene_of(a.topology, block), block, x, base, f) ? slot : -1;
}

// Two entries at a time where there are vector atomics: rows of six begin at whole pairs.
template <int D, class T>
__device__ void add_upper(T* row, const T (&upper)[kSymmetric<D>], bool alone) {
#if __CUDA_ARCH__ >= 900
  if constexpr (sizeof(T) == 4 && kSymmetric<D> % 2 == 0) {
    if (!alone) {
#pragma unroll
      for (int k = 0; k < kSymmetric<D>; k += 2)
        atomicAdd(reinterpret_cast<float2*>(row + k), make_float2(upper[k], upper[k + 1]));
      return;
    }
  }
#endif
#pragma unroll
  for (int k = 0; k < kSymmetric<D>; k++) {
    if (alone)
      row[k] += upper[k];
    else
      atomicAdd(row + k, upper[k]);
  }
}

template <int Order, class T, int D>
__device__ void add_particle(const NodeBlocksArguments<T, D>& a, const Schedule<const int>& s, int p, bool alone) {
  constexpr int S = Order + 1, nodes = D == 2 ? S * S : S * S * S;
  int base[D];
  T f[D], w[D][S], slope[D][S];
  const int slot = locate_particle<Order>(a, s, p, base, f);
  if (slot < 0) return;
#pragma unroll
  for (int i = 0; i < D; i++) {
    BSpline<Order>::weights(f[i], w[i]);
    BSpline<Order>::first_derivatives(f[i], slope[i]);
  }
  const Tangent<T, D> tangent = load_tangent<One<T>, T, D>(One<T>{p}, a.tangent);
#pragma unroll 1
  for (int n = 0; n < nodes; n++) {
    int offset[D], node[D], neighbour = 0;
    for (int i = D - 1, left = n; i >= 0; i--, left /= S) {
      offset[i] = left % S;
      node[i] = base[i] + offset[i];
      neighbour |= int(node[i] >= kBlockWidth) << (D - 1 - i);
    }
    const int to = s.neighbours[(slot << D) + neighbour];
    if (to < 0) continue;
    const Matrix<T, D> block =
        node_block(tangent, gradient_weight<Order, T, D>(a.form, w, slope, offset, f, a.topology.geometry.inverse_dx));
    T* const row = a.nodes.pointer + (int64_t(to) * kBlockNodes<D> + node_in_block<D>(node)) * a.nodes.stride;
    T upper[kSymmetric<D>];
    int channel = 0;
#pragma unroll
    for (int i = 0; i < D; i++)
#pragma unroll
      for (int j = i; j < D; j++, channel++) upper[channel] = block[i][j];
    add_upper<D>(row, upper, alone);
  }
}

// colour < 0: a thread per particle, with atomics. Otherwise a thread per base block of that colour, which processes
// its particles in the order of the index tensor.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kThreads) node_blocks_kernel(const NodeBlocksArguments<T, D> a, int colour) {
  const Topology<T, D>& t = a.topology;
  const Schedule<const int> s = schedule_of(t);
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (colour < 0) {
    if (thread < t.particles) add_particle<Order, T, D>(a, s, t.index[thread], false);
    return;
  }
  if (thread >= t.max_blocks || t.block[thread] < 0 || block_colour(t.geometry, t.block[thread]) != colour) return;
  for (int i = t.offsets[thread]; i < t.offsets[thread + 1]; i++) add_particle<Order, T, D>(a, s, t.index[i], true);
}

}  // namespace

template <int Order, class T, int D>
void node_blocks(const NodeBlocksArguments<T, D>& a, Stream stream) {
  const int64_t count = a.deterministic ? a.topology.max_blocks : a.topology.particles;
  if (a.topology.particles == 0 || count == 0) return;
  for (int colour = a.deterministic ? 0 : -1; colour < (a.deterministic ? 1 << D : 0); colour++)
    launch(node_blocks_kernel<Order, T, D>, unsigned((count + kThreads - 1) / kThreads), kThreads, 0, stream, a,
           colour);
}

MPM_INSTANTIATE_ORDERS(node_blocks, NodeBlocksArguments)

}  // namespace mpm::cuda
