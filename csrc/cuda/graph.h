#pragma once

#include <cstdlib>
#include <memory>
#include <mutex>
#include <type_traits>
#include <utility>
#include <vector>

#include "cuda/check.h"

// Kernels that are launched many times in the same order, as CUDA graphs: the host launches one graph in place of many
// kernels, and a graph with a loop needs no host between its turns.
namespace mpm {

// Captures the graphs of a thread, and stores the latest one of each of two numbers. The next graph mostly differs in
// its pointers only, and an update of these takes a third of the time of a new graph. It has a separate stream, since
// torch's default stream cannot be captured.
class CapturedGraph {
 public:
  static CapturedGraph& of_this_thread(int number = 0) {
    static thread_local CapturedGraph* const latest =
        new CapturedGraph[2];  // never destroyed: CUDA may be unloaded before
    return latest[number];
  }

  template <class Work>
  void capture(const Work& work) {
    use_device();
    // Relaxed: concurrent work of other threads is not captured, and must not fail.
    check_cuda(cudaStreamBeginCapture(stream_, cudaStreamCaptureModeRelaxed));
    cudaGraph_t graph = nullptr;
    try {
      work(stream_);
    } catch (...) {
      cudaStreamEndCapture(stream_, &graph);
      if (graph) cudaGraphDestroy(graph);
      throw;
    }
    check_cuda(cudaStreamEndCapture(stream_, &graph));
    if (const auto shape = shape_of_graph(graph); shape != shape_) {
      forget();
      shape_ = shape;
    }
    cudaGraphExecUpdateResultInfo info;
    if (executable_ && cudaGraphExecUpdate(executable_, graph, &info) != cudaSuccess) {
      cudaGetLastError();  // not an error: a new graph replaces it
      forget();
    }
    const cudaError_t made = executable_ ? cudaSuccess : cudaGraphInstantiate(&executable_, graph, 0);
    check_cuda(cudaGraphDestroy(graph));
    check_cuda(made);
  }

  void launch(cudaStream_t stream) const { check_cuda(cudaGraphLaunch(executable_, stream)); }

#if CUDART_VERSION >= 13000
  template <class Work>
  void repeat(cudaStream_t stream, const Work& work) {
    use_device();
    cudaGraph_t graph = nullptr;
    check_cuda(cudaGraphCreate(&graph, 0));
    const std::unique_ptr<std::remove_pointer_t<cudaGraph_t>, decltype(&cudaGraphDestroy)> owner(graph,
                                                                                                 &cudaGraphDestroy);
    cudaGraphNodeParams loop{};
    loop.type = cudaGraphNodeTypeConditional;
    loop.conditional.type = cudaGraphCondTypeWhile;
    loop.conditional.size = 1;
    check_cuda(cudaGraphConditionalHandleCreate(&loop.conditional.handle, graph, 1, cudaGraphCondAssignDefault));
    cudaGraphNode_t node;
    check_cuda(cudaGraphAddNode(&node, graph, nullptr, nullptr, 0, &loop));
    cudaGraph_t body = loop.conditional.phGraph_out[0];
    check_cuda(cudaStreamBeginCaptureToGraph(stream_, body, nullptr, nullptr, 0, cudaStreamCaptureModeRelaxed));
    try {
      work(stream_, loop.conditional.handle);
    } catch (...) {
      cudaStreamEndCapture(stream_, &body);
      throw;
    }
    check_cuda(cudaStreamEndCapture(stream_, &body));
    cudaGraphExec_t executable = nullptr;
    check_cuda(cudaGraphInstantiate(&executable, graph, 0));
    const cudaError_t launched = cudaGraphLaunch(executable, stream);
    forget_later(executable);
    check_cuda(launched);
  }
#endif

 private:
  void use_device() {
    int device = 0;
    check_cuda(cudaGetDevice(&device));
    if (stream_ && device == device_) return;
    forget();
    if (stream_) check_cuda(cudaStreamDestroy(std::exchange(stream_, nullptr)));
    check_cuda(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking));
    device_ = device;
  }

  // The kinds of its nodes and the clusters of its kernels, which an update cannot change.
  static std::vector<int> shape_of_graph(cudaGraph_t graph) {
    size_t count = 0;
    check_cuda(cudaGraphGetNodes(graph, nullptr, &count));
    std::vector<cudaGraphNode_t> nodes(count);
    check_cuda(cudaGraphGetNodes(graph, nodes.data(), &count));
    std::vector<int> shape;
    for (cudaGraphNode_t node : nodes) {
      cudaGraphNodeType type;
      check_cuda(cudaGraphNodeGetType(node, &type));
      shape.push_back(int(type));
      if (type != cudaGraphNodeTypeKernel) continue;
      cudaLaunchAttributeValue cluster{};
      check_cuda(cudaGraphKernelNodeGetAttribute(node, cudaLaunchAttributeClusterDimension, &cluster));
      shape.push_back(int(cluster.clusterDim.x));
    }
    return shape;
  }

  void forget() {  // a running graph is freed when it has ended
    if (executable_) cudaGraphExecDestroy(executable_);
    executable_ = nullptr;
  }
  // Destroying a graph with a loop waits until the device is idle, even if the graph has ended. Therefore the graphs of
  // all threads are collected and destroyed together.
  static void forget_later(cudaGraphExec_t loop) {
    constexpr size_t most = 32;
    static std::mutex mutex;
    static std::vector<cudaGraphExec_t>* const kept =
        new std::vector<cudaGraphExec_t>;  // never destroyed, like the graphs of threads
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

constexpr int64_t kLeastReplays = 6;  // least number for which a capture pays

inline bool is_captured(cudaStream_t stream) {
  cudaStreamCaptureStatus status = cudaStreamCaptureStatusActive;
  return cudaStreamIsCapturing(stream, &status) != cudaSuccess || status != cudaStreamCaptureStatusNone;
}

// Replays of substeps in a graph of many. A device waits 5 µs between two graphs, which matters for few particles only,
// and launched work cannot be interrupted.
inline int64_t replays_of_graph(int64_t particles) { return particles <= int64_t(1) << 20 ? 4 : 1; }

// Number of replays of `work(stream)`: `times`, or zero if a capture would not pay or the stream itself is captured.
// The work must consist of kernels, copies and memsets only. `launched(count)` is called after each launch of a graph,
// with its number of replays. Of many replays, `together` are one graph, which is captured while the first ones run.
template <class Work, class Launched>
int64_t replay(int64_t times, int64_t together, cudaStream_t stream, const Work& work, const Launched& launched) {
  constexpr int64_t many = 32, first = 8;
  if (times < kLeastReplays || is_captured(stream)) return 0;
  const auto launch = [&](const CapturedGraph& graph, int64_t graphs, int64_t replays) {
    for (int64_t k = 0; k < graphs; k++) {
      graph.launch(stream);
      launched(replays);
    }
    return graphs * replays;
  };
  CapturedGraph& one = CapturedGraph::of_this_thread();
  one.capture(work);
  if (times < many || together == 1) return launch(one, times, 1);
  int64_t done = launch(one, first, 1);
  CapturedGraph& several = CapturedGraph::of_this_thread(1);
  several.capture([&](cudaStream_t on) {
    for (int64_t k = 0; k < together; k++) work(on);
  });
  done += launch(several, (times - done) / together, together);
  return done + launch(one, times - done, 1);
}

#if CUDART_VERSION >= 13000
// Runs `work(stream, condition)` once, and repeats it on the device until one of its kernels sets the condition to
// zero. The work must consist of kernels, copies and memsets only. With TORCH_MPM_HOST_LOOPS the condition is null and
// the host calls `goes_on()` after each run: compute-sanitizer reports reads in loops of graphs as invalid.
template <class Work, class GoesOn>
void repeat(cudaStream_t stream, const Work& work, const GoesOn& goes_on) {
  static const bool by_host = std::getenv("TORCH_MPM_HOST_LOOPS");
  if (!by_host) return CapturedGraph::of_this_thread().repeat(stream, work);
  do work(stream, 0);
  while (goes_on());
}

// `count` values of the device after the work of the stream.
template <class T>
std::vector<T> on_host(const T* values, int64_t count, cudaStream_t stream) {
  std::vector<T> copy(count);
  cudaMemcpyAsync(copy.data(), values, size_t(count) * sizeof(T), cudaMemcpyDeviceToHost, stream);
  STD_TORCH_CHECK(cudaStreamSynchronize(stream) == cudaSuccess, "CUDA: ", cudaGetErrorString(cudaGetLastError()));
  return copy;
}
#endif

}  // namespace mpm
