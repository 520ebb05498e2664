#pragma once

#include "grid/kernels.h"
#include "grid/topology.op.h"

// An activation as the ops call it.
namespace mpm {

// Arguments that are the same for all activations of the same particles.
template <class T, int D>
ActivateArguments<T, D> activate_arguments(const PackedLattice& packed, const Tensor& x, const OptionalTensor& scene,
                                           const OptionalTensor& ids, int64_t scenes, int64_t max_blocks) {
  STD_TORCH_CHECK(scenes >= 0, "scenes must not be negative, got ", scenes);
  STD_TORCH_CHECK(max_blocks >= 0, "max_blocks must not be negative, got ", max_blocks);
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
  set_scene(a, scene, x);
  if (has(ids)) {
    check_shape(*ids, "ids", {x.size(0)});
    check_type(*ids, "ids", ScalarType::Long, x);
    a.id = static_cast<const int64_t*>(ids->data_ptr());
    a.id_stride = ids->stride(0);
  }
  return a;
}

// A table for new activations. On the CPU no block has a slot yet; a large table is made without writing it.
Tensor new_table(const Tensor& like, int64_t entries);

// The same for a table in given memory, on the CPU.
void empty_table(Tensor& table);

// The results of an activation but for its status, and its work space.
struct ActivationTensors {
  Tensor table = absent(), block = absent(), offsets = absent(), index = absent(), schedule = absent();
  Tensor workspace = absent();

  // For the arguments' number of blocks, all but the table by allocate(shape).
  template <class T, int D, class Allocate>
  void lay_out(ActivateArguments<T, D>& a, const Tensor& given_table, const Allocate& allocate) {
    const int64_t slots = a.slots();
    a.schedule_size = schedule_size<D>(slots, a.particles);
    table = given_table;
    block = allocate({slots});
    offsets = allocate({slots + 1});
    index = allocate({a.particles});
    schedule = allocate({a.schedule_size});
  }

  template <class T, int D>
  static int64_t table_size(const ActivateArguments<T, D>& a) {
    return int64_t(a.scenes) * a.geometry.blocks_per_scene;
  }

  template <class T, int D>
  void make(const Tensor& x, ActivateArguments<T, D>& a, backend::Stream stream) {
    lay_out(a, new_table(x, table_size(a)), [&](const Shape& shape) { return empty_int(x, shape); });
    a.workspace_size = backend::activate_workspace(a, stream);
    use(a, empty(x, {a.workspace_size}, ScalarType::Byte));
  }

  // Makes the arguments write here; the table has no blocks at first.
  template <class T, int D>
  void use(ActivateArguments<T, D>& a, const Tensor& memory) {
    workspace = memory;
    a.workspace = workspace.data_ptr();
    a.fresh = true;
    a.table = static_cast<int*>(table.data_ptr());
    a.block = static_cast<int*>(block.data_ptr());
    a.offsets = static_cast<int*>(offsets.data_ptr());
    a.index = static_cast<int*>(index.data_ptr());
    a.schedule = static_cast<int*>(schedule.data_ptr());
  }
};

}  // namespace mpm
