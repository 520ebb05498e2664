#pragma once

#include <vector>

#include "cuda/check.h"

// Work beside that of a stream: a second stream of the thread, which the first one waits for.
namespace mpm {

class SideStream {
 public:
  // The second stream while it works beside `stream`: its work begins after the present work of that stream, whose work
  // after the end of the fork begins after that of the second stream.
  class Fork {
   public:
    explicit Fork(cudaStream_t stream) : stream_(stream), side_(of_this_thread()) {
      check_cuda(cudaEventRecord(side_.event_, stream_));
      check_cuda(cudaStreamWaitEvent(side_.stream_, side_.event_, 0));
    }
    Fork(const Fork&) = delete;
    Fork& operator=(const Fork&) = delete;
    ~Fork() {  // The calls fail only after another error, which is reported.
      cudaEventRecord(side_.event_, side_.stream_);
      cudaStreamWaitEvent(stream_, side_.event_, 0);
    }

    cudaStream_t stream() const { return side_.stream_; }

   private:
    const cudaStream_t stream_;
    const SideStream& side_;
  };

 private:
  SideStream() {
    check_cuda(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking));
    check_cuda(cudaEventCreateWithFlags(&event_, cudaEventDisableTiming));
  }

  static const SideStream& of_this_thread() {
    // By device; never destroyed: CUDA may be unloaded before.
    static thread_local auto* const streams = new std::vector<const SideStream*>;
    int device = 0;
    check_cuda(cudaGetDevice(&device));
    if (streams->size() <= size_t(device)) streams->resize(size_t(device) + 1);
    const SideStream*& own = (*streams)[size_t(device)];
    if (!own) own = new SideStream;
    return *own;
  }

  cudaStream_t stream_ = nullptr;
  cudaEvent_t event_ = nullptr;
};

}  // namespace mpm
