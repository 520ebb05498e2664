#pragma once

#include <array>
#include <cmath>
#include <cstdint>

#include "common/lanes.h"
#include "grid/geometry.h"

// A law is one header with a struct that ends with MPM_REGISTER_LAW(Struct). The struct has
//   name, parameters, history   its name; its parameters and history variables, each a Quantity;
//   field                       field of the deformation that it reads and updates: F, or the volume ratio J alone;
//   viscous                     whether its stress reads the velocity gradient C;
//   plastic                     whether it changes the given deformation or history;
//   additive                    whether its stress is added to that of another law of the same material;
// and, written for any scalar (a number, a pack of numbers, a dual number), the functions of one of two forms: laws of
// strain invariants (laws/invariants.h), which need no decomposition, or laws of principal strains
// (laws/principal_law.h). Their derivatives come from dual numbers. A law may define its own kernel bodies
// (laws/sand.h) where its adjoint needs more.
//
// No other file has to name the law: setup.py compiles laws/law.cpu.cpp, laws/law.cu and rollout/fused_law.cu once for
// each such header, which register its kernels (laws/registry.h, rollout/fused_law.h) for the ops and Python.
#ifndef MPM_REGISTER_LAW
#define MPM_REGISTER_LAW(Law)
#endif

namespace mpm {

// Parameter or history variable: its unit ("" for a pure number) and the range of its values, with inclusive or
// exclusive ends. Infinite ends mean any finite number.
struct Quantity {
  const char* name;
  const char* unit;
  double low = -INFINITY, high = INFINITY;
  bool with_low = true, with_high = true;
  bool matrix = false;           // history only: D by D entries
  const char* option = nullptr;  // history only: the option without which a law does not have it
};

constexpr Quantity real(const char* name, const char* unit) { return {name, unit}; }
constexpr Quantity not_negative(const char* name, const char* unit) { return {name, unit, 0}; }
constexpr Quantity positive(const char* name, const char* unit) { return {name, unit, 0, INFINITY, false}; }

constexpr Quantity matrix(const char* name, const char* unit) {
  return {name, unit, -INFINITY, INFINITY, true, true, true};
}

constexpr Quantity with_option(const char* option, Quantity q) {
  q.option = option;
  return q;
}

// Time step [s] of a rate-dependent law: the last of its parameters.
constexpr Quantity time_step = not_negative("dt", "s");

enum class Deformation : int { gradient, volume_ratio };

constexpr int kMostParameters = 8, kMostHistory = 4;

// Parameter that is uniform, per scene or per particle.
template <class T>
struct Parameter {
  const T* pointer = nullptr;
  int64_t stride = 0;  // elements from particle to particle, or from scene to scene
  int64_t scenes = 0;  // where it is per scene: number of scenes that have one; 0 otherwise
};

template <class T, int D>
struct LawArguments {
  int64_t particles = 0;
  Members members;             // in a mixture: the particles of this law; others are unchanged
  Field<const T> state;        // trial F [P, D, D], or J [P]
  Field<const T> C;            // [P, D, D], may be absent; of viscous laws
  const int* scene = nullptr;  // int32 [P], where a parameter is per scene
  int64_t scene_stride = 0;
  int options = 0;  // bits, in the order of the law's options
  Parameter<T> parameters[kMostParameters];
  Field<const T> history[kMostHistory];  // [P] or [P, D, D]; absent where a law may go without
};

enum FlowBranch : int { kElasticFlow = 0, kPlasticFlow = 1, kApexFlow = 2, kInvalidFlow = 3, kNotConverged = 4 };

// A deformation that is not finite or has no positive volume, or whose stress overflows, is invalid. It is returned
// unchanged with its history. Its stress and moduli are zero, so that it does not affect its neighbours, its energy is
// infinite, and no derivative passes except those of deformation and history with respect to themselves.
template <class T, int D>
struct LawUpdateArguments {
  LawArguments<T, D> law;
  Field<T> state;         // absent for laws that do not change it
  Field<T> stress;        // [P, D, D]
  bool adds = false;      // added to the present stress; for additive laws
  Field<T> history;       // [P, m], absent without history
  Field<T> dissipated;    // [P], absent where not wanted
  Field<T> multiplier;    // [P], length of the plastic increment of the Hencky strains; absent where not wanted
  int* branch = nullptr;  // [P] FlowBranch, plus kNotConverged where a root was not found; absent where not wanted
  // On CUDA: whether this is independent of the preceding activation and the following laws of other particles, so that
  // it can run concurrently.
  bool runs_beside = false;
};

template <class T, int D>
struct LawBackwardArguments {
  LawArguments<T, D> law;
  Field<const T> grad_state, grad_stress, grad_history, grad_dissipated, grad_multiplier;  // each may be absent
  Field<T> state, C, parameters, history;  // adjoints per particle, parameters [P, n], history [P, m]; or absent
  bool adds = false;                       // added to the present values; for laws without changes
};

// Derivative of the adjoints of the stress, along a direction in (state, C, parameters).
template <class T, int D>
struct LawDoubleBackwardArguments {
  LawArguments<T, D> law;
  Field<const T> grad_stress;                             // [P, D, D]
  Field<const T> along_state, along_C, along_parameters;  // each may be absent
  Field<T> stress;                                        // by grad_stress
  Field<T> state, C, parameters;                          // absent where not needed
};

enum class LawScalar : int { energy, stiffness, wave_modulus };

template <class T, int D>
struct LawScalarArguments {
  LawArguments<T, D> law;
  LawScalar which = LawScalar::energy;
  Field<T> value;  // [P] [Pa]
};

template <class T, int D>
struct LawEnergyBackwardArguments {
  LawArguments<T, D> law;
  Field<const T> grad_energy;  // [P]
  Field<T> state, parameters, history;
};

template <class T, int D>
struct LawEnergyDoubleBackwardArguments {
  LawArguments<T, D> law;
  Field<const T> grad_energy;
  Field<const T> along_state, along_parameters;
  Field<T> energy;  // by grad_energy
  Field<T> state, parameters;
};

// Second derivative of the energy at a trial deformation (laws/tangent.h).
template <class T, int D>
struct LawTangentArguments {
  LawArguments<T, D> law;
  Field<const T> before;   // F₀ [P, D, D], or J₀ [P], the start of the trial deformation
  Field<const T> weight;   // [P]
  bool projected = false;  // whether it is made positive semi-definite
  Field<T> tangent;        // [P, kTangentEntries<D>]
};

inline namespace TORCH_MPM_ISA {

template <class Law>
constexpr int kParameters = int(Law::parameters.size());
template <class Law>
constexpr int kHistory = int(Law::history.size());
// Whether a law changes neither deformation nor history.
template <class Law>
constexpr bool kChangesNothing = !Law::plastic && kHistory<Law> == 0;
// Length of arrays for it.
template <class Law>
constexpr int kHistoryLength = kHistory<Law> > 0 ? kHistory<Law> : 1;

constexpr std::array<Quantity, 0> no_history = {};
constexpr std::array<const char*, 0> no_options = {};

// Parameter of the particles `at`. An absent particle, of a negative scene, has that of scene 0. A particle of a scene
// without one has NaN.
template <class At, class T, int D>
MPM_HD typename At::Value load_parameter(const At& at, const LawArguments<T, D>& a, int k) {
  const Parameter<T>& parameter = a.parameters[k];
  if (parameter.scenes) {
    return at.each([&](int64_t p) {
      const int id = a.scene[p * a.scene_stride];
      return id < parameter.scenes ? parameter.pointer[(id > 0 ? id : 0) * parameter.stride] : T(NAN);
    });
  }
  return at.load_shared(parameter.pointer, parameter.stride);
}

// Entry k of a field [P, n].
template <class At, class T>
MPM_HD typename At::Value load_entry(const At& at, const Field<const T>& f, int k) {
  return at.load(f.pointer + k * f.stride[1], f.stride[0]);
}

template <class At, class T>
MPM_HD void store_entry(const At& at, const Field<T>& f, int k, const typename At::Value& value) {
  at.store(f.pointer + k * f.stride[1], f.stride[0], value);
}

// Where a field is absent, zero.
template <int D, class At, class T>
MPM_HD Matrix<typename At::Value, D> load_matrix_or_zero(const At& at, const Field<const T>& f) {
  return f.pointer ? load_matrix<D>(at, f) : zero_matrix<typename At::Value, D>();
}

template <class At, class T>
MPM_HD typename At::Value load_scalar_or_zero(const At& at, const Field<const T>& f) {
  return f.pointer ? at.load(f.pointer, f.stride[0]) : typename At::Value(0);
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
