#pragma once

#include "math/bspline.h"
#include "math/host_device.h"

// What one particle adds to the heat operator H_ij = Σ_p κ_p V_p ∇Φ_i · ∇Φ_j with ∇Φ_i = D⁻¹ N_i (x_i − x_p) (Gao et
// al. 2018, supplement, equation 8), on the (Order + 1)^D nodes of its support, one axis after another (sum
// factorisation). Distances are in cells. P is a scalar or a pack of particles of one cell.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <int Order, int D>
constexpr int kSupportNodes = D == 2 ? (Order + 1) * (Order + 1) : (Order + 1) * (Order + 1) * (Order + 1);

// N and N (i − x) along each axis.
template <int Order, class P, int D>
struct CellWeights {
  static constexpr int S = Order + 1;
  P weight[D][S], moment[D][S];

  MPM_HD explicit CellWeights(const P f[D]) {
    MPM_UNROLL
    for (int a = 0; a < D; a++) {
      BSpline<Order>::weights(f[a], weight[a]);
      MPM_UNROLL
      for (int k = 0; k < S; k++) moment[a][k] = weight[a][k] * (P(k) - f[a]);
    }
  }
  // Times those of the nodes at an offset of -1, 0 or 1 along each axis; zero where they are not in the support.
  MPM_HD CellWeights times_neighbour(const int e[D]) const {
    CellWeights s = *this;
    MPM_UNROLL
    for (int a = 0; a < D; a++)
      MPM_UNROLL
      for (int k = 0; k < S; k++) {
        const int n = k + e[a], inside = n >= 0 && n < S;
        s.weight[a][k] = inside ? weight[a][k] * weight[a][n] : P(0);
        s.moment[a][k] = inside ? moment[a][k] * moment[a][n] : P(0);
      }
    return s;
  }
};

// H_{i, i+e} is kept for the node itself and for half of its neighbours, those after it in the order of nodes.
template <int D>
constexpr int kPairs = D == 2 ? 5 : 14;
template <int D>
MPM_HD void pair_offset(int pair, int e[D]) {
  int digits = pair + kPairs<D> - 1;
  MPM_UNROLL
  for (int a = D - 1; a >= 0; a--) {
    e[a] = digits % 3 - 1;
    digits /= 3;
  }
}

// κ V times (D⁻¹ dx)², so that the gradients below, in cells, make H.
template <int Order, class P, class T>
MPM_HD P scaled_conductance(const P& conductance, const T& inverse_dx) {
  const T scale = T(BSpline<Order>::inverse_inertia) * inverse_dx;
  return conductance * P(scale * scale);
}

// Σ_i N_i (x_i − x_p) u_i of node values u, the last axis fastest.
template <int Order, class P, int D, class U>
MPM_HD void cell_gradient(const CellWeights<Order, P, D>& s, const U* u, P gradient[D]) {
  constexpr int S = Order + 1, X = D - 3, Y = D - 2, Z = D - 1;
  MPM_UNROLL
  for (int a = 0; a < D; a++) gradient[a] = P(0);
  MPM_UNROLL
  for (int i = 0; i < (D == 3 ? S : 1); i++) {
    P value = P(0), y = P(0), z = P(0);
    MPM_UNROLL
    for (int j = 0; j < S; j++) {
      P line = P(0), moment = P(0);
      MPM_UNROLL
      for (int k = 0; k < S; k++) {
        const P node(u[(i * S + j) * S + k]);
        line += s.weight[Z][k] * node;
        moment += s.moment[Z][k] * node;
      }
      value += s.weight[Y][j] * line;
      y += s.moment[Y][j] * line;
      z += s.weight[Y][j] * moment;
    }
    if constexpr (D == 3) {
      gradient[X] += s.moment[X][i] * value;
      gradient[Y] += s.weight[X][i] * y;
      gradient[Z] += s.weight[X][i] * z;
    } else {
      gradient[Y] = y;
      gradient[Z] = z;
    }
  }
}

// node_i += N_i (x_i − x_p) · flux: the transpose of `cell_gradient`.
template <int Order, class P, int D>
MPM_HD void add_cell_divergence(const CellWeights<Order, P, D>& s, const P flux[D], P* node) {
  constexpr int S = Order + 1, X = D - 3, Y = D - 2, Z = D - 1;
  MPM_UNROLL
  for (int i = 0; i < (D == 3 ? S : 1); i++) {
    P x = P(0), y = flux[Y], z = flux[Z];
    if constexpr (D == 3) {
      x = s.moment[X][i] * flux[X];
      y = s.weight[X][i] * y;
      z = s.weight[X][i] * z;
    }
    MPM_UNROLL
    for (int j = 0; j < S; j++) {
      P along = s.moment[Y][j] * y;
      if constexpr (D == 3) along += s.weight[Y][j] * x;
      const P across = s.weight[Y][j] * z;
      MPM_UNROLL
      for (int k = 0; k < S; k++) {
        P& n = node[(i * S + j) * S + k];
        n += s.weight[Z][k] * along;
        n += s.moment[Z][k] * across;
      }
    }
  }
}

// node_i += N_i value.
template <int Order, class P, int D>
MPM_HD void add_cell_value(const CellWeights<Order, P, D>& s, const P& value, P* node) {
  constexpr int S = Order + 1, X = D - 3, Y = D - 2, Z = D - 1;
  MPM_UNROLL
  for (int i = 0; i < (D == 3 ? S : 1); i++) {
    P plane = value;
    if constexpr (D == 3) plane = s.weight[X][i] * plane;
    MPM_UNROLL
    for (int j = 0; j < S; j++) {
      const P line = s.weight[Y][j] * plane;
      MPM_UNROLL
      for (int k = 0; k < S; k++) node[(i * S + j) * S + k] += s.weight[Z][k] * line;
    }
  }
}

// What is summed over particles: H u, the diagonal of H, H_{i, i+e}, or K_i = D⁻¹ Σ_p κ_p V_p N_i, for which u · H u ≤ Σ K_i u_i²
// (Cauchy-Schwarz with Σ_i N_i (x_i − x_p)(x_i − x_p)ᵀ = D).
enum class HeatSum { product, diagonal, pair, bound };

// One particle's share of a sum; returns κ V |∇u|² for the product. The offset e is for pairs.
template <HeatSum Sum, int Order, class P, int D, class U>
MPM_HD P add_particle(const P f[D], const P& conductance, const U* u, P* node, const int* e = nullptr) {
  const CellWeights<Order, P, D> s(f);
  P flux[D], power = P(0);
  if constexpr (Sum == HeatSum::product) {
    cell_gradient(s, u, flux);
    MPM_UNROLL
    for (int a = 0; a < D; a++) {
      const P g = flux[a];
      flux[a] = conductance * g;
      power += flux[a] * g;
    }
    add_cell_divergence(s, flux, node);
  } else if constexpr (Sum == HeatSum::diagonal || Sum == HeatSum::pair) {
    constexpr int same[D] = {};
    MPM_UNROLL
    for (int a = 0; a < D; a++) flux[a] = conductance;
    add_cell_divergence(s.times_neighbour(Sum == HeatSum::diagonal ? same : e), flux, node);
  } else {
    add_cell_value(s, conductance * P(1 / BSpline<Order>::inverse_inertia), node);
  }
  return power;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
