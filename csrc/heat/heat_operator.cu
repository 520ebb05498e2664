#include "cuda/launch.cuh"
#include "heat/operator.cuh"

// H u of node values, or the diagonal of H.
namespace mpm::cuda {

constexpr int kOperatorThreads = 128;

// The packed particles in a work space, and its bytes.
template <class T, int D>
PackedItems<T, D> lay_out(const Topology<T, D>& t, void* memory, int64_t& size) {
  PackedItems<T, D> packed;
  size = 0;
  packed.lay_out(t, false, [&](int64_t bytes) {
    char* p = static_cast<char*>(memory) + size;
    size += align_workspace(bytes);
    return p;
  });
  return packed;
}

// H u or the diagonal; colour as in `for_items`. The first launch packs the particles.
template <int Order, class T, int D>
__global__ void __launch_bounds__(kOperatorThreads)
    operator_kernel(const HeatOperatorArguments<T, D> a, const PackedItems<T, D> packed, const Columns<const T, D> x,
                    const Columns<const T, 1> conductance, int colour) {
  using S = HeatShape<Order, T, D>;
  __shared__ WarpMemory<S> memory[kOperatorThreads / 32];
  WarpMemory<S>& own = memory[threadIdx.x / 32];
  const Item* const items = reinterpret_cast<const Item*>(schedule_of(a.topology).items);
  for_items(a.topology, colour, [&](int number, int end) {
    for (int i = number; i < end; i++) pack_item<S>(a.topology, x, conductance, items[i], i, packed, own);
    if (a.nodes)
      sum_items<HeatSum::product, S>(a.topology, packed, number, end, StoredValues<T>{a.nodes}, a.sum, colour >= 0,
                                     own);
    else
      sum_items<HeatSum::diagonal, S>(a.topology, packed, number, end, StoredValues<T>{a.nodes}, a.sum, colour >= 0,
                                      own);
  });
}

template <int Order, class T, int D>
void heat_operator(const HeatOperatorArguments<T, D>& a, Stream stream) {
  const int64_t items = most_items(a.topology.max_blocks, a.topology.particles);
  if (items == 0) return;
  int64_t size;
  const PackedItems<T, D> packed = lay_out(a.topology, a.workspace, size);
  for (int colour = a.deterministic ? 0 : -1; colour < (a.deterministic ? 1 << D : 0); colour++)
    launch(operator_kernel<Order, T, D>, grid_size(items * 32 / kOperatorThreads + 1), kOperatorThreads, 0, stream, a,
           packed, Columns<const T, D>(a.x), Columns<const T, 1>(a.conductance), colour);
}

template <class T, int D>
int64_t heat_operator_workspace(const HeatOperatorArguments<T, D>& a) {
  int64_t size;
  lay_out(a.topology, nullptr, size);
  return size;
}

MPM_INSTANTIATE_SIZE(heat_operator_workspace, HeatOperatorArguments)
MPM_INSTANTIATE_ORDERS(heat_operator, HeatOperatorArguments)

}  // namespace mpm::cuda
