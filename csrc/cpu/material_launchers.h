#pragma once

#include "cpu/launchers.h"
#include "materials/arguments.h"

namespace mpm::cpu {

template <class T, int D>
void material_stress(const StressArguments<T, D>&, Stream);
template <class T, int D>
void material_stress_backward(const StressBackwardArguments<T, D>&, Stream);
template <class T, int D>
void material_scalar(const ScalarArguments<T, D>&, Stream);
template <class T, int D>
void material_energy_backward(const EnergyBackwardArguments<T, D>&, Stream);

}  // namespace mpm::cpu
