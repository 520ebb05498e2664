#pragma once

#include <cmath>

#include "grid/grid_update.h"
#include "grid/topology.op.h"

// The walls of the domain as arguments of ops.
namespace mpm {

#define MPM_WALLS_SCHEMA "int[] wall_kind, float[] wall_plane, float[] wall_friction"
#define MPM_WALLS_PARAMETERS \
  std::vector<int64_t> wall_kind, std::vector<double> wall_plane, std::vector<double> wall_friction

template <class T, int D>
Walls<T, D> walls(const std::vector<int64_t>& kind, const std::vector<double>& plane,
                  const std::vector<double>& friction, const PackedLattice& lattice) {
  STD_TORCH_CHECK(kind.empty() || kind.size() == 2 * D, "wall_kind must be empty or have ", 2 * D,
                  " entries, two per axis, got ", kind.size());
  STD_TORCH_CHECK(plane.size() == kind.size(), "wall_plane must have an entry per wall_kind, ", kind.size(), ", got ",
                  plane.size());
  STD_TORCH_CHECK(friction.size() == kind.size(), "wall_friction must have an entry per wall_kind, ", kind.size(),
                  ", got ", friction.size());
  Walls<T, D> w;
  for (int face = 0; face < 2 * D; face++) {
    const int64_t k = kind.empty() ? int64_t(Contact::open) : kind[face];
    STD_TORCH_CHECK(k >= int64_t(Contact::open) && k <= int64_t(Contact::mirror), "wall_kind must be 0 to 4, got ", k);
    const bool open = k == int64_t(Contact::open);
    STD_TORCH_CHECK(open || std::isfinite(plane[face]), "wall_plane must be finite, got ", plane[face]);
    STD_TORCH_CHECK(open || (friction[face] >= 0 && std::isfinite(friction[face])),
                    "wall_friction must be finite and not negative, got ", friction[face]);
    w.set(face, Contact(k), open ? 0 : friction[face], open ? 0 : plane[face], lattice.dx(), lattice.lower()[face / 2]);
  }
  return w;
}

// The mirrors alone, all other faces open.
template <class T, int D>
Walls<T, D> mirrors(Walls<T, D> w) {
  for (int face = 0; face < 2 * D; face++) w.node[face] = face % 2 ? INT_MAX : INT_MIN;
  return w;
}

}  // namespace mpm
