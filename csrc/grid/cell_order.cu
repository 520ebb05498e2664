#include "cuda/base_block.cuh"
#include "cuda/columns.cuh"
#include "cuda/launch.cuh"
#include "grid/cell_order.h"

// Orders the particles of each block by cell with a stable counting sort, in parts that fit in shared memory.
namespace mpm::cuda {
namespace {

// One thread per cell: each reads the cells of all particles, which is a broadcast from shared memory. The work item in
// which the particles begin processes all of them.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kBlockNodes<D>)
    cell_order_kernel(const Topology<T, D> t, const Columns<const T, D> position, int* order) {
  constexpr int cells = kBlockNodes<D>;
  __shared__ unsigned char cell[kItemParticles];
  __shared__ int counts[cells];
  const Schedule<const int> schedule = schedule_of(t);
  const int items = *schedule.item_count, own = threadIdx.x;
  for (int i = blockIdx.x; i < items; i += gridDim.x) {
    const int4 item = reinterpret_cast<const int4*>(schedule.items)[i];
    const int start = t.offsets[item.x], whole = (item.y - start + kItemParticles - 1) / kItemParticles;
    const int begin = start + whole * kItemParticles;
    if (begin >= item.z) continue;
    const int count = ::min(kItemParticles, t.offsets[item.x + 1] - begin);
    __syncthreads();  // the part before is done
    for (int k = own; k < count; k += cells) {
      int base[D];
      T f[D];
      const bool inside = locate<Order>(t.geometry, read_vector(position, t.index[begin + k]).e, base, f);
      cell[k] = inside ? node_in_block<D>(base) : 0;
    }
    __syncthreads();
    int mine = 0, next = begin;
    for (int k = 0; k < count; k++) mine += cell[k] == own;
    counts[own] = mine;
    __syncthreads();
    for (int c = 0; c < own; c++) next += counts[c];
    for (int k = 0; k < count; k++)
      if (cell[k] == own) order[next++] = t.index[begin + k];
  }
  const int64_t stride = int64_t(gridDim.x) * cells;
  for (int64_t i = t.offsets[t.max_blocks] + int64_t(blockIdx.x) * cells + own; i < t.particles; i += stride)
    order[i] = t.index[i];
}

}  // namespace

template <int Order, class T, int D>
void cell_order(const CellOrderArguments<T, D>& a, Stream stream) {
  if (a.topology.particles == 0) return;
  launch(cell_order_kernel<Order, T, D>, grid_size(most_items(a.topology.max_blocks, a.topology.particles)),
         kBlockNodes<D>, 0, stream, a.topology, Columns<const T, D>(a.x), a.order);
}

MPM_INSTANTIATE_ORDERS(cell_order, CellOrderArguments)

}  // namespace mpm::cuda
