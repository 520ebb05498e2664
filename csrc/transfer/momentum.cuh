#pragma once

#include "cuda/base_block.cuh"
#include "cuda/columns.cuh"
#include "transfer/arguments.h"

namespace mpm::cuda {

// Particle fields of P2G on the device.
template <int Order, class T, int D>
struct MomentumFields {
  Columns<const T, 1> mass, volume;
  Columns<const T, D> velocity;
  Columns<const T, D * D> affine, stress;
  Field<const T> scene_dt;
  T dt, dx, inverse_dx;
  StressForm form;

  explicit MomentumFields(const P2GArguments<T, D>& a)
      : mass(a.mass),
        volume(a.volume),
        velocity(a.velocity),
        affine(a.affine, D),
        stress(a.stress, D),
        scene_dt(a.scene_dt),
        dt(T(a.dt)),
        dx(a.topology.geometry.dx),
        inverse_dx(a.topology.geometry.inverse_dx),
        form(a.form) {}

  __device__ ParticleMomentum<T, D> read(int p, int scene, bool with_stress) const {
    ParticleMomentum<T, D> m{};
    m.mass = mass.at(p);
    read_motion(p, m);
    if (with_stress) {
      m.volume = volume.at(p);
#pragma unroll
      for (int i = 0; i < D; i++)
#pragma unroll
        for (int j = 0; j < D; j++) m.stress[i][j] = stress.at(p, i * D + j);
      m.dt = time_step(scene);
    }
    return m;
  }
  // Except for its motion and the stress, which the caller has.
  __device__ ParticleMomentum<T, D> read_at_rest(int p, const T& dt) const {
    ParticleMomentum<T, D> m{};
    m.mass = mass.at(p);
    m.volume = volume.at(p);
    m.dt = dt;
    return m;
  }
  __device__ void read_motion(int p, ParticleMomentum<T, D>& m) const {
#pragma unroll
    for (int i = 0; i < D; i++) {
      m.velocity[i] = velocity.at(p, i);
#pragma unroll
      for (int j = 0; j < D; j++) m.affine[i][j] = affine.present() ? affine.at(p, i * D + j) : T(0);
    }
  }
  __device__ T time_step(int scene) const {
    return scene_dt.pointer ? dt * scene_dt.pointer[scene * scene_dt.stride[0]] : dt;
  }
  __device__ NodeMomentum<T, D> to_nodes(const ParticleMomentum<T, D>& m, StressForm known_form,
                                         bool with_stress) const {
    return mpm::to_nodes<Order>(m, known_form, affine.present(), with_stress, dx, inverse_dx);
  }
  __device__ ParticleMomentum<T, D> adjoint(const ParticleMomentum<T, D>& m, const NodeMomentum<T, D>& sums) const {
    return mpm::adjoint<Order>(m, sums, form, affine.present(), stress.present(), dx, inverse_dx);
  }
};

// Whether the stress is separate from the affine momentum, as a multiple of the weight gradient.
template <class T, int D>
bool has_gradient(const P2GArguments<T, D>& a) {
  return a.stress.pointer && a.form == StressForm::gradient;
}

}  // namespace mpm::cuda
