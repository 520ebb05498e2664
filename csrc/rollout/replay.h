#pragma once

#include <cstdlib>
#include <memory>
#include <mutex>
#include <type_traits>
#include <utility>
#include <vector>

#include "common/backend.h"

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
#include "cpu/parallel.h"
#endif

// What a call of many substeps saves: threads that come and go with each loop, and launches of kernels by the host.
namespace mpm {

#if MPM_BACKEND == MPM_BACKEND_IS_cpu

// Runs `work()`, of many parallel loops over `particles`, with one team of threads, or with none.
template <class Work>
void with_team(int64_t particles, const Work& work) {
  constexpr int64_t few = 1 << 13;  // of which a thread is faster alone than it calls the others
  const cpu::Alone alone(particles < few);
  if (particles < few) return work();
  cpu::with_team([](void* w) { (*static_cast<const Work*>(w))(); }, const_cast<Work*>(&work));
}

#else

template <class Work>
void with_team(int64_t, const Work& work) {
  work();
}

// Makes the graphs of a thread, and keeps the latest one that is replayed. The next one is mostly the same but for its
// pointers, and to change these takes a third of the time of a new one. Its stream is its own, since torch's default
// stream records nothing.
class Recorder {
 public:
  static Recorder& of_this_thread() {
    static thread_local Recorder* const recorder = new Recorder;  // has no end: CUDA may be gone by then
    return *recorder;
  }

  template <class Work>
  void record(const Work& work) {
    use_device();
    // Relaxed: what other threads do meanwhile is not in the recording, and may not fail for it.
    check(cudaStreamBeginCapture(stream_, cudaStreamCaptureModeRelaxed));
    cudaGraph_t graph = nullptr;
    try {
      work(stream_);
    } catch (...) {
      cudaStreamEndCapture(stream_, &graph);
      if (graph) cudaGraphDestroy(graph);
      throw;
    }
    check(cudaStreamEndCapture(stream_, &graph));
    if (const auto shape = shape_of_graph(graph); shape != shape_) {
      forget();
      shape_ = shape;
    }
    cudaGraphExecUpdateResultInfo info;
    if (executable_ && cudaGraphExecUpdate(executable_, graph, &info) != cudaSuccess) {
      cudaGetLastError();  // which is no error: another graph takes its place
      forget();
    }
    const cudaError_t made = executable_ ? cudaSuccess : cudaGraphInstantiate(&executable_, graph, 0);
    check(cudaGraphDestroy(graph));
    check(made);
  }

  void launch(cudaStream_t stream) const { check(cudaGraphLaunch(executable_, stream)); }

#if CUDART_VERSION >= 13000
  template <class Work>
  void repeat(cudaStream_t stream, const Work& work) {
    use_device();
    cudaGraph_t graph = nullptr;
    check(cudaGraphCreate(&graph, 0));
    const std::unique_ptr<std::remove_pointer_t<cudaGraph_t>, decltype(&cudaGraphDestroy)> owner(graph,
                                                                                                 &cudaGraphDestroy);
    cudaGraphNodeParams loop{};
    loop.type = cudaGraphNodeTypeConditional;
    loop.conditional.type = cudaGraphCondTypeWhile;
    loop.conditional.size = 1;
    check(cudaGraphConditionalHandleCreate(&loop.conditional.handle, graph, 1, cudaGraphCondAssignDefault));
    cudaGraphNode_t node;
    check(cudaGraphAddNode(&node, graph, nullptr, nullptr, 0, &loop));
    cudaGraph_t body = loop.conditional.phGraph_out[0];
    check(cudaStreamBeginCaptureToGraph(stream_, body, nullptr, nullptr, 0, cudaStreamCaptureModeRelaxed));
    try {
      work(stream_, loop.conditional.handle);
    } catch (...) {
      cudaStreamEndCapture(stream_, &body);
      throw;
    }
    check(cudaStreamEndCapture(stream_, &body));
    cudaGraphExec_t executable = nullptr;
    check(cudaGraphInstantiate(&executable, graph, 0));
    const cudaError_t launched = cudaGraphLaunch(executable, stream);
    forget_later(executable);
    check(launched);
  }
#endif

 private:
  static void check(cudaError_t error) { STD_TORCH_CHECK(error == cudaSuccess, "CUDA: ", cudaGetErrorString(error)); }

  void use_device() {
    int device = 0;
    check(cudaGetDevice(&device));
    if (stream_ && device == device_) return;
    forget();
    if (stream_) check(cudaStreamDestroy(std::exchange(stream_, nullptr)));
    check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking));
    device_ = device;
  }

  // The kinds of its nodes and the clusters of its kernels, which an update cannot change.
  static std::vector<int> shape_of_graph(cudaGraph_t graph) {
    size_t count = 0;
    check(cudaGraphGetNodes(graph, nullptr, &count));
    std::vector<cudaGraphNode_t> nodes(count);
    check(cudaGraphGetNodes(graph, nodes.data(), &count));
    std::vector<int> shape;
    for (cudaGraphNode_t node : nodes) {
      cudaGraphNodeType type;
      check(cudaGraphNodeGetType(node, &type));
      shape.push_back(int(type));
      if (type != cudaGraphNodeTypeKernel) continue;
      cudaLaunchAttributeValue cluster{};
      check(cudaGraphKernelNodeGetAttribute(node, cudaLaunchAttributeClusterDimension, &cluster));
      shape.push_back(int(cluster.clusterDim.x));
    }
    return shape;
  }

  void forget() {  // what still runs is freed when it has ended
    if (executable_) cudaGraphExecDestroy(executable_);
    executable_ = nullptr;
  }
  // To destroy a graph with a loop, even one that has ended, takes until the device has nothing to do, so those of all
  // threads are destroyed once there are some.
  static void forget_later(cudaGraphExec_t loop) {
    constexpr size_t most = 32;
    static std::mutex mutex;
    static std::vector<cudaGraphExec_t>* const kept = new std::vector<cudaGraphExec_t>;  // as the recorder, has no end
    std::vector<cudaGraphExec_t> old;
    {
      const std::lock_guard<std::mutex> lock(mutex);
      if (kept->size() >= most) old.swap(*kept);
      kept->push_back(loop);
    }
    for (cudaGraphExec_t one : old) cudaGraphExecDestroy(one);
  }

  int device_ = -1;
  cudaStream_t stream_ = nullptr;
  cudaGraphExec_t executable_ = nullptr;
  std::vector<int> shape_;
};

constexpr int64_t kLeastReplays = 6;  // which a recording has to save its own time

inline bool is_recorded(cudaStream_t stream) {
  cudaStreamCaptureStatus status = cudaStreamCaptureStatusActive;
  return cudaStreamIsCapturing(stream, &status) != cudaSuccess || status != cudaStreamCaptureStatusNone;
}

// How often `work(stream)` was replayed: `times`, or never where a recording would not pay or the stream is recorded
// itself. It must be kernels, copies and memory that is set, alone. `launched()` is called after each replay.
template <class Work, class Launched>
int64_t replay(int64_t times, cudaStream_t stream, const Work& work, const Launched& launched) {
  if (times < kLeastReplays || is_recorded(stream)) return 0;
  Recorder& recorder = Recorder::of_this_thread();
  recorder.record(work);
  for (int64_t k = 0; k < times; k++) {
    recorder.launch(stream);
    launched();
  }
  return times;
}

#if CUDART_VERSION >= 13000
// Has the device do `work(stream, condition)` once, and again until a kernel of it sets the condition to zero. It must
// be kernels, copies and memory that is set, alone. With TORCH_MPM_HOST_LOOPS the condition is null and the host asks
// `goes_on()` each time: compute-sanitizer takes what kernels read in loops of graphs for memory that is not allocated.
template <class Work, class GoesOn>
void repeat(cudaStream_t stream, const Work& work, const GoesOn& goes_on) {
  static const bool by_host = std::getenv("TORCH_MPM_HOST_LOOPS");
  if (!by_host) return Recorder::of_this_thread().repeat(stream, work);
  do work(stream, 0);
  while (goes_on());
}

// `count` values of the device as they are once the stream is done.
template <class T>
std::vector<T> on_host(const T* values, int64_t count, cudaStream_t stream) {
  std::vector<T> copy(count);
  cudaMemcpyAsync(copy.data(), values, size_t(count) * sizeof(T), cudaMemcpyDeviceToHost, stream);
  STD_TORCH_CHECK(cudaStreamSynchronize(stream) == cudaSuccess, "CUDA: ", cudaGetErrorString(cudaGetLastError()));
  return copy;
}
#endif

#endif

}  // namespace mpm
