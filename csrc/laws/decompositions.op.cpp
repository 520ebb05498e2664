#include "laws/decompositions.h"
#include "common/backend.h"

#define MPM_DECOMPOSITION_KERNELS(PLAIN, ORDERED, SIZE) \
  PLAIN(svd, SVDArguments)                              \
  PLAIN(polar, PolarArguments)
MPM_BACKEND_KERNELS(MPM_DECOMPOSITION_KERNELS)

// Singular value and polar decompositions of small matrices.
namespace mpm {
namespace {

std::tuple<Tensor, Tensor, Tensor> singular_values_and_vectors(const Tensor& F) {
  Tensor U, sigma, V;
  check_matrices(F, "F");
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    U = empty_particles(F, {F.size(0), D, D});
    sigma = empty_particles(F, {F.size(0), D});
    V = empty_particles(F, {F.size(0), D, D});
    const SVDArguments<T, D> a{F.size(0), field<const T>(F), field<T>(U), field<T>(sigma), field<T>(V)};
    backend::svd(a, device.stream());
  });
  return {U, sigma, V};
}

std::tuple<Tensor, Tensor> polar_decomposition(const Tensor& F) {
  Tensor R, S;
  check_matrices(F, "F");
  const DeviceScope device(F);
  dispatch(F, "F", F.size(1), [&]<class T, int D>() {
    R = empty_particles(F, {F.size(0), D, D});
    S = empty_particles(F, {F.size(0), D, D});
    const PolarArguments<T, D> a{F.size(0), field<const T>(F), field<T>(R), field<T>(S)};
    backend::polar(a, device.stream());
  });
  return {R, S};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("svd3(Tensor F) -> (Tensor U, Tensor sigma, Tensor V)");
  m.def("polar(Tensor F) -> (Tensor R, Tensor S)");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("svd3", TORCH_BOX(&mpm::singular_values_and_vectors));
  m.impl("polar", TORCH_BOX(&mpm::polar_decomposition));
}
