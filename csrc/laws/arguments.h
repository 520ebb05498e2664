#pragma once

#include "common/fields.h"
#include "laws/laws.h"

// Arguments of the material kernels.
namespace mpm {

// A parameter that is uniform, per scene or per particle.
template <class T>
struct Parameter {
  const T* pointer = nullptr;
  int64_t stride = 0;  // elements from particle to particle, or from scene to scene
  int64_t scenes = 0;  // entries where it is per scene, 0 otherwise
};

template <class T, int D>
struct LawArguments {
  int law = 0;  // index in AllLaws
  int64_t particles = 0;
  Field<const T> state;        // F [P, D, D] of a law with shear, J [P] of one without
  Field<const T> C;            // [P, D, D], present only for a viscous law
  const int* scene = nullptr;  // int32 [P], where a parameter is per scene
  int64_t scene_stride = 0;
  Parameter<T> parameters[AllLaws::most_parameters];
};

// Which adjoints are wanted.
enum MaterialNeed : int { kState = 1, kVelocityGradient = 2, kParameters = 4 };

template <class T, int D>
struct StressArguments {
  LawArguments<T, D> law;
  Field<T> stress;  // [P, D, D]
};

template <class T, int D>
struct StressBackwardArguments {
  LawArguments<T, D> law;
  Field<const T> grad_stress;
  Field<T> state, C, parameters;  // adjoints per particle, parameters [P, n]; absent where not needed
};

enum class Scalar : int { energy = 0, wave_modulus = 1, stiffness = 2 };

// ψ, or one of the moduli of a law [Pa].
template <class T, int D>
struct ScalarArguments {
  LawArguments<T, D> law;
  Scalar which = Scalar::energy;
  Field<T> value;  // [P]
};

template <class T, int D>
struct EnergyBackwardArguments {
  LawArguments<T, D> law;
  Field<const T> grad_energy;
  Field<T> state, parameters;
};

}  // namespace mpm
