// torch_mpm._math: the torch-free math headers as numpy functions, for tests and exploration.
#include <pybind11/pybind11.h>

PYBIND11_MODULE(_math, m) {
  m.doc() = "Scalar functions of torch_mpm's math headers, bound to numpy for tests and exploration.";
  m.attr("__version__") = TORCH_MPM_VERSION;
}
