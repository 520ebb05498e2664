#pragma once

#include <cstdint>

#include "math/host_device.h"

// Parallel loops for the kernels of csrc/cpu, which are compiled for several instruction sets and therefore see neither
// torch nor templates of the standard library.
namespace mpm::cpu {

int thread_count();

// Calls body(context, begin, end) on ranges that cover [0, count), in parallel. Ranges shorter than `grain` are not split.
void parallel_for(int64_t count, int64_t grain, void (*body)(void* context, int64_t begin, int64_t end), void* context);

inline namespace TORCH_MPM_ISA {

template <class F>
void parallel_ranges(int64_t count, int64_t grain, const F& f) {
  parallel_for(
      count, grain, [](void* context, int64_t begin, int64_t end) { (*static_cast<const F*>(context))(begin, end); },
      const_cast<void*>(static_cast<const void*>(&f)));
}

// f(i) for every i in [0, count), handed to the threads one after another: for items of unequal cost.
template <class F>
void parallel_items(int64_t count, const F& f) {
  int64_t next = 0;
  parallel_ranges(thread_count(), 1, [&](int64_t, int64_t) {
    for (int64_t i; (i = __atomic_fetch_add(&next, 1, __ATOMIC_RELAXED)) < count;) f(i);
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
