#pragma once

#include "grid/grid_update.h"
#include "grid/obstacle.h"
#include "transfer/advance.h"
#include "transfer/arguments.h"

// Substeps of few particles, on CUDA: thread blocks that all run at once compute the substeps of the items of an
// activation while it lasts, in place of three kernels per substep.
namespace mpm {

// Number of particles for each one out of its block from which a new activation, and a launch, pays: fewer of these are
// processed by separate warps.
constexpr int kParticlesPerOutOfBlock = 32;
// Largest number of particles for a single cluster of thread blocks.
constexpr int64_t kMostClusterParticles = 2048;
constexpr int kStepsOfALaunch = 2048;  // at most

// Number of items that fit on a multiprocessor at once.
template <int D>
constexpr int kItemsOfProcessor = D == 2 ? 2 : 1;

// Arguments of the kernel beside those of P2G and G2P. Nodes are zero before and after.
template <class T, int D>
struct PersistentLoop {
  GridUpdateArguments<T, D> update;
  ContactArguments<T, D> contact;
  bool obstacles = false;
  int blocks = 0;                         // slots of the pool without the margin
  T* nodes[3] = {};                       // P2G fills one and G2P reads it, while another is cleared
  int steps = 0;                          // of all launches together
  const double* step_time = nullptr;      // [steps] for obstacles, if scenes have no separate clocks
  double* scene_time = nullptr;           // [scenes], advanced in each substep
  const T* scene_dt = nullptr;            // [scenes]
  int* steps_so_far = nullptr;            // zeroed before a call
  unsigned long long* arrived = nullptr;  // counters of barriers, two words zeroed before each launch
  Displacement* displacement = nullptr;   // requests a new activation
  const int* activated = nullptr;         // status of the activation, [1 + scenes, 8]
  int* status = nullptr;                  // status of all substeps
  unsigned long long loop = 0;  // condition of the graph that repeats the kernel until all substeps are done, or zero
};

// P2G updates F or J of the particles, in place, in every substep.
template <class T, int D>
struct PersistentArguments : PersistentLoop<T, D> {
  P2GArguments<T, D> p2g;
  LateDeformation<T, D> late;
  G2PAdvanceArguments<T, D> advance;
};

}  // namespace mpm
