#include "grid/activate.op.h"

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include <cstring>

#include "cpu/lazy_table.h"
#endif

// Finds the blocks that particles touch and groups the particles by the block of their base node.
namespace mpm {

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
Tensor new_table(const Tensor& like, int64_t entries) {
  const int64_t bytes = entries * int64_t(sizeof(int));
  if (void* const data = bytes < cpu::kLazyTable ? nullptr : cpu::allocate_lazy_table(bytes))
    return torch::stable::from_blob(data, Shape{entries}, Shape{1}, like.device(), ScalarType::Int,
                                    [bytes](void* data) { cpu::free_lazy_table(data, bytes); });
  Tensor table = empty_int(like, {entries});
  empty_table(table);
  return table;
}

void empty_table(Tensor& table) {
  if (table.numel() == 0) return;     // its memory may be null
  constexpr int64_t grain = 1 << 16;  // entries that one thread sets faster than a team
  cpu::parallel_for(
      table.numel(), grain,
      [](void* data, int64_t begin, int64_t end) {
        std::memset(static_cast<int*>(data) + begin, 0xff, size_t(end - begin) * sizeof(int));
      },
      table.data_ptr());
}
#else
Tensor new_table(const Tensor& like, int64_t entries) { return empty_int(like, {entries}); }
#endif

namespace {

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> activate(
    const Tensor& x, const OptionalTensor& scene, const OptionalTensor& ids, const OptionalTensor& previous_status,
    int64_t scenes, int64_t max_blocks, const std::vector<double>& lattice, const std::vector<int64_t>& layout) {
  const PackedLattice packed(lattice, layout);
  ActivationTensors t;
  Tensor status;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    auto a = activate_arguments<T, D>(packed, x, scene, ids, scenes, max_blocks);
    a.x = input<T>(x, "x", x, {x.size(0), D});
    if (has(previous_status))
      a.previous_status = int_pointer(*previous_status, "previous_status", x, {1 + scenes, kStatusSize});
    t.make(x, a, device.stream());
    status = empty_int(x, {1 + scenes, kStatusSize});
    a.status = static_cast<int*>(status.data_ptr());
    backend::activate(packed.order(), a, device.stream());
  });
  return {t.table, t.block, t.offsets, t.index, t.schedule, status};
}

Tensor cell_order(const Tensor& x, const std::vector<Tensor>& topology, const std::vector<double>& lattice,
                  const std::vector<int64_t>& layout) {
  const PackedTopology blocks(topology, lattice, layout);
  check_positions(x);
  Tensor result = empty_int(x, {x.size(0)});
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    CellOrderArguments<T, D> a;
    a.topology = blocks.unpack<T, D>(x);
    a.x = input<T>(x, "x", x, {x.size(0), D});
    a.order = static_cast<int*>(result.data_ptr());
    backend::cell_order(blocks.order(), a, device.stream());
  });
  return result;
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "activate(Tensor x, Tensor? scene, Tensor? ids, Tensor? previous_status, int scenes, int "
      "max_blocks, " MPM_LATTICE_SCHEMA
      ") -> (Tensor table, Tensor block, Tensor offsets, "
      "Tensor index, Tensor schedule, Tensor status)");
  m.def("cell_order(Tensor x, " MPM_TOPOLOGY_SCHEMA ") -> Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("activate", TORCH_BOX(&mpm::activate));
  m.impl("cell_order", TORCH_BOX(&mpm::cell_order));
}
