#include "cpu/parallel.h"

#include <torch/csrc/stable/ops.h>
#ifdef __linux__
#include <sched.h>
#endif

#include <atomic>
#include <chrono>
#include <exception>
#include <thread>
#include <utility>

namespace mpm::cpu {
namespace {

using Body = void (*)(void* context, int64_t begin, int64_t end);

void pause() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

constexpr int kSpins = 2000;  // about ten microseconds, the time to wake a thread

// Placement of the members of a team. Beside other processes the system may leave two of them on one core for long, and
// the other process alone on another: a member that finds another one on its core moves to a free one, and may be moved
// again as before.
class Cores {
 public:
  explicit Cores(int members) : members_(members < kMost ? members : kMost) {
    for (std::atomic<int>& core : core_) core.store(-1, std::memory_order_relaxed);
  }

  void keep_apart([[maybe_unused]] int member) {
#ifdef __linux__
    if (member >= members_) return;
    const int here = sched_getcpu();
    core_[member].store(here, std::memory_order_relaxed);
    bool shared = false;
    for (int k = 0; k < members_; k++) shared |= k != member && core_[k].load(std::memory_order_relaxed) == here;
    if (shared && member > 0) leave(member);
#endif
  }

 private:
  static constexpr int kMost = 64;  // further members are not moved

#ifdef __linux__
  void leave(int member) {
    cpu_set_t all;
    if (sched_getaffinity(0, sizeof(all), &all) != 0) return;
    cpu_set_t free = all;
    for (int k = 0; k < members_; k++)
      if (const int core = core_[k].load(std::memory_order_relaxed); core >= 0) CPU_CLR(core, &free);
    if (CPU_COUNT(&free) == 0 || sched_setaffinity(0, sizeof(free), &free) != 0) return;
    sched_setaffinity(0, sizeof(all), &all);
    core_[member].store(sched_getcpu(), std::memory_order_relaxed);
  }
#endif

  const int members_;
  std::atomic<int> core_[kMost];
};

// Threads that run the loops of a leader. No thread waits for one that has not begun: where another process has its
// core, the others do its share. Threads wait asleep for those that have begun, which frees a core.
class Team {
 public:
  explicit Team(int members) : members_(members), cores_(members), shares_(chunks_, members) {}

  int members() const { return members_; }

  // Share of the leader, member 0.
  void run(int64_t count, int64_t grain, Body body, void* context) {
    // More chunks than members, so that a late member leaves little.
    const int64_t least = grain > 0 ? grain : 1, most = (count + least - 1) / least, wanted = 4 * int64_t(members_);
    body_ = body, context_ = context, count_ = count;
    chunks_[1] = int(most < wanted ? most : wanted);
    shares_ = Shares<1>(chunks_, members_);
    failed_.store(false, std::memory_order_relaxed);
    state_.store(kOpen, std::memory_order_release);
    generation_.fetch_add(1, std::memory_order_release);
    generation_.notify_all();
    cores_.keep_apart(0);
    work(0);
    state_.fetch_and(~kOpen, std::memory_order_acq_rel);
    int spins = 0;
    for (int at_work; (at_work = state_.load(std::memory_order_acquire)) > 0;)
      if (spins++ < kSpins)
        pause();
      else
        state_.wait(at_work, std::memory_order_acquire);
    if (std::exception_ptr error = std::exchange(error_, nullptr)) std::rethrow_exception(error);
  }

  void serve(int member) {
    for (unsigned seen = 0;;) {
      for (int spins = 0; spins < kSpins && generation_.load(std::memory_order_acquire) == seen; spins++) pause();
      generation_.wait(seen, std::memory_order_acquire);
      seen = generation_.load(std::memory_order_acquire);
      if (ended_.load(std::memory_order_acquire)) return;
      int state = state_.load(std::memory_order_acquire);
      while (state >= kOpen && !state_.compare_exchange_weak(state, state + 1, std::memory_order_acq_rel)) {
      }
      if (state < kOpen) continue;
      cores_.keep_apart(member);
      work(member);
      state_.fetch_sub(1, std::memory_order_release);
      state_.notify_one();
    }
  }

  void end() {
    ended_.store(true, std::memory_order_release);
    generation_.fetch_add(1, std::memory_order_release);
    generation_.notify_all();
  }

 private:
  static constexpr int kOpen = 1 << 20;  // in the state, whose lower bits count the members at work beside the leader

  void work(int member) {
    Shares<1>::Place place;
    const int64_t chunks = chunks_[1];
    try {
      for (int64_t k; (k = shares_.take(member, place)) >= 0;)
        body_(context_, count_ * k / chunks, count_ * (k + 1) / chunks);
    } catch (...) {
      if (!failed_.exchange(true)) error_ = std::current_exception();
    }
  }

  const int members_;
  Cores cores_;
  int chunks_[2] = {0, 0};
  Body body_ = nullptr;
  void* context_ = nullptr;
  int64_t count_ = 0;
  Shares<1> shares_;
  std::exception_ptr error_;
  std::atomic<bool> failed_{false};
  alignas(64) std::atomic<int> state_{0};
  alignas(64) std::atomic<unsigned> generation_{0};
  std::atomic<bool> ended_{false};
};

thread_local Team* led = nullptr;  // by this thread, while it is in no loop of the team

}  // namespace

int thread_count() { return int(torch::stable::get_num_threads()); }

void parallel_for(int64_t count, int64_t grain, Body body, void* context) {
  if (Team* team = led) {
    if (count <= grain || team->members() == 1) return body(context, 0, count);
    led = nullptr;  // loops inside this one are not parallel
    struct Restore {
      Team* team;
      ~Restore() { led = team; }
    } restore{team};
    return team->run(count, grain, body, context);
  }
  torch::stable::parallel_for(0, count, grain, [=](int64_t begin, int64_t end) { body(context, begin, end); });
}

void with_team(void (*body)(void* context), void* context) {
  const int members = thread_count();
  if ((led && led->members() > 1) || members == 1) return body(context);
  Team team(members);
  std::exception_ptr error;
  torch::stable::parallel_for(0, members, 1, [&](int64_t member, int64_t) {
    if (member > 0) return team.serve(int(member));
    Team* const before = std::exchange(led, &team);
    try {
      body(context);
    } catch (...) {  // not visible to the C functions in between
      error = std::current_exception();
    }
    led = before;
    team.end();
  });
  if (error) std::rethrow_exception(error);
}

Alone::Alone(bool wanted) : begins_(wanted && !led) {
  static thread_local Team single(1);
  if (begins_) led = &single;
}

Alone::~Alone() {
  if (begins_) led = nullptr;
}

void rest(int spins) {
  if (spins < kSpins)
    pause();
  else
    std::this_thread::sleep_for(std::chrono::microseconds(20));
}

}  // namespace mpm::cpu
