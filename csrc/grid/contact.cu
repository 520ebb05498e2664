#include "cuda/launch.cuh"
#include "grid/obstacle.h"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kLanes = 16;  // threads that share a slot

// The lanes of a slot are half a warp and take the same branches; the other half may take others.
struct SumLanes {
  template <class T>
  __device__ T operator()(T x) const {
    const unsigned mask = 0xffffu << (threadIdx.x & kLanes);
    for (int step = kLanes / 2; step > 0; step /= 2) x += __shfl_down_sync(mask, x, step, kLanes);
    return x;
  }
};

template <bool Backward, class T, int D>
__global__ void __launch_bounds__(kThreads) contact_kernel(const ContactArguments<T, D> a) {
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t slot = thread / kLanes;
  if (slot >= a.max_blocks) return;
  if constexpr (Backward)
    slot_contact_backward<kLanes>(a, int(slot), int(thread % kLanes), SumLanes());
  else
    slot_contact<kLanes>(a, int(slot), int(thread % kLanes));
}

template <bool Backward, class T, int D>
void run(const ContactArguments<T, D>& a, Stream stream) {
  if (a.max_blocks == 0) return;
  const unsigned blocks = unsigned((int64_t(a.max_blocks) * kLanes + kThreads - 1) / kThreads);
  launch(contact_kernel<Backward, T, D>, blocks, kThreads, 0, stream, a);
}

}  // namespace

template <class T, int D>
void contact(const ContactArguments<T, D>& a, Stream stream) {
  run<false>(a, stream);
}

template <class T, int D>
void contact_backward(const ContactArguments<T, D>& a, Stream stream) {
  run<true>(a, stream);
}

MPM_INSTANTIATE(contact, ContactArguments)
MPM_INSTANTIATE(contact_backward, ContactArguments)

}  // namespace mpm::cuda
