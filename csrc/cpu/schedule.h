#pragma once

#include "grid/topology.h"

// Work order of the CPU kernels, written by `activate` into the schedule tensor: base blocks (slots with particles)
// grouped by colour, so that the nodes in the supports of two base blocks of one colour are disjoint, and chunks of at
// most kChunk particles of one base block, with the order of each chunk's particles by cell.
namespace mpm::cpu {

constexpr int kChunk = 1024;
template <int D>
constexpr int kColours = 1 << D;

// Views into the schedule tensor; I is int or const int, S a 16-bit integer alike.
template <class I, class S>
struct Schedule {
  I* colour_start;  // [kColours + 1] into the lists of base blocks
  I* base_slot;     // [base blocks]
  I* base_chunk;    // [base blocks + 1] first chunk of a base block
  I* chunk_slot;    // [chunks]
  I* chunk_begin;   // [chunks] first particle of the chunk, as a position in the index tensor
  I* chunk_sorted;  // [chunks] 1 if the particles lie in memory one after another, in the order of cells
  S* cell_end;      // [chunks, kBlockNodes] particles of the chunk up to and including each cell
  S* order;         // [particles] entry i of a chunk: cell of its particle i * kChunk + which particle is i-th by cell
};
using ScheduleIn = Schedule<const int, const uint16_t>;
using ScheduleOut = Schedule<int, uint16_t>;

inline namespace TORCH_MPM_ISA {

// Fits into schedule_size() ints: there are at most `max_blocks` base blocks, and max_blocks + particles / kChunk
// chunks.
template <int D, class I, class S>
void lay_out(Schedule<I, S>& s, I* start, int64_t max_blocks, int64_t particles) {
  const int64_t base_blocks = max_blocks < particles ? max_blocks : particles,
                chunks = base_blocks + particles / kChunk;
  const auto take = [&](int64_t count) {
    I* p = start;
    start += count;
    return p;
  };
  s.colour_start = take(kColours<D> + 1);
  s.base_slot = take(base_blocks);
  s.base_chunk = take(base_blocks + 1);
  s.chunk_slot = take(chunks);
  s.chunk_begin = take(chunks);
  s.chunk_sorted = take(chunks);
  s.cell_end = reinterpret_cast<S*>(take(chunks * kBlockNodes<D> / 2));
  s.order = reinterpret_cast<S*>(start);
}

template <class T, int D>
ScheduleIn schedule_of(const Topology<T, D>& t) {
  ScheduleIn s;
  lay_out<D>(s, t.schedule, t.max_blocks, t.particles);
  return s;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
