#pragma once

#include "common/bspline.h"
#include "common/host_device.h"

// Contribution of one particle to the heat operator H_ij = Σ_p κ_p V_p ∇Φ_i · ∇Φ_j with ∇Φ_i = D⁻¹ N_i (x_i − x_p) (Gao
// et al. 2018, supplement, equation 8), on the (Order + 1)^D nodes of its support, one axis after another (sum
// factorisation). Distances are in cells. P is a scalar or a pack of particles of one cell.
//
// Σ_i N_i = 1 and Σ_i N_i (x_i − x_p) = 0 along each axis, so that the product with H needs only one node value and
// differences of neighbours, which a cell computes once for all of its particles: a fourth of the arithmetic is saved,
// a constant u has no gradient at all, and contributions to a node of small weight keep their relative accuracy.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <int Order, int D>
constexpr int kSupportNodes = D == 2 ? (Order + 1) * (Order + 1) : (Order + 1) * (Order + 1) * (Order + 1);
constexpr int kMiddle = 1;  // node of an axis whose value is not differenced

// f(first, stride) for the lines of nodes of a support along each axis.
template <int Order, int D, class F>
MPM_HD void for_lines(const F& f) {
  constexpr int S = Order + 1, lines = kSupportNodes<Order, D> / S;
  MPM_UNROLL for (int axis = 0, stride = 1; axis < D; axis++, stride *= S) MPM_UNROLL
    for (int line = 0; line < lines; line++) f(line / stride * stride * S + line % stride, stride);
}

// Node values to differences along each axis, away from the middle node.
template <int Order, int D, class T>
MPM_HD void to_differences(T* u) {
  for_lines<Order, D>([&](int first, int stride) {
    MPM_UNROLL for (int k = Order; k > kMiddle; k--)
      u[first + k * stride] -= u[first + (k - 1) * stride];
    u[first] -= u[first + kMiddle * stride];
  });
}
// The transpose: sums for differences to sums for nodes.
template <int Order, int D, class T>
MPM_HD void to_nodes(T* sum) {
  for_lines<Order, D>([&](int first, int stride) {
    sum[first + kMiddle * stride] -= sum[first];
    MPM_UNROLL for (int k = kMiddle; k < Order; k++)
      sum[first + k * stride] -= sum[first + (k + 1) * stride];
  });
}

// N and N (i − x) along each axis.
template <int Order, class P, int D>
struct CellWeights {
  static constexpr int S = Order + 1;
  P weight[D][S], moment[D][S];

  MPM_HD explicit CellWeights(const P f[D]) {
    MPM_UNROLL for (int a = 0; a < D; a++) {
      BSpline<Order>::weights(f[a], weight[a]);
      MPM_UNROLL for (int k = 0; k < S; k++)
        moment[a][k] = k == 0 ? -(weight[a][k] * f[a]) : weight[a][k] * (P(k) - f[a]);
    }
  }
  // Times those of the nodes at an offset of -1, 0 or 1 along each axis; zero where they are not in the support.
  MPM_HD CellWeights times_neighbour(const int e[D]) const {
    CellWeights s = *this;
    MPM_UNROLL for (int a = 0; a < D; a++) MPM_UNROLL
      for (int k = 0; k < S; k++) {
        const int n = k + e[a], inside = n >= 0 && n < S;
        s.weight[a][k] = inside ? weight[a][k] * weight[a][n] : P(0);
        s.moment[a][k] = inside ? moment[a][k] * moment[a][n] : P(0);
      }
    return s;
  }
};

// Factors of the differences; those of the middle node, 1 and 0, are not stored.
template <int Order, class P, int D>
struct DifferenceWeights : CellWeights<Order, P, D> {
  using CellWeights<Order, P, D>::weight, CellWeights<Order, P, D>::moment;

  MPM_HD explicit DifferenceWeights(const P f[D]) : CellWeights<Order, P, D>(f) {
    MPM_UNROLL for (int a = 0; a < D; a++) MPM_UNROLL
      for (int k = Order - 1; k > kMiddle; k--) {
        weight[a][k] += weight[a][k + 1];
        moment[a][k] += moment[a][k + 1];
      }
  }
  MPM_HD P interpolate(int axis, const P* u) const {
    P sum = u[kMiddle];
    MPM_UNROLL for (int k = 0; k <= Order; k++)
      if (k != kMiddle) sum += weight[axis][k] * u[k];
    return sum;
  }
  MPM_HD P slope(int axis, const P* u) const {
    P sum = moment[axis][0] * u[0];
    MPM_UNROLL for (int k = kMiddle + 1; k <= Order; k++)
      sum += moment[axis][k] * u[k];
    return sum;
  }
  MPM_HD P weigh(int axis, int k, const P& value) const { return k == kMiddle ? value : weight[axis][k] * value; }
};

// H_{i, i+e} is stored for the node itself and for half of its neighbours, those after it in the order of nodes.
template <int D>
constexpr int kPairs = D == 2 ? 5 : 14;
template <int D>
MPM_HD void pair_offset(int pair, int e[D]) {
  int digits = pair + kPairs<D> - 1;
  MPM_UNROLL for (int a = D - 1; a >= 0; a--) {
    e[a] = digits % 3 - 1;
    digits /= 3;
  }
}

// κ V times (D⁻¹ dx)², so that the gradients below, in cells, give H.
template <int Order, class P, class T>
MPM_HD P scaled_conductance(const P& conductance, const T& inverse_dx) {
  const T scale = T(BSpline<Order>::inverse_inertia) * inverse_dx;
  return conductance * P(scale * scale);
}

// Σ_i N_i (x_i − x_p) u_i of differences u, the last axis fastest.
template <int Order, class P, int D, class U>
MPM_HD void cell_gradient(const DifferenceWeights<Order, P, D>& s, const U* u, P gradient[D]) {
  constexpr int S = Order + 1, X = D - 3, Y = D - 2, Z = D - 1, planes = D == 3 ? S : 1;
  P value[planes], y[planes], z[planes];
  MPM_UNROLL for (int i = 0; i < planes; i++) {
    P line[S], slope[S];
    MPM_UNROLL for (int j = 0; j < S; j++) {
      P nodes[S];
      MPM_UNROLL for (int k = 0; k < S; k++)
        nodes[k] = P(u[(i * S + j) * S + k]);
      line[j] = s.interpolate(Z, nodes);
      slope[j] = s.slope(Z, nodes);
    }
    value[i] = s.interpolate(Y, line);
    y[i] = s.slope(Y, line);
    z[i] = s.interpolate(Y, slope);
  }
  if constexpr (D == 3) {
    gradient[X] = s.slope(X, value);
    gradient[Y] = s.interpolate(X, y);
    gradient[Z] = s.interpolate(X, z);
  } else {
    gradient[Y] = y[0];
    gradient[Z] = z[0];
  }
}

// The transpose of `cell_gradient`: adds N_i (x_i − x_p) · flux to the sums for the differences.
template <int Order, class P, int D>
MPM_HD void add_cell_divergence(const DifferenceWeights<Order, P, D>& s, const P flux[D], P* sum) {
  constexpr int S = Order + 1, X = D - 3, Y = D - 2, Z = D - 1;
  MPM_UNROLL for (int i = 0; i < (D == 3 ? S : 1); i++) {
    const bool across_x = D == 3 && i != kMiddle;
    P x(0), y = flux[Y], z = flux[Z];
    if constexpr (D == 3) {
      if (across_x) x = s.moment[X][i] * flux[X];
      y = s.weigh(X, i, y);
      z = s.weigh(X, i, z);
    }
    MPM_UNROLL for (int j = 0; j < S; j++) {
      const bool across_y = j != kMiddle;
      P line(0);
      if (across_x) line = s.weigh(Y, j, x);
      if (across_y) line = across_x ? line + s.moment[Y][j] * y : s.moment[Y][j] * y;
      const P slope = s.weigh(Y, j, z);
      MPM_UNROLL for (int k = 0; k < S; k++) {
        P& n = sum[(i * S + j) * S + k];
        if (across_x || across_y) n += s.weigh(Z, k, line);
        if (k != kMiddle) n += s.moment[Z][k] * slope;
      }
    }
  }
}

// node_i += value N_i (x_i − x_p) · N_j (x_j − x_p), of the products of the weights of i and j.
template <int Order, class P, int D>
MPM_HD void add_cell_products(const CellWeights<Order, P, D>& s, const P& value, P* node) {
  constexpr int S = Order + 1, X = D - 3, Y = D - 2, Z = D - 1;
  MPM_UNROLL for (int i = 0; i < (D == 3 ? S : 1); i++) {
    P x(0), plane = value;
    if constexpr (D == 3) {
      x = s.moment[X][i] * value;
      plane = s.weight[X][i] * value;
    }
    MPM_UNROLL for (int j = 0; j < S; j++) {
      P line = s.moment[Y][j] * plane;
      if constexpr (D == 3) line += s.weight[Y][j] * x;
      const P slope = s.weight[Y][j] * plane;
      MPM_UNROLL for (int k = 0; k < S; k++) {
        P& n = node[(i * S + j) * S + k];
        n += s.weight[Z][k] * line;
        n += s.moment[Z][k] * slope;
      }
    }
  }
}

// node_i += N_i value.
template <int Order, class P, int D>
MPM_HD void add_cell_value(const CellWeights<Order, P, D>& s, const P& value, P* node) {
  constexpr int S = Order + 1, X = D - 3, Y = D - 2, Z = D - 1;
  MPM_UNROLL for (int i = 0; i < (D == 3 ? S : 1); i++) {
    P plane = value;
    if constexpr (D == 3) plane = s.weight[X][i] * plane;
    MPM_UNROLL for (int j = 0; j < S; j++) {
      const P line = s.weight[Y][j] * plane;
      MPM_UNROLL for (int k = 0; k < S; k++)
        node[(i * S + j) * S + k] += s.weight[Z][k] * line;
    }
  }
}

// Sums over particles: H u, the diagonal of H, H_{i, i+e}, or K_i = D⁻¹ Σ_p κ_p V_p N_i, for which u · H u ≤ Σ K_i u_i²
// (Cauchy-Schwarz with Σ_i N_i (x_i − x_p)(x_i − x_p)ᵀ = D).
enum class HeatSum { product, diagonal, pair, bound };

// Share of one particle in a sum; returns κ V |∇u|² for the product, where u and `sum` are those of differences. The
// offset e is for pairs.
template <HeatSum Sum, int Order, class P, int D, class U>
MPM_HD P add_particle(const P f[D], const P& conductance, const U* u, P* sum, const int* e = nullptr) {
  P power(0);
  if constexpr (Sum == HeatSum::product) {
    const DifferenceWeights<Order, P, D> s(f);
    P flux[D];
    cell_gradient(s, u, flux);
    MPM_UNROLL for (int a = 0; a < D; a++) {
      const P g = flux[a];
      flux[a] = conductance * g;
      power += flux[a] * g;
    }
    add_cell_divergence(s, flux, sum);
  } else {
    const CellWeights<Order, P, D> s(f);
    constexpr int same[D] = {};
    if constexpr (Sum == HeatSum::bound)
      add_cell_value(s, conductance * P(1 / BSpline<Order>::inverse_inertia), sum);
    else
      add_cell_products(s.times_neighbour(Sum == HeatSum::diagonal ? same : e), conductance, sum);
  }
  return power;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
