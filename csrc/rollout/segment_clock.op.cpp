#include "rollout/kernels.h"

// dt of the next substeps of each scene and its time after them.
namespace mpm {
namespace {

Tensor segment_clock(const Tensor& clock, const OptionalTensor& rate, double cfl, double longest, int64_t most,
                     bool choose, int64_t substeps) {
  STD_TORCH_CHECK(clock.dim() == 2 && clock.size(1) == kSegmentClockSize, "clock must have shape [B, ",
                  int(kSegmentClockSize), "], got ", shape_of(clock));
  check_type(clock, "clock", ScalarType::Double, clock);
  STD_TORCH_CHECK(clock.is_contiguous(), "clock must be contiguous");
  const int64_t scenes = clock.size(0);
  STD_TORCH_CHECK(substeps >= kAllLeft, "substeps must be -1 or not negative, got ", substeps);
  Tensor next = empty(clock, {scenes, kSegmentClockSize}, ScalarType::Double);
  SegmentClockArguments a;
  a.scenes = scenes;
  a.clock = static_cast<const double*>(clock.const_data_ptr());
  if (has(rate)) {
    const Tensor& r = rate.value();
    check_shape(r, "rate", {scenes});
    check_type(r, "rate", ScalarType::Double, clock);
    a.rate = static_cast<const double*>(r.const_data_ptr());
    a.rate_stride = r.stride(0);
  }
  a.cfl = cfl, a.longest = longest, a.most = double(most);
  a.choose = choose;
  a.substeps = substeps;
  a.next = static_cast<double*>(next.data_ptr());
  const DeviceScope device(clock);
#if MPM_BACKEND == MPM_BACKEND_IS_cuda
  cuda::segment_clock(a, device.stream());
#else
  for (int64_t scene = 0; scene < scenes; scene++) next_segment(a, scene);
#endif
  return next;
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "segment_clock(Tensor clock, Tensor? rate, float cfl, float longest, int most, bool choose, int substeps) -> "
      "Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) { m.impl("segment_clock", TORCH_BOX(&mpm::segment_clock)); }
