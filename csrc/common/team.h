#pragma once

#include "common/backend.h"

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "cpu/parallel.h"
#endif

// One team of threads for all loops of a call, which avoids a start of threads for each loop. CUDA has none.
namespace mpm {

#if MPM_BACKEND == MPM_BACKEND_IS_cpu

// Runs `work()`, which has many parallel loops over `particles`, with one team of threads, or without one.
template <class Work>
void with_team(int64_t particles, const Work& work) {
  constexpr int64_t few = 1 << 13;  // number of particles below which one thread is faster than a team
  const cpu::Alone alone(particles < few);
  if (particles < few) return work();
  cpu::with_team([](void* w) { (*static_cast<const Work*>(w))(); }, const_cast<Work*>(&work));
}

#else

template <class Work>
void with_team(int64_t, const Work& work) {
  work();
}

#endif

}  // namespace mpm
