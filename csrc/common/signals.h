#pragma once

#include "common/backend.h"

// Signals during calls of many substeps. Python runs the handlers of signals between its own instructions, and delays
// them until an op returns.
namespace mpm {

// Runs the handlers of pending signals, several times a second at most, on the main thread, which is the only one that
// runs them. Raises where a handler has raised: the call ends without a result.
void check_signals();

#if MPM_BACKEND == MPM_BACKEND_IS_cuda

// Counts the particles times substeps that are launched on a stream. Waits for earlier work of this thread where too
// much is in flight: launched work cannot be interrupted, so a device has at most a fraction of a second of it.
void limit_work_in_flight(int64_t particles, int64_t substeps, cudaStream_t stream);

#endif

// To be called after the substeps of a call.
inline void after_substeps([[maybe_unused]] int64_t particles, [[maybe_unused]] int64_t substeps,
                           [[maybe_unused]] backend::Stream stream) {
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
  limit_work_in_flight(particles, substeps, stream);
#endif
  check_signals();
}

}  // namespace mpm
