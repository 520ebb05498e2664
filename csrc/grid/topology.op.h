#pragma once

#include "common/tensors.h"
#include "grid/topology.h"

// The lattice and the topology as arguments of ops, packed by torch_mpm/grid/topology.py and unpacked here.
namespace mpm {

#define MPM_LATTICE_SCHEMA "float[] lattice, int[] layout"
#define MPM_TOPOLOGY_SCHEMA "Tensor[] topology, " MPM_LATTICE_SCHEMA

// lattice: dx, lower; layout: order of the B-spline, deterministic, blocks per axis.
class PackedLattice {
 public:
  PackedLattice(const std::vector<double>& lattice, const std::vector<int64_t>& layout)
      : lattice_(lattice), layout_(layout) {
    STD_TORCH_CHECK(lattice.size() > 0, "lattice must be [dx, *lower], got nothing");
    STD_TORCH_CHECK(layout.size() > 1, "layout must be [order, deterministic, *blocks], got ", text(layout));
    STD_TORCH_CHECK(order() == 2 || order() == 3, "order must be 2 or 3, got ", order());
  }

  double dx() const { return lattice_[0]; }
  const double* lower() const { return lattice_.data() + 1; }
  int64_t order() const { return layout_[0]; }
  bool deterministic() const { return layout_[1] != 0; }
  double inverse_inertia() const { return mpm::inverse_inertia(order()) / (dx() * dx()); }  // D⁻¹ [1/m²]

  template <class T, int D>
  Geometry<T, D> geometry() const {
    STD_TORCH_CHECK(lattice_.size() == 1 + D, "lattice must have ", 1 + D, " entries, dx and lower, got ",
                    lattice_.size());
    STD_TORCH_CHECK(layout_.size() == 2 + D, "layout must have ", 2 + D,
                    " entries, order, deterministic and blocks, got ", layout_.size());
    STD_TORCH_CHECK(dx() > 0 && std::isfinite(dx()) && std::isfinite(1 / dx()), "dx must be positive and finite, got ",
                    dx());
    const int64_t* blocks = layout_.data() + 2;
    int64_t product = 1;
    for (int i = 0; i < D; i++) {
      STD_TORCH_CHECK(std::isfinite(lower()[i]), "lower must be finite, got ", lower()[i]);
      const int64_t b = blocks[i];
      STD_TORCH_CHECK(b > 0 && b <= INT32_MAX / kBlockWidth && b <= INT32_MAX / product,
                      "blocks must be positive and below 2^29, their product below 2^31, got ",
                      text(Shape(blocks, blocks + D)));
      product *= b;
    }
    return Geometry<T, D>::make(dx(), lower(), blocks);
  }

 private:
  const std::vector<double>& lattice_;
  const std::vector<int64_t>& layout_;
};

// topology: table, block, offsets, index, schedule; and the scene of each particle, if there is one.
class PackedTopology : public PackedLattice {
 public:
  PackedTopology(const std::vector<Tensor>& topology, const std::vector<double>& lattice,
                 const std::vector<int64_t>& layout)
      : PackedLattice(lattice, layout), tensors_(topology) {
    STD_TORCH_CHECK(topology.size() == 5 || topology.size() == 6,
                    "topology must be [table, block, offsets, index, schedule] and perhaps scene, got ",
                    topology.size(), " tensors");
  }

  // Slots of the pool of blocks.
  template <int D>
  int max_blocks() const {
    check_rank(block(), "block", 1);
    const int64_t slots = block().size(0);
    STD_TORCH_CHECK(slots <= INT32_MAX / kBlockNodes<D>, "block must have at most ", INT32_MAX / kBlockNodes<D>,
                    " entries, got ", slots);
    return int(slots);
  }

  // Rows of a node tensor.
  template <int D>
  int64_t node_count() const {
    return int64_t(max_blocks<D>()) * kBlockNodes<D>;
  }

  // The same for a dimension that is given at run time.
  int64_t node_count(int64_t dim) const { return dim == 2 ? node_count<2>() : node_count<3>(); }

  const int* block_pointer(const Tensor& like) const { return int_pointer(block(), "block", like, {block().size(0)}); }

  // The table, and its number of entries.
  const int* table_pointer(const Tensor& like, int64_t& size) const {
    check_rank(table(), "table", 1);
    size = table().size(0);
    return int_pointer(table(), "table", like, {size});
  }

  // Scenes of the table.
  template <class T, int D>
  int64_t scenes(const Tensor& like) const {
    int64_t size;
    table_pointer(like, size);
    const int64_t per_scene = geometry<T, D>().blocks_per_scene;
    STD_TORCH_CHECK(size % per_scene == 0 && size <= INT32_MAX, "table must have shape [B * ", per_scene, "], got ",
                    shape_of(table()));
    return size / per_scene;
  }

  // The topology of the particles at x. Sizes are checked; of the contents, which only `activate` may write, no more
  // than costs nothing: on the CPU, that no slot has a block beyond the table, which may be that of fewer scenes.
  template <class T, int D>
  Topology<T, D> unpack(const Tensor& x) const {
    Topology<T, D> t;
    t.geometry = geometry<T, D>();
    t.particles = x.size(0);
    t.max_blocks = max_blocks<D>();
    int64_t size;
    t.table = table_pointer(x, size);
    const int64_t per_scene = t.geometry.blocks_per_scene;
    STD_TORCH_CHECK(size % per_scene == 0 && size <= INT32_MAX && (size > 0 || t.particles == 0),
                    "table must have shape [B * ", per_scene, "] for the scenes of all particles, got ",
                    shape_of(table()));
    t.scenes = int(size / per_scene);
    t.block = block_pointer(x);
    t.offsets = int_pointer(tensors_[2], "offsets", x, {int64_t(t.max_blocks) + 1});
    t.index = int_pointer(tensors_[3], "index", x, {t.particles});
    t.schedule_size = schedule_size<D>(t.max_blocks, t.particles);
    t.schedule = int_pointer(tensors_[4], "schedule", x, {t.schedule_size});
    if (tensors_.size() == 6) {
      check_shape(tensors_[5], "scene", {t.particles});
      check_type(tensors_[5], "scene", ScalarType::Int, x);
    }
    if (x.is_cpu()) {
      int most = -1;
      for (int slot = 0; slot < t.max_blocks; slot++) most = std::max(most, t.block[slot]);
      STD_TORCH_CHECK(most < size, "block must have entries below the ", size, " of table, got ", most);
    }
    return t;
  }

 private:
  const Tensor& table() const { return tensors_[0]; }
  const Tensor& block() const { return tensors_[1]; }

  const std::vector<Tensor>& tensors_;
};

}  // namespace mpm
