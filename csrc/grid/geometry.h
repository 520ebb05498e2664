#pragma once

#include <cmath>
#include <cstdint>

#include "common/bspline.h"

// The node lattice of one scene: node i of an axis lies at lower + (i - padding) dx. Blocks are 4 nodes wide.
namespace mpm {

constexpr int kPadding = 3;     // nodes below `lower`, so that a particle on the boundary has its whole support
constexpr int kBlockWidth = 4;  // nodes per block and axis
template <int D>
constexpr int kBlockNodes = D == 2 ? 16 : 64;

// dx and lower are stored as a leading part in T and its remainder, so that the distance from the base node is exact to
// rounding of the position itself, however far the node is from the corner.
template <class T, int D>
struct Geometry {
  T inverse_dx, dx, dx_remainder;
  T lower[D], lower_remainder[D];
  int blocks[D];         // blocks per axis of one scene
  int blocks_per_scene;  // their product

  static Geometry make(double dx, const double* lower, const int64_t* blocks) {
    Geometry g;
    g.dx = T(dx);
    g.dx_remainder = T(dx - double(g.dx));
    g.inverse_dx = T(1 / dx);
    g.blocks_per_scene = 1;
    for (int i = 0; i < D; i++) {
      g.lower[i] = T(lower[i]);
      g.lower_remainder[i] = T(lower[i] - double(g.lower[i]));
      g.blocks[i] = int(blocks[i]);
      g.blocks_per_scene *= int(blocks[i]);
    }
    return g;
  }
};

inline namespace TORCH_MPM_ISA {

template <int D, class T>
MPM_HD bool is_finite(const T x[D]) {
  bool finite = true;
  MPM_UNROLL for (int i = 0; i < D; i++)
    finite = finite && x[i] - x[i] == T(0);
  return finite;
}

// Index of the base node along an axis, not yet rounded to an integer type: it may lie outside the lattice or be NaN.
// S is T or a pack of T.
template <int Order, class S, class T, int D>
MPM_HD S base_node(const Geometry<T, D>& g, int axis, const S& x) {
  using std::floor;
  return floor((x - S(g.lower[axis])) * S(g.inverse_dx) + S(T(kPadding - BSpline<Order>::base_offset)));
}

template <int Order, class S, class T, int D>
MPM_HD auto on_lattice(const Geometry<T, D>& g, int axis, const S& base) {
  return (base >= S(T(0))) & (base < S(T(g.blocks[axis] * kBlockWidth - Order)));  // false for NaN
}

// Distance of x from a node along an axis, in cells.
template <class S, class T, int D>
MPM_HD S distance_in_cells(const Geometry<T, D>& g, int axis, const S& x, const S& node) {
  using std::fma;
  const S k = node - S(T(kPadding));
  return ((fma(S(T(0)) - k, S(g.dx), x) - S(g.lower[axis])) - fma(k, S(g.dx_remainder), S(g.lower_remainder[axis]))) *
         S(g.inverse_dx);
}

// Base node and distance from it in cells. False for a particle that is not finite or whose support leaves the lattice.
template <int Order, class T, int D>
MPM_HD bool locate(const Geometry<T, D>& g, const T x[D], int base[D], T f[D]) {
  bool inside = true;
  MPM_UNROLL for (int i = 0; i < D; i++) {  // no early return: each coordinate would wait for the previous one
    const T node = base_node<Order>(g, i, x[i]);
    const bool on = on_lattice<Order>(g, i, node);
    inside = inside && on;
    base[i] = on ? int(node) : 0;
    f[i] = distance_in_cells(g, i, x[i], node);
  }
  return inside;
}

template <class T, int D>
MPM_HD int block_index(const Geometry<T, D>& g, int scene, const int block[D]) {
  int r = scene;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r = r * g.blocks[i] + block[i];
  return r;
}

// Scene and block coordinates of an entry of the block table.
template <class T, int D>
MPM_HD int block_coordinates(const Geometry<T, D>& g, int index, int block[D]) {
  MPM_UNROLL for (int i = D - 1; i >= 0; i--) {
    block[i] = index % g.blocks[i];
    index /= g.blocks[i];
  }
  return index;
}

// Blocks of one colour, 2^D of them, are two blocks apart, so that particles of different blocks share no node.
template <class T, int D>
MPM_HD int block_colour(const Geometry<T, D>& g, int index) {
  int block[D], colour = 0;
  block_coordinates(g, index, block);
  MPM_UNROLL for (int i = 0; i < D; i++)
    colour = colour * 2 + (block[i] & 1);
  return colour;
}

// Position of a node inside its block, z fastest.
template <int D>
MPM_HD int node_in_block(const int node[D]) {
  int r = 0;
  MPM_UNROLL for (int i = 0; i < D; i++)
    r = r * kBlockWidth + (node[i] & (kBlockWidth - 1));
  return r;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
