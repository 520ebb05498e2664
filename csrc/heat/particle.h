#pragma once

#include <cmath>

#include "common/safe_root.h"

// Formulas of a step of heat for one particle (torch_mpm/heat/heat.py), for any scalar.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class T>
MPM_HD T clamp_to_unit(const T& a) {
  return select(a > T(1), T(1), select(a < T(0), T(0), a));
}

// Heat capacity m C, conductance κ V, diffusion number r = κ V dt/(m C dx²), and the blend β = min(1, 4 r + dt |sym
// ∇v|) of the hybrid. Where matter is strained, the gradient of the particle relaxes to that of the grid.
template <class T>
struct HeatWeights {
  T capacity, conductance, number, blend;
};

// |sym ∇v| [1/s].
template <class T, int D>
MPM_HD T strain_rate_of(const Matrix<T, D>& L) {
  T squared = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) {
      const T strain = T(0.5) * (L[i][j] + L[j][i]);
      squared = squared + strain * strain;
    }
  return safe_root(squared);
}

// Derivative of that rate by ∇v, zero at rest.
template <class T, int D>
MPM_HD Matrix<T, D> strain_rate_slope(const Matrix<T, D>& L) {
  const T rate = strain_rate_of(L);
  const auto moves = rate > T(0);
  return select(moves, T(0.5) / select(moves, rate, T(1)), T(0)) * (L + transpose(L));
}

template <class T>
MPM_HD HeatWeights<T> heat_weights(const T& volume, const T& specific_heat, const T& conductivity, const T& mass,
                                   const T& dt, const T& strain_rate, const T& dx) {
  HeatWeights<T> w;
  w.capacity = specific_heat * mass;
  w.conductance = select(conductivity >= T(0), conductivity, T(NAN)) * volume;
  w.number = dt * w.conductance / (select(w.capacity > T(0), w.capacity, T(1)) * dx * dx);
  const T rate = T(4) * w.number + dt * strain_rate;
  w.blend = select(rate > T(1), T(1), rate);
  return w;
}

// What a particle adds to the channels of a node (HeatChannel), with its temperature; and the slopes of the last two,
// with the change of temperature over a cell.
template <class T>
struct HeatSums {
  T capacity, varying, theta, mean;
};

template <class T>
MPM_HD HeatSums<T> heat_sums(const HeatWeights<T>& w, const T& theta) {
  const T varying = w.capacity * w.blend;
  return {w.capacity, varying, w.capacity * theta, varying * theta};
}

// A quantity after G2P, from the gathered increment and the gathered average θ̄ of the particles.
template <class T>
MPM_HD T blended(const T& increment, const T& average, const T& before, const T& blend) {
  return before + increment + blend * (average - before);
}

// The temperature gradient transported with matter that moves by 1 + dt ∇v: the inverse transpose of that times g, to
// second order in dt.
template <class T, int D>
MPM_HD Vector<T, D> transported_gradient(const Vector<T, D>& g, const Matrix<T, D>& L, const T& dt) {
  const Vector<T, D> first = dt * (transpose(L) * g), second = dt * (transpose(L) * first);
  Vector<T, D> r;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r[i] = g[i] - first[i] + second[i];
  return r;
}

// The gradient after G2P, from the gathered increment and average.
template <class T, int D>
MPM_HD Vector<T, D> gradient_after(const Vector<T, D>& increment, const Vector<T, D>& average,
                                   const Vector<T, D>& before, const T& blend, const Matrix<T, D>& L, const T& dt) {
  Vector<T, D> g;
  MPM_UNROLL for (int i = 0; i < D; i++)
    g[i] = blended(increment[i], average[i], before[i], blend);
  return transported_gradient(g, L, dt);
}

// Layer of width w around a held surface, at a distance a from it: the share s = 1 − (1 − a²/w²)³ of the conductivity,
// and the rate s'/a of the exchange (torch_mpm/heat/boundaries.py, FixedSurface).
template <class T>
struct HeatLayerAt {
  T share, rate;
};

template <class T>
MPM_HD HeatLayerAt<T> heat_layer(const T& distance, const T& width) {
  const T ratio = clamp_to_unit(distance / width), rest = T(1) - ratio * ratio;
  return {T(1) - rest * rest * rest, T(6) / (width * width) * rest * rest};
}

// Radiation of a surface with black = area ε σ into surroundings at a temperature, linearised about θ, both relative to
// a reference [K]: the heat that enters is power − coefficient θ.
template <class T>
struct HeatRadiationAt {
  T coefficient, power;
};

template <class T>
MPM_HD HeatRadiationAt<T> heat_radiation(const T& black, const T& theta, const T& relative, const T& reference) {
  const T ambient = relative + reference, kelvin = theta + reference;
  const T hot = select(kelvin > T(0), kelvin, T(0)), square = hot * hot, slope = T(4) * square * hot;
  const T coefficient = black * slope;
  return {coefficient, coefficient * theta + black * (ambient * ambient * ambient * ambient - square * square)};
}

// Moves the excess of θ over the melting point into the latent heat, or out of it (enthalpy buffer; Stomakhin et al.
// 2014). Returns the diffusion number r where the liquid fraction changes, else zero.
template <class T>
MPM_HD T melt(T& theta, T& liquid, const T& melting_point, const T& specific_heat, const T& latent_heat, const T& r) {
  const T ratio = specific_heat / latent_heat, before = liquid;
  liquid = clamp_to_unit(before + ratio * (theta - melting_point));
  theta = theta - (liquid - before) / ratio;
  return select(liquid > before, r, select(liquid < before, r, T(0)));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
