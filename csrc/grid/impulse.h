#pragma once

#include <cstdint>

#include "grid/lattice_node.h"
#include "grid/slot_sums.h"

// The impulse that the material gives a boundary: at each node that a wall or obstacle slows down, mass times the
// velocity that it takes. Of each boundary of each scene there are D numbers, the sum of these [N s], and then that of
// their moments about the origin [N m s]: one in 2-D, a vector in 3-D. They are float64 everywhere.
namespace mpm {

template <int D>
constexpr int kTurns = D == 2 ? 1 : 3;
template <int D>
constexpr int kImpulse = D + kTurns<D>;  // numbers of an impulse

// Where the impulses on boundaries are that follow one another.
template <int D>
struct ImpulseArguments {
  double dx, lower[D];
  int scenes = 0, boundaries = 0;
  int64_t scene_stride = 0;      // numbers from a scene to the next
  double* sum = nullptr;         // what they are added to, of the first scene
  const double* grad = nullptr;  // its adjoint, in the same places; backward only
  // [max_blocks, boundaries, kImpulse], a work space for sums whose order is that of the slots; null on CUDA where they
  // need none.
  double* slots = nullptr;

  int numbers() const { return boundaries * kImpulse<D>; }
  // Of what slots have left there.
  SlotSums<double> slot_sums(int max_blocks, int blocks_per_scene, const int* block) const {
    return {max_blocks, blocks_per_scene, block, scenes, numbers(), true, slots, sum, scene_stride};
  }
};

// For adjoints where impulses have none.
struct NoImpulses {
  static constexpr bool wanted = false;
  MPM_HD NoImpulses operator()(int, int64_t) const { return {}; }  // of a node, as the functions below take it
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

// What a node of mass m adds to the adjoints where boundaries take from it, each in turn, m (before - after).
template <class T, int D>
struct NodeImpulses {
  static constexpr bool wanted = true;
  const ImpulseArguments<D>& a;
  const double* grad;  // of the first boundary of its scene
  T mass, mass_grad = T(0);

  MPM_HD NodeImpulses(const ImpulseArguments<D>& arguments, int scene, const T& m)
      : a(arguments), grad(arguments.grad + scene * arguments.scene_stride), mass(m) {}

  // Adjoint of an impulse on a boundary where a lattice node is: the transpose of ImpulseSum::add.
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

  // The adjoint of the velocity after a boundary with that of its impulse; that before it gets `mass * weight` more.
  MPM_HD Vector<T, D> take(const Vector<T, D>& weight, const Vector<T, D>& before, const Vector<T, D>& after,
                           const Vector<T, D>& grad_after) {
    mass_grad += dot(weight, before + T(-1) * after);
    return grad_after + (T(0) - mass) * weight;
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
