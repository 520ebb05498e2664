#pragma once

#include "grid/geometry.h"
#include "transfer/arguments.h"

// The order of work of the CPU kernels, which `activate` writes into the schedule tensor:
// homes (slots that hold particles) grouped by colour, so that the nodes touched from two homes of one colour never
// overlap, and chunks of at most kChunk particles of one home, with the order of each chunk's particles by cell.
namespace mpm::cpu {

constexpr int kChunk = 512;
template <int D>
constexpr int kColours = 1 << D;

template <class I>
struct Schedule {
  I* colour_start;  // [kColours + 1] into the lists of homes
  I* home_slot;     // [homes]
  I* home_chunk;    // [homes + 1] first chunk of a home
  I* chunk_slot;    // [chunks]
  I* chunk_begin;   // [chunks] first particle of the chunk, as a position in the index tensor
  I* chunk_sorted;  // [chunks] 1 if the particles are in the order of cells already
  I* cell_end;      // [chunks, kBlockNodes] particles of the chunk up to and including each cell
  I* rank;          // [particles] place of a particle in its chunk when sorted by cell, two to an int
  int64_t size;     // in ints
};

inline namespace TORCH_MPM_ISA {

template <int D, class I>
Schedule<I> schedule_layout(I* start, int64_t capacity, int64_t particles) {
  const int64_t homes = capacity < particles ? capacity : particles, chunks = homes + particles / kChunk;
  int64_t used = 0;
  const auto take = [&](int64_t count) {
    I* p = start + used;
    used += count;
    return p;
  };
  Schedule<I> s;
  s.colour_start = take(kColours<D> + 1);
  s.home_slot = take(homes);
  s.home_chunk = take(homes + 1);
  s.chunk_slot = take(chunks);
  s.chunk_begin = take(chunks);
  s.chunk_sorted = take(chunks);
  s.cell_end = take(chunks * kBlockNodes<D>);
  s.rank = take((particles + 1) / 2);
  s.size = used;
  return s;
}

template <class T, int D>
Schedule<const int> schedule_of(const Topology<T, D>& t) {
  return schedule_layout<D>(t.schedule, t.capacity, t.particles);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
