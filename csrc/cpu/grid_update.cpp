#include "cpu/grid_update_launchers.h"
#include "cpu/parallel.h"

namespace mpm::cpu {
namespace {

template <int D>
constexpr int64_t kGrain = 4096 / kBlockNodes<D>;  // slots below which a range is not split

}  // namespace

template <class T, int D>
void grid_update(const GridUpdateArguments<T, D>& a, Stream) {
  parallel_ranges(a.capacity, kGrain<D>, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      const SlotUpdate<T, D> s = slot_update(a, int(slot));
      const int64_t first = slot * kBlockNodes<D>;
      for (int local = 0; local < kBlockNodes<D>; local++)
        a.updated[first + local] = update_node(a, s, local, a.nodes[first + local]);
    }
  });
}

template <class T, int D>
void grid_update_backward(const GridUpdateBackwardArguments<T, D>& a, Stream) {
  parallel_ranges(a.forward.capacity, kGrain<D>, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      const SlotUpdate<T, D> s = slot_update(a.forward, int(slot));
      const int64_t first = slot * kBlockNodes<D>;
      Vector<T, D> sum = zero_vector<T, D>(), change;
      for (int local = 0; local < kBlockNodes<D>; local++) {
        a.grad_nodes[first + local] = update_node_backward(a, s, local, first + local, change);
        sum = sum + change;
      }
      if (a.change) a.change[slot] = sum;
    }
  });
}

#define INSTANTIATE(T, D)                                              \
  template void grid_update(const GridUpdateArguments<T, D>&, Stream); \
  template void grid_update_backward(const GridUpdateBackwardArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cpu
