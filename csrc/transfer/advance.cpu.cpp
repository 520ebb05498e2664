#include "transfer/advance.h"
#include "cpu/parallel.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 4096;  // particles below which a range is not split

template <class... F>
bool contiguous_particles(const F&... field) {
  return (... && (!field.pointer || field.stride[0] == 1));
}
template <class... F>
void assume_contiguous(F&... field) {
  ((field.stride[0] = 1), ...);
}

// With a particle stride of 1 known at compile time the compiler vectorises the loop over particles.
template <bool Contiguous, class T, int D>
void advance_range(AdvanceArguments<T, D> a, int64_t begin, int64_t end) {
  if (Contiguous) assume_contiguous(a.x, a.velocity, a.affine, a.F, a.J, a.x_next, a.F_next, a.J_next);
#pragma GCC ivdep
  for (int64_t p = begin; p < end; p++) advance_particle(a, One<T>{p});
}

template <bool Contiguous, class T, int D>
void advance_backward_range(AdvanceBackwardArguments<T, D> a, int64_t begin, int64_t end) {
  if (Contiguous)
    assume_contiguous(a.forward.x, a.forward.velocity, a.forward.affine, a.forward.F, a.forward.J, a.grad_x, a.grad_F,
                      a.grad_J, a.velocity, a.affine, a.F, a.J, a.dt);
#pragma GCC ivdep
  for (int64_t p = begin; p < end; p++) advance_particle_backward(a, One<T>{p});
}

}  // namespace

template <class T, int D>
void advance(const AdvanceArguments<T, D>& a) {
  const bool contiguous = contiguous_particles(a.x, a.velocity, a.affine, a.F, a.J, a.x_next, a.F_next, a.J_next);
  parallel_ranges(a.particles, kGrain, [&](int64_t begin, int64_t end) {
    contiguous ? advance_range<true>(a, begin, end) : advance_range<false>(a, begin, end);
  });
}

template <class T, int D>
void advance_backward(const AdvanceBackwardArguments<T, D>& a) {
  const auto& f = a.forward;
  const bool contiguous = contiguous_particles(f.x, f.velocity, f.affine, f.F, f.J, a.grad_x, a.grad_F, a.grad_J,
                                               a.velocity, a.affine, a.F, a.J, a.dt);
  parallel_ranges(f.particles, kGrain, [&](int64_t begin, int64_t end) {
    contiguous ? advance_backward_range<true>(a, begin, end) : advance_backward_range<false>(a, begin, end);
  });
}

MPM_INSTANTIATE(advance, AdvanceArguments)
MPM_INSTANTIATE(advance_backward, AdvanceBackwardArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
