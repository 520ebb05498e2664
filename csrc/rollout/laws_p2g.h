#pragma once

#include "rollout/thermal_laws.h"
#include "transfer/arguments.h"

// Laws and P2G of a substep in one pass over the particles, on the CPU. The rows that laws read of a chunk of particles
// are copied in the order of its cells, the stress is computed on the copy, and the contributions to the nodes are
// added. In the same pass the particles may be reordered in memory by cell.
namespace mpm {

// A component of a field of the particles.
template <class T>
struct ParticleRow {
  const T* from = nullptr;
  int64_t stride = 0;
  T* to = nullptr;  // with stride 1; null if it is not written
  int row = -1;     // of the copy; -1 if laws do not read it
};

constexpr int kCopyLine =
    1024 + 16;  // length of a row: kChunk, and room for a whole register at the end; no power of two

// The rows of the copy of a chunk, followed by the history of all laws and the parameters per particle.
template <int D>
struct ChunkRows {
  static constexpr int stress = 0, F = stress + D * D, J = F + D * D, C = J + 1, rest = C + D * D;
};

// Rows of integers.
enum ChunkNumbers : int { kOriginRow, kSceneRow, kMaterialRow, kNumberRows };

// What a law reads of the temperature; the expansion of the material stands with its first law.
template <class T>
struct LawTemperature {
  TemperatureTable<T> parameters[kMostParameters], expansion, coherency;
};

template <class T, int D>
struct ChunkLaw {
  void (*update)(const LawUpdateArguments<T, D>&, void* stream) = nullptr;
  LawUpdateArguments<T, D> arguments;  // only the parameters shared by all particles are used
  bool gradient = false, viscous = false, plastic = false;
  int material = 0;
  int history[kMostHistory], parameters[kMostParameters];  // their rows, -1 for none
  bool matrix[kMostHistory] = {};
  LawTemperature<T> temperature;
  bool melts = false;  // the liquid of a material whose solid is the law before
};

// Displacement of all particles, after a P2G.
struct Whereabouts {
  float displacement_budget;  // displacement budget: cells that every particle can move on each axis within the
                              // activation
  int out_of_block;           // particles out of the block of their activation
};

template <class T, int D>
struct LawsP2GArguments {
  P2GArguments<T, D> p2g;                // without its stress
  const ParticleRow<T>* rows = nullptr;  // rows that laws read, or that are written
  int row_count = 0;
  const T* const* prefetched = nullptr;  // rows of stride 1 to prefetch
  int prefetched_count = 0;
  const ParticleRow<int>* numbers = nullptr;  // origin, scene and material, if present
  int number_count = 0;
  bool has_material = false, has_C = false;
  const ChunkLaw<T, D>* laws = nullptr;
  int law_count = 0, material_count = 0;
  // Whether particle i of the index is written to place i; index and schedule are then rewritten.
  bool rearranges = false;
  int *index = nullptr, *schedule = nullptr;
  // Rows that laws of temperature need: temperature, liquid fraction, F and J without expansion, stress of the liquid.
  int temperature_row = -1, fraction_row = -1, elastic_row = -1, liquid_row = -1;
  int dissipated_row = -1;  // energy that laws dissipate, where it is wanted
  T* copies = nullptr;      // [threads, copy_size]
  int64_t copy_size = 0;
  Whereabouts* whereabouts =
      nullptr;  // receives the least budget and the number out of block, if the activation may last
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
