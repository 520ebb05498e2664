#pragma once

#include "cuda/home.cuh"

namespace mpm::cuda {

template <class T, int D>
__device__ ParticleMomentum<T, D> read_momentum(const P2GArguments<T, D>& a, int64_t p, int scene) {
  ParticleMomentum<T, D> m;
  m.mass = read(a.mass, p);
  m.volume = T(0);
  m.dt = T(0);
  if (a.stress.pointer) {
    m.volume = read(a.volume, p);
    m.dt = a.scene_dt.pointer ? T(a.dt) * read(a.scene_dt, scene) : T(a.dt);
  }
#pragma unroll
  for (int i = 0; i < D; i++) {
    m.velocity[i] = read(a.velocity, p, i);
#pragma unroll
    for (int j = 0; j < D; j++) {
      m.affine[i][j] = a.affine.pointer ? read(a.affine, p, i, j) : T(0);
      m.stress[i][j] = a.stress.pointer ? read(a.stress, p, i, j) : T(0);
    }
  }
  return m;
}

template <int Order, class T, int D>
__device__ NodeMomentum<T, D> node_momentum(const P2GArguments<T, D>& a, const ParticleMomentum<T, D>& m) {
  const Geometry<T, D>& g = a.topology.geometry;
  return to_nodes<Order>(m, a.form, a.affine.pointer != nullptr, a.stress.pointer != nullptr, g.dx, g.inverse_dx);
}

// Whether the stress stands apart from the affine momentum, as a multiple of the weight gradient.
template <class T, int D>
bool has_gradient(const P2GArguments<T, D>& a) {
  return a.stress.pointer && a.form == StressForm::gradient;
}

// Channels from `first` on of a particle field [P, K, ...].
template <class T>
Field<T> channels_from(Field<T> f, int first) {
  if (f.pointer) f.pointer += first * f.stride[1];
  return f;
}

}  // namespace mpm::cuda
