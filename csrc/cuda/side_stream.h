#pragma once

#include "common/backend.h"

// Work beside that of a stream: a second stream of the thread, which the first one waits for.
namespace mpm {

class SideStream {
 public:
  static SideStream& of_this_thread() {
    static thread_local SideStream* const side = new SideStream;  // never destroyed: CUDA may be unloaded before
    side->use_device();
    return *side;
  }

  // The second stream, whose later work begins after the present work of `stream`.
  cudaStream_t after(cudaStream_t stream) {
    check(cudaEventRecord(event_, stream));
    check(cudaStreamWaitEvent(stream_, event_, 0));
    return stream_;
  }

  // Lets later work of `stream` begin after the present work of the second stream.
  void join(cudaStream_t stream) {
    check(cudaEventRecord(event_, stream_));
    check(cudaStreamWaitEvent(stream, event_, 0));
  }

 private:
  static void check(cudaError_t error) { STD_TORCH_CHECK(error == cudaSuccess, "CUDA: ", cudaGetErrorString(error)); }

  void use_device() {
    int device = 0;
    check(cudaGetDevice(&device));
    if (device == device_) return;
    check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking));  // those of other devices remain, a few
    check(cudaEventCreateWithFlags(&event_, cudaEventDisableTiming));
    device_ = device;
  }

  int device_ = -1;
  cudaStream_t stream_ = nullptr;
  cudaEvent_t event_ = nullptr;
};

}  // namespace mpm
