#pragma once

#include <cstdint>

#include "math/host_device.h"

// Parallel loops for the kernels of csrc/cpu, which are compiled for several instruction sets and therefore see neither
// torch nor templates of the standard library.
namespace mpm::cpu {

int thread_count();

// Calls body(context, begin, end) on ranges that cover [0, count), in parallel. Ranges shorter than `grain` are not
// split.
void parallel_for(int64_t count, int64_t grain, void (*body)(void* context, int64_t begin, int64_t end), void* context);

// Lets another thread run: for waits that may last where cores are shared.
void yield();

inline namespace TORCH_MPM_ISA {

template <class F>
void parallel_ranges(int64_t count, int64_t grain, const F& f) {
  parallel_for(
      count, grain, [](void* context, int64_t begin, int64_t end) { (*static_cast<const F*>(context))(begin, end); },
      const_cast<void*>(static_cast<const void*>(&f)));
}

// Calls f(next) once per thread, where next() hands out the items [0, count) in order. At most one thread per `grain`
// items.
template <class F>
void parallel_items(int64_t count, int64_t grain, const F& f) {
  int64_t taken = 0;
  const int64_t worth = (count + grain - 1) / grain, threads = thread_count();
  parallel_ranges(worth < threads ? worth : threads, 1, [&](int64_t, int64_t) {
    f([&] {
      const int64_t i = __atomic_fetch_add(&taken, 1, __ATOMIC_RELAXED);
      return i < count ? i : -1;
    });
  });
}

// Counts the finished items of consecutive phases. A thread that took an item of a phase may wait for the phase before:
// items are taken in order, so that every earlier one has a thread at work on it.
template <int Phases>
struct PhaseCounter {
  const int* start;  // [Phases + 1] first item of each phase
  int finished[Phases] = {};

  void wait_before(int phase) {
    for (int p = 0; p < phase; p++)
      for (int spins = 0; __atomic_load_n(&finished[p], __ATOMIC_ACQUIRE) < start[p + 1] - start[p]; spins++)
        if (spins > 1000) yield();
  }
  void finish(int phase) { __atomic_fetch_add(&finished[phase], 1, __ATOMIC_RELEASE); }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
