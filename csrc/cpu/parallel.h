#pragma once

#include <cstdint>

#include "common/host_device.h"
#include "common/instantiate.h"

// Parallel loops for the kernels of csrc/cpu, which are compiled for several instruction sets and therefore include
// neither torch nor templates of the standard library.
namespace mpm::cpu {

int thread_count();

// Calls body(context, begin, end) on ranges that cover [0, count), in parallel. Ranges shorter than `grain` are not
// split.
void parallel_for(int64_t count, int64_t grain, void (*body)(void* context, int64_t begin, int64_t end), void* context);

// Runs `body(context)` with the threads of torch available for all of its loops: one team for a call of many loops,
// whose threads wait for each other as little as possible where other processes use the cores too.
void with_team(void (*body)(void* context), void* context);

// During its lifetime, this thread runs all of its loops alone, if requested: short loops then wait for no thread.
class Alone {
 public:
  explicit Alone(bool wanted);
  ~Alone();
  Alone(const Alone&) = delete;
  Alone& operator=(const Alone&) = delete;

 private:
  const bool begins_;
};

// Pause of a waiting loop after `spins` checks; asleep after about ten microseconds, so that a long wait frees its
// core.
void rest(int spins);

inline namespace TORCH_MPM_ISA {

template <class F>
void parallel_ranges(int64_t count, int64_t grain, const F& f) {
  parallel_for(
      count, grain, [](void* context, int64_t begin, int64_t end) { (*static_cast<const F*>(context))(begin, end); },
      const_cast<void*>(static_cast<const void*>(&f)));
}

// Distributes the items of consecutive phases over a team of threads: each member has a share of every phase, a range
// of neighbours, and takes items of others that have not begun. So a thread processes the same part of space, whose
// nodes and particles are in its caches, from phase to phase and from kernel to kernel.
template <int Phases>
class Shares {
 public:
  // start: [Phases + 1] first item of each phase.
  Shares(const int* start, int members) : start_(start), members_(members < kMost ? members : kMost) {}

  // Next item for a member that calls with `place` zero at first; −1 at the end. A member leaves a phase when all of
  // its items are taken.
  struct Place {
    int phase = 0, share = 0;
  };
  int64_t take(int member, Place& place) {
    for (; place.phase < Phases; place.phase++, place.share = 0)
      for (; place.share < members_; place.share++) {
        const int owner = (member + place.share) % members_;
        const int first = start_[place.phase], count = start_[place.phase + 1] - first;
        const int begin = part(count, owner), end = part(count, owner + 1);
        const int i = begin + __atomic_fetch_add(&taken_[owner].phase[place.phase], 1, __ATOMIC_RELAXED);
        if (i < end) return first + i;
      }
    return -1;
  }

 private:
  static constexpr int kMost = 64;  // further threads share a share
  int part(int64_t count, int member) const { return int(count * member / members_); }

  const int* start_;
  int members_;
  struct alignas(64) Taken {
    int phase[Phases] = {};
  } taken_[kMost];
};

// Calls f(next) once per thread, where next() returns the items of all phases, on at most `most` threads.
template <int Phases, class F>
void parallel_phases(const int* start, int64_t most, const F& f) {
  const int64_t threads = thread_count(), members = most < threads ? most : threads;
  Shares<Phases> shares(start, int(members));
  parallel_ranges(members, 1, [&](int64_t member, int64_t) {
    typename Shares<Phases>::Place place;
    f([&] { return shares.take(int(member), place); });
  });
}

// Counts the finished items of consecutive phases. A thread with an item of a phase may wait for the previous phase:
// each of its items is then taken by a running thread.
template <int Phases>
struct PhaseCounter {
  const int* start;  // [Phases + 1] first item of each phase
  int finished[Phases] = {};

  void wait_before(int phase) {
    for (int p = 0; p < phase; p++)
      for (int spins = 0; __atomic_load_n(&finished[p], __ATOMIC_ACQUIRE) < start[p + 1] - start[p]; spins++)
        rest(spins);
  }
  void finish(int phase) { __atomic_fetch_add(&finished[phase], 1, __ATOMIC_RELEASE); }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
