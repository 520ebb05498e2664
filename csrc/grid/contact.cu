#include "grid/contact.h"

#include "cuda/launch.cuh"
#include "grid/slot_lanes.cuh"

namespace mpm::cuda {
namespace {

constexpr int kThreads = 128;

template <bool Backward, class T, int D>
__global__ void __launch_bounds__(kThreads) contact_kernel(const __grid_constant__ ContactArguments<T, D> a) {
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t slot = thread / kSlotLanes;
  if (slot >= a.max_blocks) return;
  if constexpr (Backward)
    slot_contact_backward<kSlotLanes>(a, int(slot), int(thread % kSlotLanes), SumLanes(), NoImpulses());
  else
    slot_contact<kSlotLanes>(a, int(slot), int(thread % kSlotLanes));
}

template <bool Backward, class T, int D>
void run(const ContactArguments<T, D>& a, Stream stream) {
  if (a.max_blocks == 0) return;
  const unsigned blocks = unsigned((int64_t(a.max_blocks) * kSlotLanes + kThreads - 1) / kThreads);
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
