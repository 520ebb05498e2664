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

#include "common/fields.h"

// Checks, allocation and views shared by the op families. The Python wrapper has checked values and given readable
// errors already; here everything that memory safety depends on is checked again.
namespace mpm {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using OptionalTensor = std::optional<Tensor>;
using Shape = std::vector<int64_t>;

// An undefined tensor. Its copies share one handle; the constructor of Tensor allocates a handle.
inline const Tensor& absent() {
  static const Tensor tensor;
  return tensor;
}

inline bool has(const OptionalTensor& t) { return t.has_value() && t->defined(); }

// ---- Text for messages

inline std::string text(const Shape& shape) {
  std::string s;
  for (int64_t size : shape) s += (s.empty() ? "" : ", ") + std::to_string(size);
  return "[" + s + "]";
}

inline Shape sizes_of(const Tensor& t) {
  Shape shape(t.dim());
  for (size_t i = 0; i < shape.size(); i++) shape[i] = t.size(int64_t(i));
  return shape;
}

inline std::string shape_of(const Tensor& t) { return text(sizes_of(t)); }

// Name in Python.
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

// Not every torch version checks sizes of dimensions that a tensor lacks: query the rank first.
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
  if (!t.defined()) return f;
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

// Uninitialised tensors on the device of another one; on the CPU, large ones come from a cache
// (csrc/cpu/memory_cache.h).
Tensor empty_strided(const Tensor& like, const Shape& shape, const Shape& strides, ScalarType type);
Tensor empty(const Tensor& like, const Shape& shape, ScalarType type);
Tensor empty(const Tensor& like, const Shape& shape);
inline Tensor empty_int(const Tensor& like, const Shape& shape) { return empty(like, shape, ScalarType::Int); }
Tensor zeros(const Tensor& like, const Shape& shape);

// Sets a contiguous tensor to zero, on torch's current stream.
void clear(Tensor& t);
void clear_memory(void* memory, int64_t bytes);  // of the CPU

// Elements between rows of a structure of arrays. On the CPU, rows of whole pages (P a power of two) would share cache
// sets, and a load would wait for stores to other rows with equal low address bits: 23 cache lines more than pages
// spread the nine rows of a matrix evenly over a page of 64.
inline int64_t particle_pitch(const Tensor& like, int64_t particles) {
  if (!like.is_cpu()) return particles;
  constexpr int64_t line = 64, page = 64, shift = 23;
  const int64_t bytes = int64_t(like.element_size()), lines = (particles * bytes + line - 1) / line;
  return ((lines + page - 1 - shift) / page * page + shift) * line / bytes;
}

// A [P, ...] tensor stored as structure of arrays: the particle index is contiguous.
Tensor empty_particles(const Tensor& like, const Shape& shape);

// Result per particle; undefined, None in Python, where it is not requested.
inline Tensor result(const Tensor& like, bool wanted, const Shape& shape) {
  return wanted ? empty_particles(like, shape) : absent();
}

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

// The same for the dtype and dimension of positions.
template <class F>
void dispatch(const Tensor& x, F&& f) {
  check_positions(x);
  dispatch(x, "x", x.size(1), f);
}

inline const int* int_pointer(const Tensor& t, const char* name, const Tensor& x, const Shape& shape) {
  check_shape(t, name, shape);
  check_type(t, name, ScalarType::Int, x);
  STD_TORCH_CHECK(t.is_contiguous(), name, " must be contiguous");
  return static_cast<const int*>(t.data_ptr());
}

}  // namespace mpm
