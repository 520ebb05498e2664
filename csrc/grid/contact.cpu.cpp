#include "grid/contact.h"

#include "cpu/parallel.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 64;  // slots below which a range is not split

}  // namespace

template <class T, int D>
void contact(const ContactArguments<T, D>& a) {
  parallel_ranges(a.max_blocks, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) slot_contact<1>(a, int(slot), 0);
  });
}

template <class T, int D>
void contact_backward(const ContactArguments<T, D>& a) {
  parallel_ranges(a.max_blocks, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++)
      slot_contact_backward<1>(a, int(slot), 0, [](T x) { return x; }, NoImpulses());
  });
}

MPM_INSTANTIATE(contact, ContactArguments)
MPM_INSTANTIATE(contact_backward, ContactArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
