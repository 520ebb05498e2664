#pragma once

#include "grid/box_distance.h"
#include "heat/particle.h"
#include "pointwise/function.h"

// Pointwise parts of a step of heat at particles and nodes (torch_mpm/heat).
namespace mpm {
inline namespace TORCH_MPM_ISA {

// Rest volume, J, F (either is the number one where the other gives the volume), C, κ, mass, dt, ∇v, dx to the present
// volume V, heat capacity m C, conductance κ V, the blend β, and the diffusion number r.
struct HeatWeightsOfParticle {
  static constexpr const char* name = "heat_weights";
  static constexpr Entries arguments[] = {kScalar, kScalar, kMatrix, kScalar, kScalar,
                                          kScalar, kScalar, kMatrix, kScalar};
  static constexpr Entries results[] = {kScalar, kScalar, kScalar, kScalar, kScalar};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T rest = in.scalar(), J = in.scalar();
    const T volume = rest * J * determinant(in.matrix());
    const T specific_heat = in.scalar(), conductivity = in.scalar(), mass = in.scalar(), dt = in.scalar();
    const Matrix<T, D> L = in.matrix();
    const HeatWeights<T> w =
        heat_weights(volume, specific_heat, conductivity, mass, dt, strain_rate_of(L), in.scalar());
    out.put(volume);
    out.put(w.capacity);
    out.put(w.conductance);
    out.put(w.blend);
    out.put(w.number);
  }
};

// Sums of θ with a weight w and with a share of it as second weight, for `scatter`: w θ for each weight, then the
// weights; and their moments w g, zero for the weights themselves.
template <int Weights>
struct HeatMoments {
  static constexpr const char* name = Weights == 1 ? "heat_moments_1" : "heat_moments_2";
  static constexpr Entries arguments[] = {kScalar, kVector, kScalar, kScalar};
  static constexpr Entries results[] = {{2 * Weights}, {2 * Weights, kDimension}};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T theta = in.scalar();
    const Vector<T, D> gradient = in.vector();
    T weight[2];
    weight[0] = in.scalar();
    weight[1] = weight[0] * in.scalar();
    MPM_UNROLL for (int k = 0; k < Weights; k++)
      out.put(weight[k] * theta);
    MPM_UNROLL for (int k = 0; k < Weights; k++)
      out.put(weight[k]);
    MPM_UNROLL for (int k = 0; k < Weights; k++)
      out.put(weight[k] * gradient);
    MPM_UNROLL for (int k = 0; k < Weights; k++)
      out.put(zero_vector<T, D>());
  }
};

// Sums of w θ and of w for each weight: the sums of w, and the averages of θ, zero where there is no matter.
template <int Weights>
struct HeatMeans {
  static constexpr const char* name = Weights == 1 ? "heat_means_1" : "heat_means_2";
  static constexpr Entries arguments[] = {{2 * Weights}};
  static constexpr Entries results[] = {{Weights}, {Weights}};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    T total[Weights], weight[Weights];
    MPM_UNROLL for (int k = 0; k < Weights; k++)
      total[k] = in.scalar();
    MPM_UNROLL for (int k = 0; k < Weights; k++)
      out.put(weight[k] = in.scalar());
    MPM_UNROLL for (int k = 0; k < Weights; k++) {
      const auto full = weight[k] > T(0);
      out.put(select(full, total[k] / select(full, weight[k], T(1)), T(0)));
    }
  }
};

// Gathered values, θ, g, β, ∇v and dt: θ and g after the step. With two channels, the increments and θ̄, particles
// receive Σ N (d + β (θ̄ − θ)); with one, Σ N (d + β θ̄) − β θ, with the same β for all. Then g is transported with
// matter that moves by 1 + dt ∇v: the inverse transpose of that times g, to second order in dt.
template <int Channels>
struct HeatUpdate {
  static constexpr const char* name = Channels == 1 ? "heat_update_1" : "heat_update_2";
  static constexpr Entries arguments[] = {{Channels}, {Channels, kDimension}, kScalar, kVector, kScalar, kMatrix,
                                          kScalar};
  static constexpr Entries results[] = {kScalar, kVector};

  template <class T>
  MPM_HD static T blended(const T (&change)[Channels], const T& before, const T& blend) {
    if constexpr (Channels == 2)
      return mpm::blended(change[0], change[1], before, blend);
    else
      return (T(1) - blend) * before + change[0];
  }

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    T value[Channels];
    Vector<T, D> moment[Channels];
    MPM_UNROLL for (T& v : value)
      v = in.scalar();
    MPM_UNROLL for (Vector<T, D>& m : moment)
      m = in.vector();
    const T theta = in.scalar();
    const Vector<T, D> g = in.vector();
    const T blend = in.scalar();
    const Matrix<T, D> L = in.matrix();
    const T dt = in.scalar();
    out.put(blended(value, theta, blend));
    Vector<T, D> after;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      T change[Channels];
      MPM_UNROLL for (int k = 0; k < Channels; k++)
        change[k] = moment[k][i];
      after[i] = blended(change, g[i], blend);
    }
    out.put(transported_gradient(after, L, dt));
  }
};

// θ, liquid fraction f, melting point θ_m, C, L, diffusion number r: θ and f with the excess over the melting point
// moved into the latent heat, or out of it (enthalpy buffer; Stomakhin et al. 2014), and r where f changes, else zero.
struct HeatMelt {
  static constexpr const char* name = "heat_melt";
  static constexpr Entries arguments[] = {kScalar, kScalar, kScalar, kScalar, kScalar, kScalar};
  static constexpr Entries results[] = {kScalar, kScalar, kScalar};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    T theta = in.scalar(), liquid = in.scalar();
    const T melting_point = in.scalar(), specific_heat = in.scalar(), latent_heat = in.scalar(), r = in.scalar();
    const T changing = melt(theta, liquid, melting_point, specific_heat, latent_heat, r);
    out.put(theta);
    out.put(liquid);
    out.put(changing);
  }
};

// Distance a from a surface and width w of its layer: the share s = 1 − (1 − a²/w²)³ and s'/a.
struct HeatLayer {
  static constexpr const char* name = "heat_layer";
  static constexpr Entries arguments[] = {kScalar, kScalar};
  static constexpr Entries results[] = {kScalar, kScalar};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T distance = in.scalar(), width = in.scalar();
    const HeatLayerAt<T> layer = heat_layer(distance, width);
    out.put(layer.share);
    out.put(layer.rate);
  }
};

// Remaining conductance κ V, κ V itself, s'/a of a layer and D⁻¹: its exchange, κ V s'/a, and the new remainder. At the
// nodes a particle exchanges with Σ_i N_i (θ_i − T)², which for a linear temperature exceeds that at the particle by D
// |∇θ|²; this is subtracted from its κ V.
struct HeatExchange {
  static constexpr const char* name = "heat_exchange";
  static constexpr Entries arguments[] = {kScalar, kScalar, kScalar, kScalar};
  static constexpr Entries results[] = {kScalar, kScalar};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T left = in.scalar(), conductance = in.scalar(), exchange = conductance * in.scalar();
    out.put(exchange);
    out.put(left - exchange / in.scalar());
  }
};

// Emissivity times area, σ, θ, ambient and reference: radiation linearised about θ, as coefficient and heat at θ = 0.
struct HeatRadiation {
  static constexpr const char* name = "heat_radiation";
  static constexpr Entries arguments[] = {kScalar, kScalar, kScalar, kScalar, kScalar};
  static constexpr Entries results[] = {kScalar, kScalar};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T emitting = in.scalar(), black = emitting * in.scalar();
    const T theta = in.scalar(), ambient = in.scalar();
    const HeatRadiationAt<T> radiation = heat_radiation(black, theta, ambient, in.scalar());
    out.put(radiation.coefficient);
    out.put(radiation.power);
  }
};

// Volume V: zero, and V 1, with which `scatter` sums V ∇N on the nodes.
struct SurfaceNormals {
  static constexpr const char* name = "surface_normals";
  static constexpr Entries arguments[] = {kScalar};
  static constexpr Entries results[] = {kVector, kMatrix};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T volume = in.scalar();
    out.put(zero_vector<T, D>());
    out.put(volume * identity<T, D>());
  }
};

// Length of a vector.
struct Length {
  static constexpr const char* name = "length";
  static constexpr Entries arguments[] = {kVector};
  static constexpr Entries results[] = {kScalar};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const Vector<T, D> v = in.vector();
    out.put(safe_root(dot(v, v)));
  }
};

// Position in the frame of a box around the origin, and its edge lengths: distance from its surface, negative inside,
// NaN where a coordinate is. Its derivatives differ from those of `Box.signed_distance` at ties and on the faces.
struct BoxDistance {
  static constexpr const char* name = "box_distance";
  static constexpr Entries arguments[] = {kVector, kVector};
  static constexpr Entries results[] = {kScalar};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const Vector<T, D> x = in.vector(), size = in.vector();
    out.put(box_distance(x, size));
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
