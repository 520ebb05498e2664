#include "common/signals.h"

#if defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>
#elif defined(__APPLE__)
#include <pthread.h>
#endif

#include <algorithm>
#include <atomic>
#include <chrono>

namespace mpm {
namespace {

using Clock = std::chrono::steady_clock;
constexpr Clock::duration kBetweenChecks = std::chrono::milliseconds(100);

std::atomic<int (*)()> run_handlers = nullptr;  // returns whether a handler has raised; null without Python

bool on_main_thread() {
#if defined(__linux__)
  return syscall(SYS_gettid) == getpid();
#elif defined(__APPLE__)
  return pthread_main_np() != 0;
#else
  return false;
#endif
}

}  // namespace

void check_signals() {
  static thread_local Clock::time_point next;
  static thread_local bool in_handler = false;  // may call ops
  const Clock::time_point now = Clock::now();
  if (now < next || in_handler) return;
  next = now + kBetweenChecks;
  int (*const run)() = run_handlers.load(std::memory_order_relaxed);
  if (!run || !on_main_thread()) return;
  in_handler = true;
  const bool raised = run() != 0;
  in_handler = false;
  STD_TORCH_CHECK(!raised, "interrupted: the handler of a signal has raised an exception");
}

#if MPM_BACKEND == MPM_BACKEND_IS_cuda

namespace {

// Per device and thread: marks between pieces of work.
class WorkInFlight {
 public:
  static WorkInFlight& of_this_thread() {
    constexpr int most_devices = 64;
    static thread_local WorkInFlight* of_device[most_devices] = {};  // never destroyed: CUDA may be unloaded by then
    int device = 0;
    check(cudaGetDevice(&device));
    WorkInFlight*& own = of_device[std::clamp(device, 0, most_devices - 1)];
    if (!own) own = new WorkInFlight;
    return *own;
  }

  void add(int64_t work, cudaStream_t stream) {
    since_mark_ += work;
    if (since_mark_ < kPiece) return;
    cudaStreamCaptureStatus status = cudaStreamCaptureStatusActive;
    if (cudaStreamIsCapturing(stream, &status) != cudaSuccess || status != cudaStreamCaptureStatusNone) return;
    since_mark_ = 0;
    cudaEvent_t& mark = marks_[next_++ % kMarks];
    if (mark)
      check(cudaEventSynchronize(mark));
    else
      check(cudaEventCreateWithFlags(&mark, cudaEventDisableTiming));
    check(cudaEventRecord(mark, stream));
  }

 private:
  // At most kMarks + 1 pieces are in flight: a tenth to a third of a second of a device that computes 10^9 particle
  // substeps per second, and enough that it never waits for the host.
  static constexpr int64_t kPiece = int64_t(1) << 25;
  static constexpr int kMarks = 4;

  static void check(cudaError_t error) { STD_TORCH_CHECK(error == cudaSuccess, "CUDA: ", cudaGetErrorString(error)); }

  int64_t since_mark_ = 0;
  unsigned next_ = 0;
  cudaEvent_t marks_[kMarks] = {};
};

constexpr int64_t kLeastParticles = 1 << 13;  // fewer do not take less time

}  // namespace

void limit_work_in_flight(int64_t particles, int64_t substeps, cudaStream_t stream) {
  WorkInFlight::of_this_thread().add(std::max(particles, kLeastParticles) * substeps, stream);
}

#endif

}  // namespace mpm

// From here on checks run the handlers of signals by a function without arguments, which returns whether one raised.
extern "C" __attribute__((visibility("default"))) void MPM_JOIN(torch_mpm_run_handlers_,
                                                                TORCH_MPM_BACKEND)(int (*run)()) {
  mpm::run_handlers.store(run);
}
