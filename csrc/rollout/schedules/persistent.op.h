#pragma once

#include <atomic>

#include "cuda/graph.h"
#include "rollout/step_kernels.h"

// The schedule of few particles with thread blocks that all run at once, on CUDA.
namespace mpm {

// Whether a device has refused CUDA graphs with loops.
inline std::atomic<bool> loops_are_refused = CUDART_VERSION < 13000;

#if CUDART_VERSION >= 13000
// Computes the substeps from the second to the last but one, in place. `status` has the status of the first one, and at
// the end that of all of them. False if the device does not support graphs with loops, as under MPS.
template <class T, int D>
bool run_persistent(Substeps<T, D>& s, int* activated, int* status, backend::Stream stream) {
  const SubstepsInputs& in = s.in;
  PersistentArguments<T, D> a{{s.update, s.contact, s.obstacles, s.activation.max_blocks}, s.p2g, s.late, s.advance};
  const int64_t rows = s.pool.nodes.size(0);
  Tensor more = empty(in.x, {2 * rows, 1 + D}, s.pool.nodes.scalar_type());
  backend::clear(more, stream);
  a.nodes[0] = static_cast<T*>(s.pool.nodes.data_ptr());
  a.nodes[1] = static_cast<T*>(more.data_ptr());
  a.nodes[2] = static_cast<T*>(torch::stable::narrow(more, 0, rows, rows).data_ptr());
  Tensor touches;
  if (s.obstacles) {
    touches = empty(in.x, {2 * rows * int64_t(sizeof(KnownTouch<T, D>))}, ScalarType::Byte);
    a.touches[0] = static_cast<KnownTouch<T, D>*>(touches.data_ptr());
    a.touches[1] = a.touches[0] + rows;
  }
  a.steps = int(in.n - 2);
  if (s.contact.step_time) a.step_time = s.contact.step_time + 1;
  a.contact.step_time = nullptr;
  a.contact.activations = nullptr;
  a.contact.row += a.contact.step_stride;
  give_clocks(s, a);
  constexpr int64_t kWords = 4 + (sizeof(Handover) + 7) / 8;
  Tensor steps_so_far = empty_int(in.x, {1}), arrived = empty(in.x, {kWords}, ScalarType::Long);
  backend::clear(steps_so_far, stream);
  a.steps_so_far = static_cast<int*>(steps_so_far.data_ptr());
  a.arrived = static_cast<unsigned long long*>(arrived.data_ptr());
  a.handover = reinterpret_cast<Handover*>(a.arrived + 4);
  a.displacement = s.advance.displacement;
  a.activated = activated;
  a.status = status;
  s.activation.displacement = a.displacement;
  s.activation.previous_status = status;
  s.activation.status = activated;
  static std::atomic<int> works_on = -1;  // device on which such a graph has run
  int device = 0;
  cudaGetDevice(&device);
  const auto launch = [&](cudaStream_t on, unsigned long long condition) {
    a.loop = condition;
    s.find_blocks(on);
    backend::clear(arrived, on);
    s.fused_kernels.persistent(s.laws[0], a, on);
  };
  try {
    if (works_on == device) launch(stream, 0);  // so that the device works while the host makes the graph
    repeat(stream, launch, [&] { return on_host(a.steps_so_far, 1, stream)[0] < a.steps; });
    works_on = device;
  } catch (const std::exception&) {
    if (works_on == device) throw;
    cudaGetLastError();  // nothing was launched
    loops_are_refused = true;
  }
  return !loops_are_refused;
}
#endif

}  // namespace mpm
