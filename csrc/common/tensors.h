#pragma once

#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <string>
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

// ---- Text for messages

inline std::string text(const Shape& shape) {
  std::string s;
  for (int64_t size : shape) s += (s.empty() ? "" : ", ") + std::to_string(size);
  return "[" + s + "]";
}

inline std::string shape_of(const Tensor& t) {
  Shape shape(t.dim());
  for (size_t i = 0; i < shape.size(); i++) shape[i] = t.size(int64_t(i));
  return text(shape);
}

// As Python calls it.
inline const char* name_of(ScalarType type) {
  switch (type) {
    case ScalarType::Float:
      return "float32";
    case ScalarType::Double:
      return "float64";
    case ScalarType::Int:
      return "int32";
    case ScalarType::Long:
      return "int64";
    case ScalarType::Bool:
      return "bool";
    default:
      return torch::headeronly::toString(type);
  }
}

// ---- Checks

// Sizes of dimensions that a tensor lacks are not checked by every torch version: ask for the rank first.
inline void check_rank(const Tensor& t, const char* name, int64_t rank) {
  STD_TORCH_CHECK(t.dim() == rank, name, " must have ", rank, " dimensions, got shape ", shape_of(t));
}

inline void check_shape(const Tensor& t, const char* name, const Shape& shape) {
  bool same = t.dim() == int64_t(shape.size());
  for (size_t i = 0; same && i < shape.size(); i++) same = t.size(int64_t(i)) == shape[i];
  STD_TORCH_CHECK(same, name, " must have shape ", text(shape), ", got ", shape_of(t));
}

inline void check_type(const Tensor& t, const char* name, ScalarType type, const Tensor& x) {
  STD_TORCH_CHECK(t.scalar_type() == type, name, " must be ", name_of(type), ", got ", name_of(t.scalar_type()));
  STD_TORCH_CHECK(t.device() == x.device(), name, " must be on the device of the other arguments");
}

inline void check_like(const Tensor& t, const char* name, const Tensor& x) { check_type(t, name, x.scalar_type(), x); }

// Kernels count rows and channels in int.
inline void check_count(int64_t count, const char* name, const char* what) {
  STD_TORCH_CHECK(count < INT32_MAX, name, " must have fewer than 2^31 ", what, ", got ", count);
}

inline void check_positions(const Tensor& x) {
  STD_TORCH_CHECK(x.dim() == 2 && (x.size(1) == 2 || x.size(1) == 3), "x must have shape [P, 2] or [P, 3], got ",
                  shape_of(x));
  check_count(x.size(0), "x", "particles");
}

// A matrix per particle, `name` [P, 2, 2] or [P, 3, 3].
inline void check_matrices(const Tensor& t, const char* name) {
  STD_TORCH_CHECK(t.dim() == 3 && t.size(1) == t.size(2) && (t.size(1) == 2 || t.size(1) == 3), name,
                  " must have shape [P, 2, 2] or [P, 3, 3], got ", shape_of(t));
  check_count(t.size(0), name, "particles");
}

// ---- Views

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
  STD_TORCH_CHECK(t.dim() == 2 && t.size(0) == nodes, name, " must have shape [", nodes, ", K], a row per node, got ",
                  shape_of(t));
  check_count(t.size(1), name, "channels");
  STD_TORCH_CHECK(t.size(1) <= 1 || t.stride(1) == 1, name, " must have channels with stride 1, got ", t.stride(1));
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

// Sets `scene` and `scene_stride` of the arguments of a kernel: the scene of each particle, [P] of any stride.
template <class Arguments>
void set_scene(Arguments& a, const OptionalTensor& scene, const Tensor& x) {
  if (!has(scene)) return;
  check_shape(*scene, "scene", {x.size(0)});
  check_type(*scene, "scene", ScalarType::Int, x);
  a.scene = static_cast<const int*>(scene->data_ptr());
  a.scene_stride = scene->stride(0);
}

// Calls f.operator()<T, D>() for the dtype of a tensor and D = dim.
template <class F>
void dispatch(const Tensor& t, const char* name, int64_t dim, F&& f) {
  STD_TORCH_CHECK(dim == 2 || dim == 3, "dim must be 2 or 3, got ", dim);
  const auto by_dimension = [&]<class T>() {
    dim == 2 ? f.template operator()<T, 2>() : f.template operator()<T, 3>();
  };
  if (t.scalar_type() == ScalarType::Float)
    by_dimension.template operator()<float>();
  else if (t.scalar_type() == ScalarType::Double)
    by_dimension.template operator()<double>();
  else
    STD_TORCH_CHECK(false, name, " must be float32 or float64, got ", name_of(t.scalar_type()));
}

// The same for the dtype and dimension of x, of an op that takes the order of the kernel.
template <class F>
void dispatch(const Tensor& x, int64_t order, F&& f) {
  check_positions(x);
  STD_TORCH_CHECK(order == 2 || order == 3, "order must be 2 or 3, got ", order);
  dispatch(x, "x", x.size(1), f);
}

// The tensors of one activation as every op takes them, in this order.
#define MPM_TOPOLOGY_SCHEMA                                                                                            \
  "Tensor table, Tensor block, Tensor offsets, Tensor index, Tensor schedule, float dx, float[] lower, int[] blocks, " \
  "int order, "                                                                                                        \
  "bool deterministic"
#define MPM_TOPOLOGY_PARAMETERS                                                                                 \
  const Tensor &table, const Tensor &block, const Tensor &offsets, const Tensor &index, const Tensor &schedule, \
      double dx, std::vector<double> lower, std::vector<int64_t> blocks, int64_t order,                         \
      [[maybe_unused]] bool deterministic
#define MPM_TOPOLOGY_ARGUMENTS table, block, offsets, index, schedule, dx, lower, blocks

inline const int* int_pointer(const Tensor& t, const char* name, const Tensor& x, const Shape& shape) {
  check_shape(t, name, shape);
  check_type(t, name, ScalarType::Int, x);
  STD_TORCH_CHECK(t.is_contiguous(), name, " must be contiguous");
  return static_cast<const int*>(t.data_ptr());
}

template <class T, int D>
Geometry<T, D> geometry(double dx, const std::vector<double>& lower, const std::vector<int64_t>& blocks) {
  STD_TORCH_CHECK(int(lower.size()) == D, "lower must have ", D, " entries, one per axis, got ", lower.size());
  STD_TORCH_CHECK(int(blocks.size()) == D, "blocks must have ", D, " entries, one per axis, got ", blocks.size());
  STD_TORCH_CHECK(dx > 0 && std::isfinite(dx) && std::isfinite(1 / dx), "dx must be positive and finite, got ", dx);
  for (double a : lower) STD_TORCH_CHECK(std::isfinite(a), "lower must be finite, got ", a);
  int64_t product = 1;
  for (int64_t b : blocks) {
    STD_TORCH_CHECK(b > 0 && b <= INT32_MAX / kBlockWidth && b <= INT32_MAX / product,
                    "blocks must be positive and below 2^29, their product below 2^31, got ", text(blocks));
    product *= b;
  }
  return Geometry<T, D>::make(dx, lower.data(), blocks.data());
}

// Slots of the pool of nodes.
template <int D>
int block_capacity(const Tensor& block) {
  check_rank(block, "block", 1);
  STD_TORCH_CHECK(block.size(0) <= INT32_MAX / kBlockNodes<D>, "block must have at most ", INT32_MAX / kBlockNodes<D>,
                  " entries, got ", block.size(0));
  return int(block.size(0));
}

// Sizes are checked; of the contents, which only `activate` may write, no more than costs nothing: on the CPU, that no
// slot has a block beyond the table, which may be that of fewer scenes.
template <class T, int D>
Topology<T, D> topology(const Tensor& x, const Tensor& table, const Tensor& block, const Tensor& offsets,
                        const Tensor& index, const Tensor& schedule, double dx, const std::vector<double>& lower,
                        const std::vector<int64_t>& blocks) {
  Topology<T, D> t;
  t.geometry = geometry<T, D>(dx, lower, blocks);
  t.particles = x.size(0);
  t.capacity = block_capacity<D>(block);
  check_rank(table, "table", 1);
  const int64_t size = table.size(0), per_scene = t.geometry.blocks_per_scene;
  STD_TORCH_CHECK(size % per_scene == 0 && size <= INT32_MAX && (size > 0 || t.particles == 0),
                  "table must have shape [B * ", per_scene, "] for the scenes of all particles, got ", shape_of(table));
  t.scenes = int(size / per_scene);
  t.table = int_pointer(table, "table", x, {size});
  t.block = int_pointer(block, "block", x, {t.capacity});
  t.offsets = int_pointer(offsets, "offsets", x, {int64_t(t.capacity) + 1});
  t.index = int_pointer(index, "index", x, {t.particles});
  t.schedule_size = schedule_size<D>(t.capacity, t.particles);
  t.schedule = int_pointer(schedule, "schedule", x, {t.schedule_size});
  if (x.is_cpu()) {
    int most = -1;
    for (int slot = 0; slot < t.capacity; slot++) most = std::max(most, t.block[slot]);
    STD_TORCH_CHECK(most < size, "block must have entries below the ", size, " of table, got ", most);
  }
  return t;
}

inline StressForm stress_form_of(int64_t form) {
  STD_TORCH_CHECK(form == int64_t(StressForm::mls) || form == int64_t(StressForm::gradient),
                  "stress_form must be 0 (MLS) or 1 (B-spline gradient), got ", form);
  return StressForm(form);
}

template <int D>
int64_t node_count(const Tensor& block) {
  return block.size(0) * kBlockNodes<D>;
}

}  // namespace mpm
