#pragma once

#include "grid/topology.h"

// The schedule tensor of the CUDA kernels.
namespace mpm::cuda {

// Maximum number of particles of an item, all of one base block: a crowded block makes several items. Smaller where
// there are few particles, so that there are about two items for each of the 130 multiprocessors of a large device.
constexpr int kItemParticles = 576, kLeastItemParticles = 128;

// Particles of a batch, and of an item of a call with heat at most, for small thread blocks: in 2-D a base block mostly
// has 64 particles, four a cell, and then the number of thread blocks of a multiprocessor at once matters more than
// that of their threads.
template <int D>
constexpr int kSmallItemParticles = D == 2 ? 256 : kItemParticles;

MPM_HD int item_particles(int64_t particles) {
  const int64_t shared = particles / 256;
  return int(shared < kLeastItemParticles ? kLeastItemParticles : shared > kItemParticles ? kItemParticles : shared);
}

struct Item {
  int slot, begin, end;  // particles index[begin, end)
  int block;             // table index of the base block
};

// I is int or const int.
template <class I>
struct Schedule {
  I* item_count;
  I* scattered;   // whether neighbours in memory mostly lie in different blocks
  I* items;       // [room_for_items(), 4], each an Item
  I* neighbours;  // [max_blocks, 2^D] slots of a block and of the blocks after it, -1 where inactive; the bit of axis i
                  // is D - 1 - i
  I* base_slot;   // [P] slot of the base block of a particle, -1 if it is not transferred
};

// Upper bound of the number of items: base blocks hold particles, and splitting adds less than one item per
// item_particles().
MPM_HD int64_t most_items(int64_t max_blocks, int64_t particles) {
  return (max_blocks < particles ? max_blocks : particles) + particles / item_particles(particles);
}

// A bound without a division in each thread.
MPM_HD int64_t room_for_items(int64_t max_blocks, int64_t particles) {
  return (max_blocks < particles ? max_blocks : particles) + particles / kLeastItemParticles;
}

// Fits into schedule_size() ints.
template <int D, class I>
MPM_HD Schedule<I> lay_out_schedule(I* start, int64_t max_blocks, int64_t particles) {
  Schedule<I> s;
  s.item_count = start;
  s.scattered = start + 1;
  s.items = start + 4;
  s.neighbours = s.items + 4 * room_for_items(max_blocks, particles);
  s.base_slot = s.neighbours + (max_blocks << D);
  return s;
}

template <class T, int D>
MPM_HD Schedule<const int> schedule_of(const Topology<T, D>& t) {
  return lay_out_schedule<D>(t.schedule, t.max_blocks, t.particles);
}

}  // namespace mpm::cuda
