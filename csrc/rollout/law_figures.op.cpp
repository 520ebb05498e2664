#include "rollout/inputs.h"

// Values of the laws for a survey: stress, tangent modulus and energy of each particle, by its own law.
namespace mpm {
namespace {

struct FiguresInputs {
  Tensor x;
  OptionalTensor C, F, J;
  OptionalTensor scene, material;
};

struct Figures {
  Tensor stress, stiffness, energy;  // energy if wanted
};

template <class T, int D>
void scalar_of(const LawKernels<T, D>& kernels, const LawArguments<T, D>& law, LawScalar which, Tensor& value,
               backend::Stream stream) {
  kernels.scalar({law, which, field<T>(value)}, stream);
}

template <class T, int D>
void figures_of(const FiguresInputs& in, const LawCall& call, Figures& out, backend::Stream stream) {
  const LawKernels<T, D>& kernels = kernels_of<T, D>(*call.law);
  LawUpdateArguments<T, D> a;
  const OptionalTensor C = call.law->info.viscous ? in.C : OptionalTensor{};
  a.law = law_arguments<T, D>(call, in.x, in.F, in.J, C, in.scene, in.material);
  a.stress = field<T>(out.stress);
  Tensor mapped, moved;  // deformation and history after the return map
  if (call.law->info.plastic) a.state = field<T>(mapped = empty_particles(in.x, {in.x.size(0), D, D}));
  const int64_t columns = history_size(call.law->info, call.history, D);
  if (columns > 0) a.history = field<T>(moved = empty_particles(in.x, {in.x.size(0), columns}));
  // Lanes of a pack with particles of other laws are read too, and a decomposition ends when all lanes have converged:
  // old contents of memory must not affect the rounding of a member.
  for (Tensor* t : {&mapped, &moved})
    if (t->defined() && in.x.is_cpu() && has(in.material)) torch::stable::zero_(*t);
  kernels.update(a, stream);
  scalar_of(kernels, a.law, LawScalar::stiffness, out.stiffness, stream);
  if (!out.energy.defined()) return;
  if (mapped.defined()) a.law.state = field<const T>(mapped);
  set_history(a.law, call, constant(a.history), 0);
  scalar_of(kernels, a.law, LawScalar::energy, out.energy, stream);
}

std::tuple<Tensor, Tensor, Tensor> law_figures(const Tensor& x, const OptionalTensor& C, const OptionalTensor& F,
                                               const OptionalTensor& J, const Tensors& history,
                                               const OptionalTensor& scene, const OptionalTensor& material,
                                               std::string laws, std::vector<int64_t> options,
                                               const Tensors& parameters, std::vector<int64_t> variables, bool energy) {
  check_positions(x);
  const int64_t P = x.size(0), D = x.size(1);
  const std::vector<LawCall> calls = law_calls(laws, options, parameters, history, variables, D);
  check_material(material, calls, x);
  for (const LawCall& call : calls) STD_TORCH_CHECK(!call.adds, "laws must be one of each material, got ", laws);
  const FiguresInputs in{x, C, F, J, scene, material};
  Figures out{empty_particles(x, {P, D, D}), empty_particles(x, {P}), energy ? empty_particles(x, {P}) : Tensor()};
  const DeviceScope device(x);
  if (has(material)) {  // particles without a law
    for (Tensor* t : {&out.stress, &out.stiffness, &out.energy})
      if (t->defined()) torch::stable::zero_(*t);
  }
  dispatch(x, [&]<class T, int Dim>() {
    input<T>(C, "C", x, {P, Dim, Dim});  // checked also if no law reads it
    input<T>(F, "F", x, {P, Dim, Dim});
    input<T>(J, "J", x, {P});
    for (const LawCall& call : calls) figures_of<T, Dim>(in, call, out, device.stream());
  });
  return {out.stress, out.stiffness, out.energy};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def(
      "law_figures(Tensor x, Tensor? C, Tensor? F, Tensor? J, Tensor[] history, Tensor? scene, Tensor? material, "
      "str laws, int[] options, Tensor[] parameters, int[] variables, bool energy) -> (Tensor stress, "
      "Tensor stiffness, Tensor energy)");
}
#endif

MPM_LIBRARY_IMPL(m) { m.impl("law_figures", TORCH_BOX(&mpm::law_figures)); }
