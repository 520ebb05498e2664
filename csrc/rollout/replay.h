#pragma once

#include "common/backend.h"

// Work that a call repeats, from a CUDA graph: one launch by the host in place of a dozen.
namespace mpm {

#if MPM_BACKEND == MPM_BACKEND_IS_cpu

// How often `work` was replayed: never, where calls cost nothing.
template <class Work>
int64_t replay(int64_t, cpu::Stream, const Work&) {
  return 0;
}

#else

// Recorded by a stream of its own, since torch's default stream records nothing.
class Recording {
 public:
  template <class Work>
  explicit Recording(const Work& work) {
    check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking));
    // Relaxed: what other threads do meanwhile is not in the recording, and may not fail for it.
    check(cudaStreamBeginCapture(stream_, cudaStreamCaptureModeRelaxed));
    work(stream_);
    check(cudaStreamEndCapture(stream_, &graph_));
    check(cudaGraphInstantiate(&executable_, graph_, 0));
  }
  Recording(const Recording&) = delete;
  ~Recording() {  // what still runs is freed when it has ended
    if (executable_) cudaGraphExecDestroy(executable_);
    if (graph_) cudaGraphDestroy(graph_);
    if (stream_) cudaStreamDestroy(stream_);
  }
  void launch(cudaStream_t stream) const { check(cudaGraphLaunch(executable_, stream)); }

 private:
  static void check(cudaError_t error) { STD_TORCH_CHECK(error == cudaSuccess, "CUDA: ", cudaGetErrorString(error)); }
  cudaStream_t stream_ = nullptr;
  cudaGraph_t graph_ = nullptr;
  cudaGraphExec_t executable_ = nullptr;
};

constexpr int64_t kLeastReplays = 6;  // which a recording has to save its own time

// How often `work(stream)` was replayed: `times`, or never where a recording would not pay or the stream is recorded
// itself. It must be kernels and copies alone.
template <class Work>
int64_t replay(int64_t times, cudaStream_t stream, const Work& work) {
  cudaStreamCaptureStatus status = cudaStreamCaptureStatusActive;
  if (times < kLeastReplays || cudaStreamIsCapturing(stream, &status) != cudaSuccess ||
      status != cudaStreamCaptureStatusNone)
    return 0;
  const Recording recording(work);
  for (int64_t k = 0; k < times; k++) recording.launch(stream);
  return times;
}

#endif

}  // namespace mpm
