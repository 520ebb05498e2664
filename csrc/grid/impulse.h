#pragma once

#include <cstdint>

#include "grid/lattice_node.h"
#include "grid/slot_sums.h"

// Impulse of the material on a boundary: the sum over nodes of mass times the velocity change by the boundary. A
// boundary of a scene has D components of the impulse [N s], and then those of its moment about the origin [N m s]: one
// in 2-D, three in 3-D. They are float64 everywhere.
namespace mpm {

template <int D>
constexpr int kTurns = D == 2 ? 1 : 3;
template <int D>
constexpr int kImpulse = D + kTurns<D>;  // numbers of an impulse

// Place of the impulses on consecutive boundaries.
template <int D>
struct ImpulseArguments {
  double dx, lower[D];
  int scenes = 0, boundaries = 0;
  int64_t scene_stride = 0;      // in numbers, from a scene to the next
  double* sum = nullptr;         // destination, for the first scene
  const double* grad = nullptr;  // adjoint of the sum, with the same layout; backward only
  // [max_blocks, boundaries, kImpulse], work space for sums in the order of the slots; null on CUDA if the order is
  // arbitrary.
  double* slots = nullptr;

  int numbers() const { return boundaries * kImpulse<D>; }
  // Sums over the values of the slots.
  SlotSums<double> slot_sums(int max_blocks, int blocks_per_scene, const int* block) const {
    return {max_blocks, blocks_per_scene, block, scenes, numbers(), true, slots, sum, scene_stride};
  }
};

// In place of NodeImpulses, without adjoints of impulses.
struct NoImpulses {
  static constexpr bool wanted = false;
  MPM_HD NoImpulses operator()(int, int64_t) const { return {}; }  // of a node, as for the functions below
};

inline namespace TORCH_MPM_ISA {

template <int D>
MPM_HD Vector<double, D> lattice_position(const ImpulseArguments<D>& a, const Vector<int, D>& node) {
  Vector<double, D> x;
  MPM_UNROLL for (int i = 0; i < D; i++)
    x[i] = a.lower[i] + double(node[i] - kPadding) * a.dx;
  return x;
}

template <int D>
struct ImpulseSum {
  double e[kImpulse<D>] = {};

  template <class T>
  MPM_HD void add(const Vector<double, D>& x, const Vector<T, D>& impulse) {
    MPM_UNROLL for (int i = 0; i < D; i++)
      e[i] += double(impulse[i]);
    MPM_UNROLL for (int i = 0; i < kTurns<D>; i++) {
      const int j = D == 2 ? 0 : (i + 1) % 3, k = D == 2 ? 1 : (i + 2) % 3;
      e[D + i] += x[j] * double(impulse[k]) - x[k] * double(impulse[j]);
    }
  }
};

// Adjoint of the impulses m (before - after) of a node of mass m on the boundaries that act on it in turn.
template <class T, int D>
struct NodeImpulses {
  static constexpr bool wanted = true;
  const ImpulseArguments<D>& a;
  const double* grad;  // of the first boundary of its scene
  T mass, mass_grad = T(0);

  MPM_HD NodeImpulses(const ImpulseArguments<D>& arguments, int scene, const T& m)
      : a(arguments), grad(arguments.grad + scene * arguments.scene_stride), mass(m) {}

  // Adjoint of an impulse on a boundary at a lattice node: the transpose of ImpulseSum::add.
  MPM_HD Vector<T, D> weight(int boundary, const Vector<int, D>& node) const {
    const double* const g = grad + boundary * kImpulse<D>;
    const Vector<double, D> x = lattice_position(a, node);
    double w[D];
    MPM_UNROLL for (int i = 0; i < D; i++)
      w[i] = g[i];
    MPM_UNROLL for (int i = 0; i < kTurns<D>; i++) {
      const int j = D == 2 ? 0 : (i + 1) % 3, k = D == 2 ? 1 : (i + 2) % 3;
      w[k] += g[D + i] * x[j];
      w[j] -= g[D + i] * x[k];
    }
    Vector<T, D> result;
    MPM_UNROLL for (int i = 0; i < D; i++)
      result[i] = T(w[i]);
    return result;
  }

  // The adjoint of the velocity after a boundary including that of its impulse; that of the velocity before also has
  // `mass * weight`.
  MPM_HD Vector<T, D> take(const Vector<T, D>& weight, const Vector<T, D>& before, const Vector<T, D>& after,
                           const Vector<T, D>& grad_after) {
    mass_grad += dot(weight, before + T(-1) * after);
    return grad_after + (T(0) - mass) * weight;
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
