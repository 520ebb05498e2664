#include "transfer/kernels.h"

// Positions, deformation gradients and volume ratios at the end of a step.
namespace mpm {
namespace {

template <class T, int D>
AdvanceArguments<T, D> advance_arguments(const Tensor& x, const Tensor& v, const OptionalTensor& C,
                                         const OptionalTensor& F, const OptionalTensor& J, const OptionalTensor& scene,
                                         const OptionalTensor& scene_dt, double dt) {
  const int64_t P = x.size(0);
  STD_TORCH_CHECK(has(C) || !(has(F) || has(J)), "F and J need C");
  AdvanceArguments<T, D> a;
  a.particles = P;
  a.x = input<T>(x, "x", x, {P, D});
  a.velocity = input<T>(v, "v", x, {P, D});
  a.affine = input<T>(C, "C", x, {P, D, D});
  a.F = input<T>(F, "F", x, {P, D, D});
  a.J = input<T>(J, "J", x, {P});
  set_scene(a, scene, x);
  if (has(scene_dt)) {
    STD_TORCH_CHECK(scene_dt->dim() == 1 && scene_dt->size(0) > 0, "scene_dt must have shape [B], B > 0, got ",
                    shape_of(*scene_dt));
    a.scenes = scene_dt->size(0);
    a.scene_dt = input<T>(scene_dt, "scene_dt", x, {a.scenes});
  }
  a.dt = dt;
  return a;
}

std::tuple<Tensor, Tensor, Tensor> advance(const Tensor& x, const Tensor& v, const OptionalTensor& C,
                                           const OptionalTensor& F, const OptionalTensor& J,
                                           const OptionalTensor& scene, const OptionalTensor& scene_dt, double dt) {
  check_positions(x);
  const int64_t P = x.size(0), D_ = x.size(1);
  Tensor x_next = empty_particles(x, {P, D_}), F_next = result(x, has(F), {P, D_, D_}), J_next = result(x, has(J), {P});
  const DeviceScope device(x);
  dispatch(x, "x", x.size(1), [&]<class T, int D>() {
    auto a = advance_arguments<T, D>(x, v, C, F, J, scene, scene_dt, dt);
    a.x_next = field<T>(x_next);
    a.F_next = field<T>(F_next);
    a.J_next = field<T>(J_next);
    backend::advance(a, device.stream());
  });
  return {x_next, F_next, J_next};
}

// Bits of `needs`, in the order of the returned tensors.
enum Need { kVelocity = 1, kAffine = 2, kDeformation = 4, kVolumeRatio = 8, kDt = 16 };

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> advance_backward(
    const Tensor& grad_x, const OptionalTensor& grad_F, const OptionalTensor& grad_J, const Tensor& x, const Tensor& v,
    const OptionalTensor& C, const OptionalTensor& F, const OptionalTensor& J, const OptionalTensor& scene,
    const OptionalTensor& scene_dt, double dt, int64_t needs) {
  check_positions(x);
  const int64_t P = x.size(0), D_ = x.size(1);
  Tensor gv = result(x, needs & kVelocity, {P, D_}), gC = result(x, (needs & kAffine) && has(C), {P, D_, D_}),
         gF = result(x, (needs & kDeformation) && has(F), {P, D_, D_}),
         gJ = result(x, (needs & kVolumeRatio) && has(J), {P}), gt = result(x, needs & kDt, {P});
  const DeviceScope device(x);
  dispatch(x, "x", x.size(1), [&]<class T, int D>() {
    AdvanceBackwardArguments<T, D> a;
    a.forward = advance_arguments<T, D>(x, v, C, F, J, scene, scene_dt, dt);
    a.grad_x = input<T>(grad_x, "grad_x", x, {P, D});
    STD_TORCH_CHECK(has(grad_F) == has(F) && has(grad_J) == has(J), "grad_F and grad_J must come with F and J");
    a.grad_F = input<T>(grad_F, "grad_F", x, {P, D, D});
    a.grad_J = input<T>(grad_J, "grad_J", x, {P});
    a.velocity = field<T>(gv);
    a.affine = field<T>(gC);
    a.F = field<T>(gF);
    a.J = field<T>(gJ);
    a.dt = field<T>(gt);
    backend::advance_backward(a, device.stream());
  });
  return {gv, gC, gF, gJ, gt};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "advance(Tensor x, Tensor v, Tensor? C, Tensor? F, Tensor? J, Tensor? scene, Tensor? scene_dt, float dt) -> "
      "(Tensor x, Tensor F, Tensor J)");
  m.def(
      "advance_backward(Tensor grad_x, Tensor? grad_F, Tensor? grad_J, Tensor x, Tensor v, Tensor? C, Tensor? F, "
      "Tensor? J, Tensor? scene, Tensor? scene_dt, float dt, int needs) -> (Tensor v, Tensor C, Tensor F, Tensor J, "
      "Tensor dt)");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("advance", TORCH_BOX(&mpm::advance));
  m.impl("advance_backward", TORCH_BOX(&mpm::advance_backward));
}
