#pragma once

#include "grid/impulse.h"
#include "grid/topology.op.h"

// Impulses on boundaries as arguments of ops, float64 [B, boundaries, D + 1 or 3].
namespace mpm {

inline Tensor no_impulses(const Tensor& like, int64_t scenes, int64_t boundaries, int64_t dim) {
  Tensor sums = empty(like, {scenes, boundaries, dim == 2 ? kImpulse<2> : kImpulse<3>}, ScalarType::Double);
  return torch::stable::zero_(sums);
}

// Impulses of `count` boundaries, which are added to `sums` from boundary `first` on. Undefined `slots` become the work
// space, if one is needed.
template <int D>
ImpulseArguments<D> impulse_arguments(const PackedLattice& lattice, const Tensor& sums, int64_t first, int64_t count,
                                      int64_t max_blocks, Tensor& slots) {
  ImpulseArguments<D> a;
  a.dx = lattice.dx();
  std::copy_n(lattice.lower(), D, a.lower);
  a.scenes = int(sums.size(0));
  a.boundaries = int(count);
  a.scene_stride = sums.size(1) * kImpulse<D>;
  a.sum = static_cast<double*>(sums.data_ptr()) + first * kImpulse<D>;
  if (!sums.is_cpu() && !lattice.deterministic()) return a;
  if (!slots.defined()) slots = empty(sums, {max_blocks, a.numbers()});
  a.slots = static_cast<double*>(slots.data_ptr());
  return a;
}

// The same for the adjoint of the impulses.
template <int D>
ImpulseArguments<D> impulse_gradient(const PackedLattice& lattice, const Tensor& grad, int64_t first, int64_t count,
                                     const Shape& shape, const Tensor& like) {
  check_shape(grad, "grad_impulse", shape);
  check_type(grad, "grad_impulse", ScalarType::Double, like);
  STD_TORCH_CHECK(grad.is_contiguous(), "grad_impulse must be contiguous");
  ImpulseArguments<D> a;
  a.dx = lattice.dx();
  std::copy_n(lattice.lower(), D, a.lower);
  a.scenes = int(grad.size(0));
  a.boundaries = int(count);
  a.scene_stride = grad.size(1) * kImpulse<D>;
  a.grad = static_cast<const double*>(grad.data_ptr()) + first * kImpulse<D>;
  return a;
}

}  // namespace mpm
