#pragma once

#include <cmath>

#include "math/host_device.h"

// Elementary functions under one name for every scalar type: here for float and double, in math/dual.h and
// math/pack.h for dual numbers and packs.
namespace mpm {
inline namespace TORCH_MPM_ISA {

MPM_HD float expm1(float x) { return ::expm1f(x); }
MPM_HD double expm1(double x) { return ::expm1(x); }
MPM_HD float sqrt(float x) { return ::sqrtf(x); }
MPM_HD double sqrt(double x) { return ::sqrt(x); }
MPM_HD float abs(float x) { return ::fabsf(x); }
MPM_HD double abs(double x) { return ::fabs(x); }
MPM_HD float max(float a, float b) { return a > b ? a : b; }
MPM_HD double max(double a, double b) { return a > b ? a : b; }
MPM_HD float select(bool condition, float a, float b) { return condition ? a : b; }
MPM_HD double select(bool condition, double a, double b) { return condition ? a : b; }
MPM_HD float value_of(float x) { return x; }
MPM_HD double value_of(double x) { return x; }

// ln a of a = 1 + a_minus_1, given both because each is inaccurate where the other is accurate.
MPM_HD float log_1p(float a, float a_minus_1) { return ::fabsf(a_minus_1) < 0.5f ? ::log1pf(a_minus_1) : ::logf(a); }
MPM_HD double log_1p(double a, double a_minus_1) { return ::fabs(a_minus_1) < 0.5 ? ::log1p(a_minus_1) : ::log(a); }

// (eˣ − 1)/x, also at x = 0.
template <class T>
MPM_HD T expm1_quotient(const T& x) {
  if (!(abs(value_of(x)) < 0.5)) return expm1(x) / x;
  T r = T(1);
  for (int k = 15; k > 1; k--) r = T(1) + r * x * T(1.0 / k);
  return r;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
