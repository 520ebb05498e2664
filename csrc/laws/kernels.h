#pragma once

#include "laws/evaluate.h"

// The bodies of the material kernels: load particle p (V a scalar) or particles p, p + 1, ... (V a pack), evaluate,
// store.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// One value of a field, or the values of consecutive particles at this stride in the lanes of a pack.
template <class V>
struct Lane {
  template <class T>
  MPM_HD static V load(const T* pointer, int64_t) {
    return V(*pointer);
  }
  template <class T>
  MPM_HD static void store(T* pointer, int64_t, const V& value) {
    *pointer = T(value);
  }
  template <class F>
  MPM_HD static V each(const F& f) {  // f(lane) in each lane
    return V(f(0));
  }
};

template <class V, int D, class T>
MPM_HD Matrix<V, D> load_matrix(const Field<const T>& f, int64_t p) {
  Matrix<V, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++)
      r[i][j] = Lane<V>::load(f.pointer + p * f.stride[0] + i * f.stride[1] + j * f.stride[2], f.stride[0]);
  return r;
}

template <class V, int D, class T>
MPM_HD void store_matrix(const Field<T>& f, int64_t p, const Matrix<V, D>& a) {
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++)
      Lane<V>::store(f.pointer + p * f.stride[0] + i * f.stride[1] + j * f.stride[2], f.stride[0], a[i][j]);
}

// A scene id out of range takes the parameter of scene 0: such a particle is not transferred anyway.
template <class T>
MPM_HD T scene_parameter(const Parameter<T>& a, int scene) {
  return a.pointer[(scene >= 0 && scene < a.scenes ? scene : 0) * a.stride];
}

template <class V, class T, int D>
MPM_HD V load_parameter(const LawArguments<T, D>& a, int k, int64_t p) {
  const Parameter<T>& parameter = a.parameters[k];
  if (parameter.scenes)
    return Lane<V>::each([&](int i) { return scene_parameter(parameter, a.scene[(p + i) * a.scene_stride]); });
  return Lane<V>::load(parameter.pointer + p * parameter.stride, parameter.stride);
}

template <class Law, class V, class T, int D>
MPM_HD Particle<Law, V, D> load_particle(const LawArguments<T, D>& a, int64_t p) {
  Particle<Law, V, D> r;
  if constexpr (Law::shear)
    r.F = load_matrix<V, D>(a.state, p);
  else
    r.J = Lane<V>::load(a.state.pointer + p * a.state.stride[0], a.state.stride[0]);
  r.C = Law::viscous && a.C.pointer ? load_matrix<V, D>(a.C, p) : zero_matrix<V, D>();
  MPM_UNROLL for (int k = 0; k < Law::parameters; k++)
    r.parameters[k] = load_parameter<V>(a, k, p);
  return r;
}

template <class Law, class V, class T, int D>
MPM_HD void store_state(const Field<T>& f, int64_t p, const Particle<Law, V, D>& a) {
  if (!f.pointer) return;
  if constexpr (Law::shear)
    store_matrix(f, p, a.F);
  else
    Lane<V>::store(f.pointer + p * f.stride[0], f.stride[0], a.J);
}

template <class Law, class V, class T, int D>
MPM_HD void store_parameters(const Field<T>& f, int64_t p, const Particle<Law, V, D>& a) {
  if (!f.pointer) return;
  MPM_UNROLL for (int k = 0; k < Law::parameters; k++)
    Lane<V>::store(f.pointer + p * f.stride[0] + k * f.stride[1], f.stride[0], a.parameters[k]);
}

template <class Law, class V, class T, int D>
MPM_HD void stress_at(const StressArguments<T, D>& a, int64_t p) {
  store_matrix(a.stress, p, evaluate_stress(load_particle<Law, V>(a.law, p)));
}

template <class Law, class V, class T, int D>
MPM_HD void stress_backward_at(const StressBackwardArguments<T, D>& a, int64_t p) {
  const int needs =
      (a.state.pointer ? kState : 0) | (a.C.pointer ? kVelocityGradient : 0) | (a.parameters.pointer ? kParameters : 0);
  const auto g = stress_adjoint(load_particle<Law, V>(a.law, p), load_matrix<V, D>(a.grad_stress, p), needs);
  store_state(a.state, p, g);
  if constexpr (Law::viscous)
    if (a.C.pointer) store_matrix(a.C, p, g.C);
  store_parameters(a.parameters, p, g);
}

template <class Law, class V, class T, int D>
MPM_HD void modulus_at(const ScalarArguments<T, D>& a, int64_t p) {
  Lane<V>::store(a.value.pointer + p * a.value.stride[0], a.value.stride[0],
                 evaluate_modulus(load_particle<Law, V>(a.law, p), a.which));
}

// Energies are small differences of large terms near rest: they are evaluated in float64 for either scalar type.
template <class Law, class T, int D>
MPM_HD void energy_at(const ScalarArguments<T, D>& a, int64_t p) {
  Lane<double>::store(a.value.pointer + p * a.value.stride[0], 0,
                      evaluate_energy(load_particle<Law, double>(a.law, p)));
}

template <class Law, class T, int D>
MPM_HD void energy_backward_at(const EnergyBackwardArguments<T, D>& a, int64_t p) {
  const int needs = (a.state.pointer ? kState : 0) | (a.parameters.pointer ? kParameters : 0);
  const double grad = a.grad_energy.pointer[p * a.grad_energy.stride[0]];
  const auto g = energy_adjoint(load_particle<Law, double>(a.law, p), grad, needs);
  store_state(a.state, p, g);
  store_parameters(a.parameters, p, g);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
