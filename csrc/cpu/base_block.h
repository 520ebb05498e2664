#pragma once

#include "cpu/parallel.h"
#include "cpu/schedule.h"

// Base blocks, which hold the base nodes of particles, and the loop over them.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// A slot with particles, and the slots of the blocks in their support: o as in activate.cpu.cpp.
template <class T, int D>
struct BaseBlock {
  int scene;
  int corner[D];  // first node of the block
  int slot[kColours<D>];

  BaseBlock(const Topology<T, D>& t, int own) {
    int block[D];
    scene = block_coordinates(t.geometry, t.block[own], block);
    for (int i = 0; i < D; i++) corner[i] = block[i] * kBlockWidth;
    for (int o = 0; o < kColours<D>; o++) {
      int other[D];
      bool inside = true;
      for (int i = 0; i < D; i++) {
        other[i] = block[i] + (o >> (D - 1 - i) & 1);
        inside = inside && other[i] < t.geometry.blocks[i];
      }
      slot[o] = inside ? t.table[block_index(t.geometry, scene, other)] : -1;
    }
  }
};

// Position of a cell in its block along an axis.
template <int D>
MPM_HD int cell_coordinate(int cell, int axis) {
  return cell >> 2 * (D - 1 - axis) & (kBlockWidth - 1);
}

// Calls f(next) once per thread, where next() returns the base blocks of a schedule colour by colour.
template <int D, class F>
void parallel_base_blocks(const ScheduleIn& s, int64_t particles, const F& f) {
  constexpr int64_t kBlocks = 4, kParticles = 2048;  // number of particles that justifies a thread
  const int64_t base_blocks = s.colour_start[kColours<D>];
  const int64_t by_blocks = (base_blocks + kBlocks - 1) / kBlocks,
                by_particles = (particles + kParticles - 1) / kParticles;
  parallel_phases<kColours<D>>(s.colour_start, by_blocks < by_particles ? by_blocks : by_particles, f);
}

// Calls f(particle) for the particles that are not transferred.
template <class T, int D, class F>
void for_outside(const Topology<T, D>& t, const F& f) {
  for (int64_t i = t.offsets[t.max_blocks]; i < t.particles; i++) f(int64_t(t.index[i]));
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
