#pragma once

#include "cpu/parallel.h"
#include "grid/activate.h"

namespace mpm::cpu {

// Entries of the block table that one bit stands for.
constexpr int64_t kTile = 256;

struct ActivateWorkspace {
  int slices;        // parts of the particles, each counted apart
  uint64_t* marked;  // [words] a bit for each tile with active blocks; zero between activations
  int64_t words;
  int* key;  // [particles] table index of the base block, -1 where not transferred; later, of the first particle of a
             // run, the slot of that block
  int* run;  // [particles] first particle of each run of one base block, from the first particle of each slice on
  uint8_t* cell;     // [particles] cell of the base node in its block
  uint8_t* cell_at;  // [particles] the same by position in the index tensor
  int* count;        // [slices, max_blocks] particles of each slot, then where the next one goes
  int64_t* totals;   // [slices, kTotals]
  int64_t size;      // in bytes
  enum { kParticles, kDropped, kRuns, kTotals };
};

inline namespace TORCH_MPM_ISA {

template <class T, int D>
ActivateWorkspace activate_layout(const ActivateArguments<T, D>& a, char* start) {
  const int64_t table = int64_t(a.scenes) * a.geometry.blocks_per_scene;
  // A slice costs a counter per slot, so the number of slices is limited by the number of particles.
  const int64_t slots = a.max_blocks < table ? a.max_blocks : table;
  const int64_t worth = 1 + 4 * a.particles / (slots + 1), threads = thread_count();
  ActivateWorkspace w;
  w.slices = int(worth < threads ? worth : threads);
  int64_t used = 0;
  const auto take = [&](int64_t bytes) {
    char* p = start + used;
    used += (bytes + 63) / 64 * 64;
    return p;
  };
  w.totals = reinterpret_cast<int64_t*>(take(int64_t(sizeof(int64_t)) * w.slices * ActivateWorkspace::kTotals));
  w.words = (table + 64 * kTile - 1) / (64 * kTile);
  w.marked = reinterpret_cast<uint64_t*>(take(int64_t(sizeof(uint64_t)) * w.words));
  w.key = reinterpret_cast<int*>(take(int64_t(sizeof(int)) * a.particles));
  w.run = reinterpret_cast<int*>(take(int64_t(sizeof(int)) * a.particles));
  w.count = reinterpret_cast<int*>(take(int64_t(sizeof(int)) * w.slices * a.max_blocks));
  w.cell = reinterpret_cast<uint8_t*>(take(a.particles));
  w.cell_at = reinterpret_cast<uint8_t*>(take(a.particles));
  w.size = used;
  return w;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
