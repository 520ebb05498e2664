#pragma once

#include "materials/arguments.h"
#include "ops/tensors.h"

// What the ops of constitutive laws share: dispatch on the deformation gradient, parameters, optional results.
namespace mpm {

// Calls f.operator()<T, D>().
template <class F>
void dispatch_deformation(const Tensor& deformation, F&& f) {
  STD_TORCH_CHECK(deformation.dim() == 3 && (deformation.size(1) == 2 || deformation.size(1) == 3),
                  "F must have shape [P, 2, 2] or [P, 3, 3]");
  const auto by_dimension = [&]<class T>() {
    deformation.size(1) == 2 ? f.template operator()<T, 2>() : f.template operator()<T, 3>();
  };
  if (deformation.scalar_type() == ScalarType::Float)
    by_dimension.template operator()<float>();
  else if (deformation.scalar_type() == ScalarType::Double)
    by_dimension.template operator()<double>();
  else
    STD_TORCH_CHECK(false, "F must be float32 or float64");
}

template <class T>
Parameter<T> parameter(const Tensor& t, const Tensor& state, int64_t particles, bool has_scene) {
  STD_TORCH_CHECK(t.dim() <= 1, "a parameter must be a scalar or have shape [1], [B] or [P]");
  check_like(t, "a parameter", state);
  const T* pointer = static_cast<const T*>(t.data_ptr());
  if (t.numel() == 1) return {pointer, 0, 0};
  if (t.numel() == particles) return {pointer, t.stride(0), 0};
  STD_TORCH_CHECK(has_scene && t.numel() > 0, "a parameter must be a scalar or have shape [1], [B] or [P]");
  return {pointer, t.stride(0), t.numel()};
}

// Sets `scene` and `scene_stride` of the arguments of a law.
template <class Arguments>
void set_scene(Arguments& a, const OptionalTensor& scene, const Tensor& state) {
  if (!has(scene)) return;
  check_shape(*scene, "scene", {state.size(0)});
  STD_TORCH_CHECK(scene->scalar_type() == ScalarType::Int && scene->device() == state.device(),
                  "scene must be an int32 tensor on the device of the state");
  a.scene = static_cast<const int*>(scene->data_ptr());
  a.scene_stride = scene->stride(0);
}

// A result per particle, or an empty tensor where it is not wanted.
template <class T>
Field<T> optional_result(const Tensor& like, bool wanted, const Shape& shape, Tensor& out) {
  out = wanted ? empty_particles(like, shape) : empty(like, {0});
  return wanted ? field<T>(out) : Field<T>{};
}

}  // namespace mpm
