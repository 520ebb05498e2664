#pragma once

#include "cpu/launchers.h"
#include "materials/principal_kernels.h"

namespace mpm::cpu {

template <class T, int D>
void principal_update(const PrincipalUpdateArguments<T, D>&, Stream);
template <class T, int D>
void principal_backward(const PrincipalBackwardArguments<T, D>&, Stream);
template <class T, int D>
void principal_scalar(const PrincipalScalarArguments<T, D>&, Stream);
template <class T, int D>
void principal_energy_backward(const PrincipalEnergyBackwardArguments<T, D>&, Stream);

}  // namespace mpm::cpu
