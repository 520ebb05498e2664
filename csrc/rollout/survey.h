#pragma once

#include "common/lanes.h"
#include "grid/geometry.h"
#include "grid/shapes.h"

// Quantities of the particles between two steps of a run: limit of the time step, speed, number of invalid particles.
namespace mpm {

enum Survey : int {
  kRate = 0,   // largest 1/dt of the limits of torch_mpm/step/stability.py [1/s]
  kSpeed = 1,  // largest speed [m/s]
  kWrong = 2,  // particles that are not finite, outside the domain, or without a meaning for their law
  kSurveySize = 3,
};

template <class T, int D>
struct SurveyArguments {
  int64_t particles = 0;
  int scenes = 1;
  const int* scene = nullptr;
  int64_t scene_stride = 0;
  // Stress, tangent modulus, viscosity and energy density are those of the law; C, viscosity, energy and the speed of
  // obstacles near each particle may be absent.
  Field<const T> x, v, mass, volume, C, stress, stiffness, viscosity, energy, speed;
  double dx = 0, lower[D], upper[D];
  double bound = 0;                // of |∇v|²/|v|² on the nodes [1/m²]
  double kept = 0;                 // 1 + s, the factor of 1/dt² in the linear limit
  bool volumetric = false;         // whether some law follows the volume alone
  ContactArguments<T, D> contact;  // obstacles that move; their `rounding` is how near a particle must be
  double* result = nullptr;        // [scenes, kSurveySize], zero on entry
};

inline namespace TORCH_MPM_ISA {

// A particle of no scene counts in one of them.
template <class T, int D>
MPM_HD int scene_of(const SurveyArguments<T, D>& a, int64_t p) {
  const int scene = a.scene ? a.scene[p * a.scene_stride] : 0;
  return scene < 0 ? 0 : scene < a.scenes ? scene : a.scenes - 1;
}

template <class T>
struct Surveyed {
  T rate, speed;
  bool wrong;
};

// √(a² + b²) of numbers that are not negative, without overflow.
template <class T>
MPM_HD T root_of_squares(T a, T b) {
  const T largest = a > b ? a : b;
  if (!(largest > T(0)) || !is_finite<1>(&largest)) return a + b;
  a /= largest, b /= largest;
  return largest * sqrt(a * a + b * b);
}

template <class T, int D>
MPM_HD T norm(const Matrix<T, D>& m) {
  double squares = 0;  // in double: squares of large stresses overflow in float
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) squares += double(m[i][j]) * double(m[i][j]);
  return T(sqrt(squares));
}

// Largest speed of the obstacles that a particle may touch.
template <class T, int D>
MPM_HD T obstacle_speed(const ContactArguments<T, D>& a, const Vector<T, D>& x, int scene) {
  T fastest = T(0);
  for (int k = 0; k < a.obstacles; k++) {
    const ObstacleRow<T, D>& row = a.row[(a.rows == 1 ? 0 : scene) * int64_t(a.obstacles) + k];
    const ObstaclePose<T, D> pose = obstacle_pose(a, a.kind[k], row, scene);
    if (!pose.acts) continue;
    Vector<T, D> normal;
    const bool touching = surface(pose, to_body(pose, x), normal) <= a.rounding;
    const T speed = touching ? length(velocity_at(pose, x)) : T(0);
    fastest = speed > fastest ? speed : fastest;
  }
  return fastest;
}

// 1/dt of the linear limit: the positive root of kept/dt² − λ_v/dt − λ_e/2.
template <class T, int D>
MPM_HD T oscillation_rate(const SurveyArguments<T, D>& a, const One<T>& at, const T& inverse_inertia) {
  const T kept = T(a.kept), elastic = load_scalar(at, a.stiffness) * inverse_inertia;
  if (!a.viscosity.pointer) return sqrt(elastic / (2 * kept));
  const T viscous = 2 * load_scalar(at, a.viscosity) * inverse_inertia;
  return (viscous + root_of_squares(viscous, sqrt(2 * kept * elastic))) / (2 * kept);
}

// 1/dt of the largest change of a stretch or a volume in a step: the positive root of change/dt² − g/dt − h.
template <class T, int D>
MPM_HD T deformation_rate(const SurveyArguments<T, D>& a, const One<T>& at, const T& inverse_inertia, const T& speed) {
  constexpr double change = 0.5;  // of torch_mpm/step/stability.py
  T gradient = T(std::sqrt(a.bound)) * speed;
  if (a.C.pointer) gradient = root_of_squares(gradient, norm(load_matrix<D>(at, a.C)));
  T growth = norm(load_matrix<D>(at, a.stress)) * inverse_inertia;
  if (a.volumetric) gradient *= T(std::sqrt(double(D))), growth *= T(std::sqrt(double(D)));
  return (gradient + root_of_squares(gradient, 2 * sqrt(T(change) * growth))) / T(2 * change);
}

template <class T, int D>
MPM_HD Surveyed<T> survey_particle(const SurveyArguments<T, D>& a, int64_t p, int scene) {
  const One<T> at{p};
  const Vector<T, D> x = load_vector<D>(at, a.x), v = load_vector<D>(at, a.v);
  Surveyed<T> s;
  s.speed = length(v);
  s.wrong = !is_finite<D>(x.e) || !is_finite<D>(v.e);
  MPM_UNROLL for (int i = 0; i < D; i++)
    s.wrong = s.wrong || double(x[i]) < a.lower[i] - a.dx || double(x[i]) > a.upper[i] + a.dx;
  if (a.energy.pointer) {
    const T energy = load_scalar(at, a.energy);
    s.wrong = s.wrong || !is_finite<1>(&energy);
  }
  T speed = s.speed;
  const auto at_least = [&](const T& other) {
    if (other > speed) speed = other;
  };
  if (a.speed.pointer) at_least(load_scalar(at, a.speed));
  if (a.contact.obstacles > 0) at_least(obstacle_speed(a.contact, x, scene));
  const T inverse_inertia = T(a.bound) * load_scalar(at, a.volume) / load_scalar(at, a.mass);
  const T oscillation = oscillation_rate(a, at, inverse_inertia) + speed / T(a.dx);
  const T deformation = deformation_rate(a, at, inverse_inertia, speed);
  // A rate that is NaN is unknown and sets no limit.
  s.rate = oscillation > T(0) ? oscillation : T(0);
  if (deformation > s.rate) s.rate = deformation;
  if (!(s.speed >= T(0))) s.speed = T(0);
  return s;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
