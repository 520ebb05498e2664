#pragma once

#include <cstdint>

#include "grid/geometry.h"

namespace mpm {

// The active blocks of one activation, and which particles lie in each.
template <class T, int D>
struct Topology {
  Geometry<T, D> geometry;
  int scenes = 1;
  int max_blocks = 0;  // slots of the pool of blocks
  int64_t particles = 0;
  const int* table = nullptr;     // [scenes * blocks_per_scene] slot of a block, -1 where inactive
  const int* block = nullptr;     // [max_blocks] table index of a slot, -1 where unused
  const int* offsets = nullptr;   // [max_blocks + 1] index[offsets[s], offsets[s + 1]) have their base node in slot s
  const int* index = nullptr;     // [P] particles grouped by block; those outside the grid come last
  const int* schedule = nullptr;  // order of work, specific to the backend
  int64_t schedule_size = 0;
};

// Cost of a particle out of its block, as a multiple of that of activating one, on CUDA.
constexpr int kOutOfBlockCost = 2;

// The same of a step with heat, which has more kernels. The cost of activating few particles is that of the latency of
// its kernels (measured with 10 thousand to 8 million).
MPM_HD int out_of_block_cost_with_heat(int64_t particles) {
  constexpr int64_t share = 4096, least = 16, most = 1024;
  const int64_t cost = particles / share;
  return int(cost < least ? least : cost > most ? most : cost);
}

// Counters of the displacement of particles since their activation, which on CUDA may serve several steps.
struct Displacement {
  int out_of_block;  // particles out of the block that they had then
  int lost;          // whether one touches, or may soon touch, a block that is not active: bits of Loss
  int earlier;       // particles out of their block, accumulated over the previous steps
  int requested;     // whether the activation two steps later is needed

  // kMissed: P2G of the same kernel has already missed a particle.
  enum Loss : int { kLost = 1, kMissed = 2 };

  // Particles out of their block cost more than others. A new activation follows once their accumulated cost is that of
  // an activation, that is, once `out_of_block_cost` times their count exceeds the number of particles. The total
  // cost is then at most twice the minimum.
  MPM_HD bool lasts(int64_t particles, int out_of_block_cost = kOutOfBlockCost) const {
    return lost == 0 && (int64_t(earlier) + out_of_block) * out_of_block_cost <= particles;
  }
  MPM_HD Displacement next(int64_t particles, int out_of_block_cost) const {
    return {0, 0, lasts(particles, out_of_block_cost) ? earlier + out_of_block : 0, 0};
  }
};

// Entries of the schedule tensor: room for the work items of both backends, with the number of particles of each cell,
// and an entry for each particle (the fake kernel in torch_mpm/ops/activation.py has the same formula).
template <int D>
int64_t schedule_size(int64_t max_blocks, int64_t particles) {
  return 16 + (8 + kBlockNodes<D> / 2) * (max_blocks + particles / 128) + particles;
}

}  // namespace mpm
