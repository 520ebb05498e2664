#pragma once

#include "grid/contact.h"
#include "grid/grid_update.h"
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

constexpr int kMostPersistentItems = 1024;  // of thread blocks that run at once

// Work that the kernel for nodes with one surface hands over to that for several surfaces. Zeroed before an activation.
struct Handover {
  int requested;
  int lost;   // whether the activation has lost a particle
  int steps;  // 1 + substeps of the activation that the other kernel has computed; 0 where this one has no work
  int incomplete[kMostPersistentItems];  // per item: whether the G2P of the last substep is not computed yet

#ifdef __CUDACC__
  // Called by a thread of a thread block with an incomplete item. Its displacement stops all thread blocks at the
  // next barrier.
  __device__ void request(Displacement& displacement) {
    incomplete[blockIdx.x] = 1;
    atomicOr(&requested, 1);
    atomicOr(&displacement.lost, kRequest);
  }
  // Called by all thread blocks after that barrier, with their displacement before it.
  __device__ bool is_requested() const { return *const_cast<const volatile int*>(&requested); }
  __device__ void end(const Displacement& displacement) {
    if (displacement.lost & ~kRequest) atomicOr(&lost, 1);
  }
  static constexpr int kRequest = 1 << 8;  // beside Displacement::Loss
#endif
};

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
  unsigned long long* arrived = nullptr;  // counters of barriers, two words of each kernel, zeroed before each launch
  Handover* handover = nullptr;           // for obstacles
  KnownTouch<T, D>* touches[2] = {};      // of the nodes, for obstacles; one is found while G2P reads the other
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
