#pragma once

#include "grid/activate.op.h"
#include "rollout/inputs.h"

// Node tensors of the active blocks of a call.
namespace mpm {

// Size of a pool with headroom, as for a growing grid in torch_mpm/grid/grid.py.
inline int64_t with_headroom(int64_t blocks) { return blocks + blocks / 2 + 16; }

// The activation and the nodes, for one size of the pool of blocks.
template <class T, int D>
struct Pool {
  ActivationTensors active;
  Tensor nodes = absent(), updated = absent(), velocity = absent();

  void make(const Tensor& x, ActivateArguments<T, D>& a, bool obstacles, backend::Stream stream) {
    active.make(x, a, stream);
    nodes = empty(x, nodes_shape(a));
    updated = empty(x, nodes_shape(a));
    if (obstacles) velocity = empty(x, nodes_shape(a));
  }

  // Tensors are made by ints(shape) and numbers(shape); the nodes and the workspace are given.
  template <class Ints, class Numbers>
  void lay_out(const Tensor& given, ActivateArguments<T, D>& a, bool obstacles, const Ints& ints,
               const Numbers& numbers) {
    active.lay_out(a, ints({ActivationTensors::table_size(a)}), ints);
    nodes = given;
    updated = numbers(nodes_shape(a));
    if (obstacles) velocity = numbers(nodes_shape(a));
  }

  static Shape nodes_shape(const ActivateArguments<T, D>& a) { return {int64_t(a.slots()) * kBlockNodes<D>, 1 + D}; }
};

template <class T, int D>
Topology<T, D> topology_of(const ActivateArguments<T, D>& a) {
  Topology<T, D> t;
  t.geometry = a.geometry;
  t.scenes = a.scenes;
  t.max_blocks = a.slots();
  t.particles = a.particles;
  t.table = a.table;
  t.block = a.block;
  t.offsets = a.offsets;
  t.index = a.index;
  t.schedule = a.schedule;
  t.schedule_size = a.schedule_size;
  return t;
}

}  // namespace mpm
