#pragma once

#include "laws/law.h"
#include "transfer/arguments.h"

// Laws and P2G of a substep in one pass over the particles, on the CPU: what laws read of a chunk of particles is
// copied row by row in the order of its cells, the stress is computed there, and what the particles give to the nodes
// is summed up. On the way particles may change places in memory, so that they lie in the order of their cells.
namespace mpm {

// A component of a field of the particles.
template <class T>
struct ParticleRow {
  const T* from = nullptr;
  int64_t stride = 0;
  T* to = nullptr;  // with stride 1; null where it stays
  int row = -1;     // of the copy; -1 where laws do not read it
};

constexpr int kCopyLine = 1024 + 16;  // of a row: kChunk, and room for a whole register at the end; no power of two

// The rows of the copy of a chunk; after these the history of all laws, and parameters that particles have.
template <int D>
struct ChunkRows {
  static constexpr int stress = 0, F = stress + D * D, J = F + D * D, C = J + 1, rest = C + D * D;
};

// Of int.
enum ChunkNumbers : int { kOriginRow, kSceneRow, kMaterialRow, kNumberRows };

template <class T, int D>
struct ChunkLaw {
  void (*update)(const LawUpdateArguments<T, D>&, void* stream) = nullptr;
  LawUpdateArguments<T, D> arguments;  // of which the parameters that particles share are used
  bool gradient = false, viscous = false, plastic = false;
  int material = 0;
  int history[kMostHistory], parameters[kMostParameters];  // their rows, -1 where there are none
  bool matrix[kMostHistory] = {};
};

// Of all particles, after a P2G.
struct Whereabouts {
  float slack;  // cells that every particle can go, on each axis, while the activation still serves it
  int strays;   // particles in other blocks than they were in when they were activated
};

template <class T, int D>
struct LawsP2GArguments {
  P2GArguments<T, D> p2g;                // its stress is not used
  const ParticleRow<T>* rows = nullptr;  // what laws read, or what is written
  int row_count = 0;
  const T* const* expected = nullptr;  // rows of stride 1 that are read
  int expected_count = 0;
  const ParticleRow<int>* numbers = nullptr;  // origin, scene and material, those that there are
  int number_count = 0;
  bool has_material = false, has_C = false;
  const ChunkLaw<T, D>* laws = nullptr;
  int law_count = 0, material_count = 0;
  // Whether particle i of the index goes to place i; index and schedule are written anew then.
  bool rearranges = false;
  int *index = nullptr, *schedule = nullptr;
  T* copies = nullptr;  // [threads, copy_size]
  int64_t copy_size = 0;
  Whereabouts* whereabouts = nullptr;  // gets the least slack and the sum of strays, where an activation may last
};

// Rows of one length, from[order[i]] to to[i].
template <class T, int D>
struct PermuteArguments {
  const ParticleRow<T>* rows = nullptr;
  int row_count = 0;
  int64_t particles = 0;
  const int* origin = nullptr;  // [P] i of each place in `from`
  int* place = nullptr;         // [P] the inverse, written first
};

}  // namespace mpm
