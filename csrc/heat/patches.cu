#include "cuda/base_block.cuh"
#include "cuda/columns.cuh"
#include "cuda/launch.cuh"
#include "heat/cell.h"
#include "heat/patches.h"
#include "heat/solve.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

// H_{i, i+e} of one node i: a thread per node, which walks the particles of the blocks that can reach it in their
// order, so that the sums are the same in every run.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kThreads) stencil_kernel(const HeatOperatorArguments<T, D> a) {
  const Topology<T, D>& t = a.topology;
  const int64_t count = int64_t(t.max_blocks) * kBlockNodes<D>, node = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (node >= count) return;
  const int block = t.block[node / kBlockNodes<D>];
  if (block < 0) return;
  int own[D], local[D], inside = int(node % kBlockNodes<D>);
  const int scene = block_coordinates(t.geometry, block, own);
#pragma unroll
  for (int i = D - 1; i >= 0; i--) {
    local[i] = inside % kBlockWidth;
    inside /= kBlockWidth;
  }
  T sum[kPairs<D>] = {};
  for (int o = 0; o < 1 << D; o++) {
    int base_block[D];
    bool reaches = true;
#pragma unroll
    for (int i = 0; i < D; i++) {
      const int before = o >> i & 1;
      base_block[i] = own[i] - before;
      reaches = reaches && base_block[i] >= 0 && (!before || local[i] < Order);
    }
    const int slot = reaches ? t.table[block_index(t.geometry, scene, base_block)] : -1;
    if (slot < 0) continue;
    for (int k = t.offsets[slot]; k < t.offsets[slot + 1]; k++) {
      const int64_t p = t.index[k];
      T w[D][3], m[D][3];  // of the previous node, of the node, and of the next one
      bool touches = true;
#pragma unroll
      for (int i = 0; i < D; i++) {
        const T x = a.x.pointer[p * a.x.stride[0] + i * a.x.stride[1]], base = base_node<Order>(t.geometry, i, x);
        const T place = T(own[i] * kBlockWidth + local[i]) - base;
        touches = touches && place >= T(0) && place <= T(Order);  // false for NaN
        const T f[1] = {distance_in_cells(t.geometry, i, x, base)};
        const CellWeights<Order, T, 1> s(f);
#pragma unroll
        for (int j = 0; j < 3; j++) {
          w[i][j] = m[i][j] = T(0);
#pragma unroll
          for (int n = 0; n <= Order; n++)
            if (place + T(j - 1) == T(n)) {
              w[i][j] = s.weight[0][n];
              m[i][j] = s.moment[0][n];
            }
        }
      }
      if (!touches) continue;
      const T conductance =
          scaled_conductance<Order>(a.conductance.pointer[p * a.conductance.stride[0]], t.geometry.inverse_dx);
#pragma unroll
      for (int pair = 0; pair < kPairs<D>; pair++) {
        int e[D];
        pair_offset<D>(pair, e);
        T dot = T(0);
#pragma unroll
        for (int axis = 0; axis < D; axis++) {
          T product = T(1);
#pragma unroll
          for (int i = 0; i < D; i++) product *= i == axis ? m[i][1] * m[i][1 + e[i]] : w[i][1] * w[i][1 + e[i]];
          dot += product;
        }
        sum[pair] += conductance * dot;
      }
    }
  }
#pragma unroll
  for (int pair = 0; pair < kPairs<D>; pair++) a.sum[pair * count + node] = sum[pair];
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) solve_kernel(const PatchArguments<T, D> a) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < a.count * kCorners<D>) solve_corner(a, i / kCorners<D>, int(i % kCorners<D>));
}

template <class T, int D>
__global__ void __launch_bounds__(kThreads) sum_kernel(const PatchArguments<T, D> a) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < a.count) sum_corners(a, i);
}

unsigned blocks_for(int64_t threads) { return unsigned((threads + kThreads - 1) / kThreads); }

}  // namespace

template <int Order, class T, int D>
void heat_stencil(const HeatOperatorArguments<T, D>& a, Stream stream) {
  const int64_t nodes = int64_t(a.topology.max_blocks) * kBlockNodes<D>;
  if (nodes > 0) launch(stencil_kernel<Order, T, D>, blocks_for(nodes), kThreads, 0, stream, a);
}

template <class T, int D>
void heat_patches(const PatchArguments<T, D>& a, Stream stream) {
  if (a.count == 0) return;
  launch(solve_kernel<T, D>, blocks_for(a.count * kCorners<D>), kThreads, 0, stream, a);
  launch(sum_kernel<T, D>, blocks_for(a.count), kThreads, 0, stream, a);
}

MPM_INSTANTIATE_ORDERS(heat_stencil, HeatOperatorArguments)
MPM_INSTANTIATE(heat_patches, PatchArguments)

}  // namespace mpm::cuda
