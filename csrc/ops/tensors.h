#pragma once

#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <optional>
#include <vector>

#include "transfer/arguments.h"

// Checks, allocation and views shared by the op families. The Python face has checked values and given readable errors
// already; here everything is checked again that memory safety depends on.
namespace mpm {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using OptionalTensor = std::optional<Tensor>;
using Shape = std::vector<int64_t>;

inline bool has(const OptionalTensor& t) { return t.has_value() && t->defined(); }

// Sizes of dimensions that a tensor lacks are not checked by every torch version: ask for the rank first.
inline void check_rank(const Tensor& t, const char* name, int64_t rank) {
  STD_TORCH_CHECK(t.dim() == rank, name, " must have ", rank, " dimensions");
}

inline void check_shape(const Tensor& t, const char* name, const Shape& shape) {
  bool same = t.dim() == int64_t(shape.size());
  for (size_t i = 0; same && i < shape.size(); i++) same = t.size(int64_t(i)) == shape[i];
  STD_TORCH_CHECK(same, name, " has an unexpected shape");
}

inline void check_like(const Tensor& t, const char* name, const Tensor& x) {
  STD_TORCH_CHECK(t.scalar_type() == x.scalar_type(), name, " must have the dtype of x");
  STD_TORCH_CHECK(t.device() == x.device(), name, " must be on the device of x");
}

template <class T>
Field<T> field(const Tensor& t) {
  Field<T> f;
  f.pointer = static_cast<T*>(t.data_ptr());
  for (int64_t i = 0; i < t.dim() && i < 3; i++) f.stride[i] = t.stride(i);
  return f;
}

// View of a floating particle tensor, checked against x; an absent tensor gives an absent field.
template <class T>
Field<const T> input(const Tensor& t, const char* name, const Tensor& x, const Shape& shape) {
  check_shape(t, name, shape);
  check_like(t, name, x);
  return field<const T>(t);
}

template <class T>
Field<const T> input(const OptionalTensor& t, const char* name, const Tensor& x, const Shape& shape) {
  return has(t) ? input<T>(*t, name, x, shape) : Field<const T>{};
}

template <class T>
NodeField<const T> node_input(const Tensor& t, const char* name, const Tensor& x, int64_t nodes) {
  STD_TORCH_CHECK(t.dim() == 2 && t.size(0) == nodes, name, " must have one row per node");
  STD_TORCH_CHECK(t.size(1) <= 1 || t.stride(1) == 1, name, " must have channels with stride 1");
  check_like(t, name, x);
  return {static_cast<const T*>(t.data_ptr()), t.stride(0), int(t.size(1))};
}

// Uninitialised tensors on the device of another one; on the CPU, large ones come from a pool (csrc/cpu/pool.h).
Tensor empty_strided(const Tensor& like, const Shape& shape, const Shape& strides, ScalarType type);
Tensor empty(const Tensor& like, const Shape& shape, ScalarType type);
Tensor empty(const Tensor& like, const Shape& shape);
inline Tensor empty_int(const Tensor& like, const Shape& shape) { return empty(like, shape, ScalarType::Int); }
Tensor zeros(const Tensor& like, const Shape& shape);

// Elements from row to row of a structure of arrays. On the CPU, rows of whole pages (P a power of two) would share
// cache sets, and a load would wait for stores to other rows whose addresses end alike: 23 cache lines more than pages
// spread the nine rows of a matrix evenly over a page of 64.
inline int64_t particle_pitch(const Tensor& like, int64_t particles) {
  if (!like.is_cpu()) return particles;
  constexpr int64_t line = 64, page = 64, shift = 23;
  const int64_t bytes = int64_t(like.element_size()), lines = (particles * bytes + line - 1) / line;
  return ((lines + page - 1 - shift) / page * page + shift) * line / bytes;
}

// A [P, ...] tensor stored as structure of arrays: the particle index is contiguous.
Tensor empty_particles(const Tensor& like, const Shape& shape);

// Calls f.operator()<T, D, Order>() for the dtype and dimension of x.
template <class F>
void dispatch(const Tensor& x, int64_t order, F&& f) {
  STD_TORCH_CHECK(x.dim() == 2 && (x.size(1) == 2 || x.size(1) == 3), "x must have shape [P, 2] or [P, 3]");
  STD_TORCH_CHECK(order == 2 || order == 3, "order must be 2 or 3");
  const auto by_order = [&]<class T, int D>() {
    order == 2 ? f.template operator()<T, D, 2>() : f.template operator()<T, D, 3>();
  };
  const auto by_dimension = [&]<class T>() {
    x.size(1) == 2 ? by_order.template operator()<T, 2>() : by_order.template operator()<T, 3>();
  };
  if (x.scalar_type() == ScalarType::Float)
    by_dimension.template operator()<float>();
  else if (x.scalar_type() == ScalarType::Double)
    by_dimension.template operator()<double>();
  else
    STD_TORCH_CHECK(false, "x must be float32 or float64");
}

// The tensors of one activation as every op takes them, in this order.
#define MPM_TOPOLOGY_SCHEMA                                                                                            \
  "Tensor table, Tensor block, Tensor offsets, Tensor index, Tensor schedule, float dx, float[] lower, int[] blocks, " \
  "int order, "                                                                                                        \
  "bool deterministic"
#define MPM_TOPOLOGY_PARAMETERS                                                                                 \
  const Tensor &table, const Tensor &block, const Tensor &offsets, const Tensor &index, const Tensor &schedule, \
      double dx, std::vector<double> lower, std::vector<int64_t> blocks, int64_t order, bool deterministic
#define MPM_TOPOLOGY_ARGUMENTS table, block, offsets, index, schedule, dx, lower, blocks

inline const int* int_pointer(const Tensor& t, const char* name, const Tensor& x, int64_t size) {
  STD_TORCH_CHECK(t.scalar_type() == ScalarType::Int && t.dim() >= 1 && t.is_contiguous() && t.device() == x.device(),
                  name, " must be a contiguous int32 tensor on the device of x");
  STD_TORCH_CHECK(size < 0 || t.numel() == size, name, " has an unexpected size");
  return static_cast<const int*>(t.data_ptr());
}

template <class T, int D>
Geometry<T, D> geometry(double dx, const std::vector<double>& lower, const std::vector<int64_t>& blocks) {
  STD_TORCH_CHECK(int(lower.size()) == D && int(blocks.size()) == D, "lower and blocks must have one entry per axis");
  STD_TORCH_CHECK(dx > 0, "dx must be positive");
  int64_t product = 1;
  for (int64_t b : blocks) {
    STD_TORCH_CHECK(b > 0 && b <= INT32_MAX / product, "blocks must be positive and their product below 2^31");
    product *= b;
  }
  return Geometry<T, D>::make(dx, lower.data(), blocks.data());
}

template <class T, int D>
Topology<T, D> topology(const Tensor& x, const Tensor& table, const Tensor& block, const Tensor& offsets,
                        const Tensor& index, const Tensor& schedule, double dx, const std::vector<double>& lower,
                        const std::vector<int64_t>& blocks) {
  Topology<T, D> t;
  t.geometry = geometry<T, D>(dx, lower, blocks);
  t.particles = x.size(0);
  t.capacity = int(block.size(0));
  t.scenes = int(table.numel() / t.geometry.blocks_per_scene);
  t.table = int_pointer(table, "table", x, int64_t(t.scenes) * t.geometry.blocks_per_scene);
  t.block = int_pointer(block, "block", x, t.capacity);
  t.offsets = int_pointer(offsets, "offsets", x, int64_t(t.capacity) + 1);
  t.index = int_pointer(index, "index", x, t.particles);
  t.schedule = int_pointer(schedule, "schedule", x, -1);
  t.schedule_size = schedule.numel();
  return t;
}

template <int D>
int64_t node_count(const Tensor& block) {
  return block.size(0) * kBlockNodes<D>;
}

}  // namespace mpm
