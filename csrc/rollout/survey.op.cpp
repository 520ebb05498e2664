#include "grid/obstacle.op.h"
#include "rollout/kernels.h"

// Limit of the time step, speed and validity of each scene, in one pass over the particles.
namespace mpm {
namespace {

Tensor survey(const Tensor& x, const Tensor& v, const Tensor& mass, const Tensor& volume, const OptionalTensor& C,
              const Tensor& stress, const Tensor& stiffness, const OptionalTensor& viscosity,
              const OptionalTensor& energy, const OptionalTensor& speed, const OptionalTensor& particle_scene,
              double bound, double kept, bool volumetric, double reach, const std::vector<double>& upper,
              int64_t scenes, const OptionalTensor& obstacle_table, const OptionalTensor& obstacle_data,
              std::vector<int64_t> shape, std::vector<int64_t> sizes, std::vector<int64_t> contact_kind,
              std::vector<int64_t> scene, std::vector<double> start, std::vector<double> end,
              const OptionalTensor& scene_time, double time, const std::vector<double>& lattice,
              const std::vector<int64_t>& layout) {
  const PackedLattice packed(lattice, layout);
  check_positions(x);
  STD_TORCH_CHECK(scenes >= 0 && scenes <= INT32_MAX, "scenes must not be negative nor too large, got ", scenes);
  STD_TORCH_CHECK(bound > 0 && kept > 0, "bound and kept must be positive, got ", bound, " and ", kept);
  STD_TORCH_CHECK(int64_t(upper.size()) == x.size(1), "upper must have a number per axis, got ", upper.size());
  const int64_t P = x.size(0);
  Tensor result = empty(x, {scenes, kSurveySize}, ScalarType::Double);
  const DeviceScope device(x);
  backend::clear(result, device.stream());
  dispatch(x, [&]<class T, int D>() {
    SurveyArguments<T, D> a;
    a.particles = P;
    a.scenes = int(scenes);
    set_scene(a, particle_scene, x);
    a.x = input<T>(x, "x", x, {P, D});
    a.v = input<T>(v, "v", x, {P, D});
    a.mass = input<T>(mass, "mass", x, {P});
    a.volume = input<T>(volume, "volume", x, {P});
    a.C = input<T>(C, "C", x, {P, D, D});
    a.stress = input<T>(stress, "stress", x, {P, D, D});
    a.stiffness = input<T>(stiffness, "stiffness", x, {P});
    a.viscosity = input<T>(viscosity, "viscosity", x, {P});
    a.energy = input<T>(energy, "energy", x, {P});
    a.speed = input<T>(speed, "speed", x, {P});
    packed.geometry<T, D>();  // which checks it
    a.dx = packed.dx();
    for (int i = 0; i < D; i++) a.lower[i] = packed.lower()[i], a.upper[i] = upper[i];
    a.bound = bound;
    a.kept = kept;
    a.volumetric = volumetric;
    if (has(obstacle_table)) {
      STD_TORCH_CHECK(has(obstacle_data), "obstacles need data");
      a.contact = obstacle_arguments<T, D>(x, packed, *obstacle_table, obstacle_data.value(), shape, sizes,
                                           contact_kind, scene, start, end, scene_time, time);
      check_scenes(a.contact, scenes);
      a.contact.rounding = T(reach);
    }
    a.result = static_cast<double*>(result.data_ptr());
    backend::survey(a, device.stream());
  });
  return result;
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "survey(Tensor x, Tensor v, Tensor mass, Tensor volume, Tensor? C, Tensor stress, Tensor stiffness, "
      "Tensor? viscosity, Tensor? energy, Tensor? speed, Tensor? scene, float bound, float kept, "
      "bool volumetric, float reach, float[] upper, int scenes, Tensor? obstacles, Tensor? data, int[] shape, "
      "int[] sizes, int[] contact, int[] obstacle_scene, float[] start, float[] end, Tensor? scene_time, float "
      "time, " MPM_LATTICE_SCHEMA ") -> Tensor");
}
#endif

MPM_LIBRARY_IMPL(m) { m.impl("survey", TORCH_BOX(&mpm::survey)); }
