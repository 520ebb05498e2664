#include "grid/kernels.h"
#include "grid/topology.op.h"

// Finds the blocks that particles touch and groups the particles by the block of their base node.
namespace mpm {
namespace {

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> activate(
    const Tensor& x, const OptionalTensor& scene, const OptionalTensor& ids, const OptionalTensor& previous_status,
    int64_t scenes, int64_t max_blocks, const std::vector<double>& lattice, const std::vector<int64_t>& layout) {
  const PackedLattice packed(lattice, layout);
  STD_TORCH_CHECK(scenes >= 0, "scenes must not be negative, got ", scenes);
  STD_TORCH_CHECK(max_blocks >= 0, "max_blocks must not be negative, got ", max_blocks);
  Tensor table, block, offsets, index, status, schedule;
  const DeviceScope device(x);
  dispatch(x, [&]<class T, int D>() {
    ActivateArguments<T, D> a;
    a.geometry = packed.geometry<T, D>();
    const int64_t per_scene = a.geometry.blocks_per_scene, most = INT32_MAX / kBlockNodes<D>;
    STD_TORCH_CHECK(scenes <= INT32_MAX / per_scene, "scenes times blocks must be below 2^31, got ", scenes, " times ",
                    per_scene);
    STD_TORCH_CHECK(scenes > 0 || x.size(0) == 0, "x must have no particles where scenes is 0, got ", x.size(0));
    STD_TORCH_CHECK(max_blocks <= most, "max_blocks must be at most ", most, ", got ", max_blocks);
    a.scenes = int(scenes);
    a.max_blocks = int(max_blocks);
    a.particles = x.size(0);
    a.deterministic = packed.deterministic();
    a.x = input<T>(x, "x", x, {x.size(0), D});
    set_scene(a, scene, x);
    if (has(ids)) {
      check_shape(*ids, "ids", {x.size(0)});
      check_type(*ids, "ids", ScalarType::Long, x);
      a.id = static_cast<const int64_t*>(ids->data_ptr());
      a.id_stride = ids->stride(0);
    }
    if (has(previous_status))
      a.previous_status = int_pointer(*previous_status, "previous_status", x, {1 + scenes, kStatusSize});
    a.schedule_size = schedule_size<D>(max_blocks, x.size(0));
    table = empty_int(x, {scenes * per_scene});
    block = empty_int(x, {max_blocks});
    offsets = empty_int(x, {max_blocks + 1});
    index = empty_int(x, {x.size(0)});
    status = empty_int(x, {1 + scenes, kStatusSize});
    schedule = empty_int(x, {a.schedule_size});
    a.workspace_size = backend::activate_workspace(a, device.stream());
    const Tensor workspace = empty(x, {a.workspace_size}, ScalarType::Byte);
    a.workspace = workspace.data_ptr();
    a.table = static_cast<int*>(table.data_ptr());
    a.block = static_cast<int*>(block.data_ptr());
    a.offsets = static_cast<int*>(offsets.data_ptr());
    a.index = static_cast<int*>(index.data_ptr());
    a.schedule = static_cast<int*>(schedule.data_ptr());
    a.status = static_cast<int*>(status.data_ptr());
    backend::activate(packed.order(), a, device.stream());
  });
  return {table, block, offsets, index, schedule, status};
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
