#include "cpu/contact_launchers.h"
#include "cpu/parallel.h"

namespace mpm::cpu {
namespace {

constexpr int64_t kGrain = 64;  // slots below which a range is not split

}  // namespace

template <class T, int D>
void contact(const ContactArguments<T, D>& a, Stream) {
  parallel_ranges(a.capacity, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) slot_contact<1>(a, int(slot), 0);
  });
}

template <class T, int D>
void contact_backward(const ContactArguments<T, D>& a, Stream) {
  parallel_ranges(a.capacity, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) slot_contact_backward<1>(a, int(slot), 0);
  });
}

#define INSTANTIATE(T, D)                                       \
  template void contact(const ContactArguments<T, D>&, Stream); \
  template void contact_backward(const ContactArguments<T, D>&, Stream);
INSTANTIATE(float, 2)
INSTANTIATE(float, 3)
INSTANTIATE(double, 2)
INSTANTIATE(double, 3)

}  // namespace mpm::cpu
