// torch_mpm._math: the torch-free math headers as numpy functions, for tests and exploration.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <string>
#include <vector>

#include "common/bspline.h"
#include "common/pack.h"
#include "laws/neo_hookean.h"
#include "laws/quartic_return_map.h"
#include "laws/weakly_compressible.h"

namespace py = pybind11;
using namespace mpm;

namespace {

template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;

void require(bool condition, const char* message) {
  if (!condition) throw py::value_error(message);
}

// Weights (derivative 0) or their derivatives, [n, order + 1], of the distances f [n] from the base node in cells.
template <int Order>
Array<double> weights(const Array<double>& f, int derivative) {
  Array<double> result({f.size(), py::ssize_t(Order + 1)});
  for (py::ssize_t i = 0; i < f.size(); i++) {
    double* w = result.mutable_data() + i * (Order + 1);
    if (derivative == 0) BSpline<Order>::weights(f.data()[i], w);
    if (derivative == 1) BSpline<Order>::first_derivatives(f.data()[i], w);
    if (derivative == 2) BSpline<Order>::second_derivatives(f.data()[i], w);
  }
  return result;
}

Array<double> bspline(const Array<double>& f, int order, int derivative) {
  require(f.ndim() == 1, "f must have shape [n]");
  require(order == 2 || order == 3, "order must be 2 or 3");
  require(derivative >= 0 && derivative <= 2, "derivative must be 0, 1 or 2");
  return order == 2 ? weights<2>(f, derivative) : weights<3>(f, derivative);
}

// An elementwise function of arrays of one shape [n], evaluated in the lanes of packs as the CPU kernels do.
template <class T, class F, class... A>
Array<T> in_packs(const F& f, py::ssize_t n, const A&... arrays) {
  constexpr int lanes = 8;
  using P = Pack<T, lanes>;
  Array<T> result(n);
  for (py::ssize_t i = 0; i < n; i += lanes) {
    const int count = int(std::min<py::ssize_t>(lanes, n - i));
    const auto load = [&](const Array<T>& a) {
      P p(1.0);
      for (int k = 0; k < count; k++) p.set(k, a.data()[i + k]);
      return p;
    };
    const P r = f(load(arrays)...);
    for (int k = 0; k < count; k++) result.mutable_data()[i + k] = r[k];
  }
  return result;
}

template <class T>
Array<T> pack_expm1(const Array<T>& x) {
  return in_packs<T>([](const auto& p) { return expm1(p); }, x.size(), x);
}

template <class T>
Array<T> pack_log_1p(const Array<T>& a, const Array<T>& a_minus_1) {
  require(a.size() == a_minus_1.size(), "a and a_minus_1 must have one size");
  return in_packs<T>([](const auto& p, const auto& q) { return log_1p(p, q); }, a.size(), a, a_minus_1);
}

// f(strain, parameters) of a named law at one F [D, D]; the strain of a fluid is that of J = det F.
template <int D, class Function>
void at_strain(const std::string& name, const Array<double>& F_, const std::vector<double>& parameters,
               const Function& f) {
  Matrix<double, D> F;
  for (int i = 0; i < D; i++)
    for (int j = 0; j < D; j++) F[i][j] = F_.data()[i * D + j];
  bool found = false;
  const auto try_law = [&]<class Law>() {
    if (name != Law::name) return;
    found = true;
    require(int(parameters.size()) == kParameters<Law>, "the law has another number of parameters");
    f.template operator()<Law>(strain_of_deformation(F, zero_matrix<double, D>()), parameters.data());
  };
  try_law.template operator()<NeoHookean>();
  try_law.template operator()<WeaklyCompressible>();
  try_law.template operator()<ViscousFluid>();
  require(found, "there is no law of this name");
}

template <class Function>
void dispatch(const std::string& law, const Array<double>& F_, const std::vector<double>& parameters,
              const Function& f) {
  const py::ssize_t D = F_.ndim() == 2 ? F_.shape(0) : 0;
  require((D == 2 || D == 3) && F_.shape(1) == D, "F must have shape [2, 2] or [3, 3]");
  D == 2 ? at_strain<2>(law, F_, parameters, f) : at_strain<3>(law, F_, parameters, f);
}

py::dict evaluate(const std::string& law, const Array<double>& F_, const std::vector<double>& parameters) {
  py::dict result;
  dispatch(law, F_, parameters, [&]<class Law, int D>(const Strain<double, D>& s, const double* p) {
    const Matrix<double, D> tau = Law::stress(s, p);
    Array<double> stress({py::ssize_t(D), py::ssize_t(D)});
    for (int i = 0; i < D * D; i++) stress.mutable_data()[i] = tau[i / D][i % D];
    result["energy"] = Law::energy(s, p);
    result["stress"] = stress;
    result["wave_modulus"] = Law::wave_modulus(s, p);
    result["stiffness"] = Law::stiffness(s, p);
  });
  return result;
}

// Map of up to 8 strains in one pack; separate from code that may throw, with which GCC 12 cannot align the stack.
template <class Energy, class T>
__attribute__((noinline)) MappedStrain<Pack<T, 8>, 3> map_pack(const T* h, const T* alpha, const T* ratio, int count) {
  using P = Pack<T, 8>;
  Vector<P, 3> strain;
  Cone<P> cone;
  for (int lane = 0; lane < 8; lane++) {
    const int i = std::min(lane, count - 1);
    for (int k = 0; k < 3; k++) strain[k].set(lane, h[3 * i + k]);
    cone.alpha.set(lane, alpha[i]);
    cone.ratio.set(lane, ratio[i]);
  }
  return return_map<Energy, P>(strain, cone, P(0) == P(0), P(0) < P(0), false);
}

// Result of one lane: the strain, the branch plus 4 where the root was not found, and the number of evaluations of the
// yield function.
template <class T>
__attribute__((noinline)) void read_lane(const MappedStrain<Pack<T, 8>, 3>& m, int lane, T* h, int* branch,
                                         int* steps) {
  for (int k = 0; k < 3; k++) h[k] = m.h[k][lane];
  const int kind = m.cone[lane] ? kCone : m.apex[lane] ? kApex : kElastic;
  *branch = kind + 4 * !m.converged[lane];
  *steps = int(m.steps[lane]);
}

template <class Energy, class T>
__attribute__((noinline)) void map_all(const T* h, const T* alpha, const T* ratio, py::ssize_t n, T* mapped,
                                       int* branch, int* steps) {
  for (py::ssize_t i = 0; i < n; i += 8) {
    const int count = int(std::min<py::ssize_t>(8, n - i));
    const MappedStrain<Pack<T, 8>, 3> m = map_pack<Energy>(h + 3 * i, alpha + i, ratio + i, count);
    for (int lane = 0; lane < count; lane++)
      read_lane(m, lane, mapped + 3 * (i + lane), branch + i + lane, steps + i + lane);
  }
}

// Mapped strains [n, 3], branches and evaluations of the yield function [n] of trial strains, in packs of 8.
template <class Energy, class T>
py::tuple map_strains(const Array<T>& h, const Array<T>& alpha, const Array<T>& ratio) {
  const py::ssize_t n = alpha.size();
  Array<T> mapped({n, py::ssize_t(3)});
  Array<int> branch(n), steps(n);
  map_all<Energy>(h.data(), alpha.data(), ratio.data(), n, mapped.mutable_data(), branch.mutable_data(),
                  steps.mutable_data());
  return py::make_tuple(mapped, branch, steps);
}

template <class T>
py::tuple sand_return_map(const Array<T>& h, const Array<T>& alpha, const Array<T>& ratio, const std::string& energy,
                          const std::string& flow) {
  const py::ssize_t n = alpha.size();
  require(h.ndim() == 2 && h.shape(0) == n && h.shape(1) == 3 && ratio.size() == n, "h must have shape [n, 3]");
  const bool exact = flow == "exact";
  if (energy == "full")
    return exact ? map_strains<ExactFlow<FullQuartic>>(h, alpha, ratio) : map_strains<FullQuartic>(h, alpha, ratio);
  if (energy == "unilateral")
    return exact ? map_strains<ExactFlow<UnilateralQuartic>>(h, alpha, ratio)
                 : map_strains<UnilateralQuartic>(h, alpha, ratio);
  if (energy == "mixed")
    return exact ? map_strains<ExactFlow<MixedQuartic>>(h, alpha, ratio) : map_strains<MixedQuartic>(h, alpha, ratio);
  require(energy == "hencky", "there is no energy of this name");
  return map_strains<Quadratic>(h, alpha, ratio);
}

double eigenvalue_bound(const Array<double>& a) {
  require(a.ndim() == 2 && a.shape(0) == 3 && a.shape(1) == 3, "a must have shape [3, 3]");
  Matrix<double, 3> m;
  for (int i = 0; i < 9; i++) m[i / 3][i % 3] = a.data()[i];
  return largest_eigenvalue_bound(m);
}

}  // namespace

PYBIND11_MODULE(_math, m) {
  m.doc() = "Scalar functions of torch_mpm's math headers, bound to numpy for tests and exploration.";
  m.attr("__version__") = TORCH_MPM_VERSION;
  m.def(
      "bspline", &bspline, py::arg("f"), py::arg("order"), py::arg("derivative") = 0,
      "Weights [n, order + 1] of the nodes from the base node on, or their derivatives, at distances f [n] in cells.");
  m.def("expm1", &pack_expm1<float>, py::arg("x").noconvert(), "eˣ − 1 of float32 [n], as the CPU kernels compute it.");
  m.def("expm1", &pack_expm1<double>, py::arg("x"), "eˣ − 1 of float64 [n].");
  m.def("log_1p", &pack_log_1p<float>, py::arg("a").noconvert(), py::arg("a_minus_1").noconvert(),
        "ln a of float32 [n] from a and a − 1, as the CPU kernels compute it.");
  m.def("log_1p", &pack_log_1p<double>, py::arg("a"), py::arg("a_minus_1"), "ln a of float64 [n] from a and a − 1.");
  m.def("evaluate_law", &evaluate, py::arg("law"), py::arg("F"), py::arg("parameters"),
        "Energy, stress [D, D], wave modulus and stiffness of a law at F [D, D], without its checks for a valid F.");
  m.def("sand_return_map", &sand_return_map<float>, py::arg("h").noconvert(), py::arg("alpha").noconvert(),
        py::arg("ratio").noconvert(), py::arg("energy"), py::arg("flow"),
        "Return map of float32 Hencky strains h [n, 3] with slopes alpha and λ/μ [n], as the CPU kernels compute it: "
        "mapped strains, branches plus 4 where the root was not found, and evaluations of the yield function.");
  m.def("sand_return_map", &sand_return_map<double>, py::arg("h"), py::arg("alpha"), py::arg("ratio"),
        py::arg("energy"), py::arg("flow"), "The same of float64.");
  m.def("largest_eigenvalue_bound", &eigenvalue_bound, py::arg("a"),
        "Upper bound of the largest eigenvalue of a symmetric [3, 3] matrix.");
}
