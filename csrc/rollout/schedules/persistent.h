#pragma once

#include "grid/grid_update.h"
#include "grid/obstacle.h"
#include "transfer/advance.h"
#include "transfer/arguments.h"

// Substeps of few particles, on CUDA: thread blocks that all run at once take the items of an activation through as
// many substeps as that lasts, in place of three kernels for each.
namespace mpm {

// Strays have warps of their own, so that a new activation, and a launch, pay only where these are not enough: there
// are so many particles for each of them.
constexpr int kParticlesPerStray = 32;
// So many particles are left to one cluster of thread blocks.
constexpr int64_t kMostClusterParticles = 2048;
constexpr int kStepsOfALaunch = 2048;  // at most

// Items that a multiprocessor has room for at once.
template <int D>
constexpr int kItemsOfProcessor = D == 2 ? 2 : 1;

// What the kernel has beside the particles and the nodes of P2G and G2P. Nodes are zero before and after.
template <class T, int D>
struct PersistentLoop {
  GridUpdateArguments<T, D> update;
  ContactArguments<T, D> contact;
  bool obstacles = false;
  int blocks = 0;                         // slots of the pool without the margin
  T* nodes[3] = {};                       // P2G fills one, G2P reads it, and another is emptied
  int steps = 0;                          // to be taken by all launches together
  const double* step_time = nullptr;      // [steps] where obstacles act and scenes have no time of their own
  double* scene_time = nullptr;           // [scenes], goes on with each substep
  const T* scene_dt = nullptr;            // [scenes]
  int* steps_so_far = nullptr;            // zeroed before a call
  unsigned long long* arrived = nullptr;  // thread blocks at barriers, two words zeroed before each launch
  Drift* drift = nullptr;                 // tells the activation that there has to be a new one
  const int* activated = nullptr;         // status of the activation, [1 + scenes, 8]
  int* status = nullptr;                  // that of all substeps
  unsigned long long loop = 0;  // the condition of a graph that launches the kernel until all are taken, or zero
};

// F or J of the particles, all of which move in place, is left to P2G in every substep.
template <class T, int D>
struct PersistentArguments : PersistentLoop<T, D> {
  P2GArguments<T, D> p2g;
  LateDeformation<T, D> late;
  G2PAdvanceArguments<T, D> advance;
};

}  // namespace mpm
