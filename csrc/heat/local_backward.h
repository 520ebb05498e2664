#pragma once

#include "heat/backward.h"
#include "heat/local.h"
#include "pointwise/heat.h"

// Adjoint of a step of heat at one node, particle or slot: the formulas of the step, differentiated by dual numbers,
// and by formulas where an input is a matrix. The loops of both backends go over them.
namespace mpm {
inline namespace TORCH_MPM_ISA {

template <class At, class T>
MPM_HD typename At::Value load_value(const At& at, const HeatValue<T>& v, int scene) {
  using V = typename At::Value;
  if (v.per_scene || v.stride == 0) return V(v.pointer[v.per_scene ? scene * v.stride : 0]);
  return at.load(v.pointer, v.stride);
}

// Time step of a scene.
template <class T>
MPM_HD T step_of_scene(const Field<const T>& scene_dt, double dt, int scene) {
  return scene_dt.pointer ? T(dt) * scene_dt.pointer[scene * scene_dt.stride[0]] : T(dt);
}

// Column k of a field [P, K] or [P, K, D].
template <class T>
MPM_HD Field<T> entry(const Field<T>& f, int k) {
  return {f.pointer + k * f.stride[1], {f.stride[0], f.stride[2], 0}};
}

template <class At, class T>
MPM_HD void add_scalar(const At& at, const Field<T>& f, const typename At::Value& value) {
  if (f.pointer) store_scalar(Adding<At>(at), f, value);
}

// Adds to the adjoint of a parameter, if it is wanted.
template <class At, class T>
MPM_HD void add_parameter(const At& at, const Field<T>& f, HeatParameter k, const typename At::Value& value) {
  if (f.pointer) store_scalar(Adding<At>(at), entry(f, k), value);
}

// What a particle has gathered: values of channels, and their moments about it.
template <class V, int D, int Channels>
struct HeatGathered {
  V value[Channels];
  Vector<V, D> moment[Channels];
};

// Derivatives of a sum by its inputs; f returns its derivative at dual inputs. All evaluations are unrolled, so that
// the inputs stay in registers; these must be few.
template <int N, class V, class F>
MPM_HD void pull_back(const V (&in)[N], V (&grad)[N], const F& f) {
  static_assert(N <= 6);
  MPM_UNROLL for (int n = 0; n < N; n++) {
    Dual<V> x[N];
    MPM_UNROLL for (int k = 0; k < N; k++)
      x[k] = {in[k], V(k == n ? 1 : 0)};
    grad[n] = f(x);
  }
}

// Replaces the adjoints of θ and the liquid fraction by those before melting; θ is that after G2P.
template <class At, class T, int D>
MPM_HD void pull_back_melting(const HeatToParticlesBackwardArguments<T, D>& a, const At& at, int scene,
                              const typename At::Value& theta, typename At::Value& grad_theta) {
  using V = typename At::Value;
  using Melt = Applied<HeatMelt, D>;
  const HeatToParticlesArguments<T, D>& f = a.forward;
  const V in[] = {theta,
                  load_scalar(at, f.particles.liquid),
                  load_value(at, f.melting_point, scene),
                  load_value(at, f.specific_heat, scene),
                  load_value(at, f.latent_heat, scene),
                  load_scalar(at, f.number)};
  const V adjoint[] = {grad_theta, load_scalar(at, constant(a.liquid)), V(0)};
  V grad[Melt::kIn];
  Melt::pull_back(in, adjoint, [](int n) { return n < Melt::kIn - 1; }, [&](int n, const V& sum) { grad[n] = sum; });
  grad_theta = grad[0];
  store_scalar(at, a.liquid, grad[1]);
  add_parameter(at, a.parameters, kMeltingPoint, grad[2]);
  add_parameter(at, a.parameters, kSpecificHeat, grad[3]);
  add_parameter(at, a.parameters, kLatentHeat, grad[4]);
}

// Adjoints of the inputs of `blended`; that of β is added.
template <class V>
struct BlendedAdjoint {
  V increment, average, before;
};

template <class V>
MPM_HD BlendedAdjoint<V> pull_back_blended(const V& increment, const V& average, const V& before, const V& blend,
                                           const V& adjoint, V& by_blend) {
  const V in[] = {increment, average, before, blend};
  V grad[4];
  pull_back(in, grad, [&](const Dual<V>(&x)[4]) { return adjoint * blended(x[0], x[1], x[2], x[3]).derivative; });
  by_blend = by_blend + grad[3];
  return {grad[0], grad[1], grad[2]};
}

// Replaces the adjoint of the gradient after its transport by that before it; those of ∇v and dt are added. The
// transport is g − first + second, with first = dt ∇vᵀ g and second = dt ∇vᵀ first.
template <class At, class T, int D>
MPM_HD void pull_back_transport(const HeatToParticlesBackwardArguments<T, D>& a, const At& at,
                                const Vector<typename At::Value, D>& gradient, const typename At::Value& dt,
                                Vector<typename At::Value, D>& adjoint) {
  using V = typename At::Value;
  const Matrix<V, D> L = load_matrix<D>(at, a.forward.velocity_gradient);
  const Vector<V, D> turned = transpose(L) * gradient, first = dt * turned, by_second = adjoint;
  const Vector<V, D> by_first = dt * (L * by_second) + V(-1) * by_second;
  Matrix<V, D> by_L;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = 0; j < D; j++) by_L[i][j] = dt * (gradient[i] * by_first[j] + first[i] * by_second[j]);
  adjoint = by_second + dt * (L * by_first);
  store_matrix<D>(Adding<At>(at), a.velocity_gradient, by_L);
  if (a.dt.pointer) add_scalar(at, a.dt, dot(by_first, turned) + dot(by_second, transpose(L) * first));
}

// At particles inside the grid, from the increment and θ̄; the moments are times D⁻¹. Particles outside keep their
// temperature, so that its adjoint is unchanged.
template <bool Affine, class At, class T, int D>
MPM_HD void heat_of_particles_backward(const HeatToParticlesBackwardArguments<T, D>& a, const At& at, int scene,
                                       const typename At::Value& dt,
                                       const HeatGathered<typename At::Value, D, 2>& gathered) {
  using V = typename At::Value;
  const HeatToParticlesArguments<T, D>& f = a.forward;
  const V theta = load_scalar(at, f.particles.theta), blend = load_scalar(at, f.blend);
  V by_theta = load_scalar(at, constant(a.theta)), by_blend(0);
  if (a.liquid.pointer)
    pull_back_melting(a, at, scene, blended(gathered.value[0], gathered.value[1], theta, blend), by_theta);
  const BlendedAdjoint<V> by =
      pull_back_blended(gathered.value[0], gathered.value[1], theta, blend, by_theta, by_blend);
  if constexpr (Affine) {
    const Vector<V, D> before = load_vector<D>(at, f.particles.gradient);
    const auto &increment = gathered.moment[0], &average = gathered.moment[1];
    Vector<V, D> after, adjoint = load_vector<D>(at, constant(a.gradient)), by_increment, by_average;
    MPM_UNROLL for (int d = 0; d < D; d++)
      after[d] = blended(increment[d], average[d], before[d], blend);
    pull_back_transport(a, at, after, dt, adjoint);
    MPM_UNROLL for (int d = 0; d < D; d++) {
      const BlendedAdjoint<V> b = pull_back_blended(increment[d], average[d], before[d], blend, adjoint[d], by_blend);
      by_increment[d] = b.increment, by_average[d] = b.average, adjoint[d] = b.before;
    }
    store_vector<D>(at, entry(a.moment, kHeatIncrement), V(T(f.moment_scale)) * by_increment);
    store_vector<D>(at, entry(a.moment, kHeatAverage), V(T(f.moment_scale)) * by_average);
    store_vector<D>(at, a.gradient, adjoint);
  }
  store_scalar(at, entry(a.value, kHeatIncrement), by.increment);
  store_scalar(at, entry(a.value, kHeatAverage), by.average);
  store_scalar(at, a.theta, by.before);
  store_scalar(at, a.blend, by_blend);
}

// A term at a node of a block of a scene: the solve adds λ · (power − coefficient (θ + d)) to the adjoints.
template <class T, int D>
struct DualTerm {
  const HeatTermBackwardArguments<T, D>& a;
  Vector<Dual<T>, D> normal;
  Dual<T> theta, first, second, reference;
  T multiplier, after;

  MPM_HD DualTerm(const HeatTermBackwardArguments<T, D>& arguments, int scene, int64_t i) : a(arguments) {
    const HeatTermArguments<T, D>& f = a.forward;
    const auto lifted = [](const T& value) { return Dual<T>{value, T(0)}; };
    const Vector<T, D> at_node = normal_of_node(f, i);
    MPM_UNROLL for (int d = 0; d < D; d++)
      normal[d] = lifted(at_node[d]);
    theta = lifted(f.theta[i]);
    first = lifted(f.number[2 * int64_t(scene)]);
    second = lifted(f.number[2 * int64_t(scene) + 1]);
    reference = lifted(T(f.reference));
    multiplier = a.multiplier[i];
    after = f.theta[i] + a.sums[i * kHeatChannels + kHeatTheta];
  }

  // By one of the inputs.
  MPM_HD T by(Dual<T>& input) const {
    input.derivative = T(1);
    const HeatRadiationAt<Dual<T>> linear = heat_of_term(a.forward.term, normal, theta, first, second, reference);
    input.derivative = T(0);
    return multiplier * (linear.power.derivative - after * linear.coefficient.derivative);
  }
};

template <class T, int D>
MPM_HD void heat_of_term_backward(const HeatTermBackwardArguments<T, D>& a, int scene, int64_t i) {
  T* const surface = a.surface + i * kHeatChannels;
  if (a.forward.term == HeatTerm::power) {
    surface[0] += a.multiplier[i];
    return;
  }
  DualTerm<T, D> term(a, scene, i);
  MPM_UNROLL for (int d = 0; d < D; d++)
    surface[1 + d] += term.by(term.normal[d]);
  a.theta[i] += term.by(term.theta);
}

template <class T, int D>
MPM_HD void heat_numbers_of_slot(const HeatNumbersBackwardArguments<T, D>& a, int scene, const int (&)[D],
                                 int64_t slot) {
  T first(0), second(0);
  for (int64_t i = slot * kBlockNodes<D>; i < (slot + 1) * kBlockNodes<D>; i++) {
    DualTerm<T, D> term(a.term, scene, i);
    first += term.by(term.first);
    second += term.by(term.second);
  }
  T* const to = a.to.sums + slot * a.to.columns + a.to.first;
  to[0] = first;
  to[1] = second;
}

// Increments lead from the averages to the held temperature, from which heat flows to the other nodes.
template <class T, int D>
MPM_HD void held_temperature_of_slot(const HeatHeldBackwardArguments<T, D>& a, int scene, const int (&corner)[D],
                                     int64_t slot) {
  const ObstaclePose<T, D> pose = pose_of(a.hold.contact, a.hold.obstacle, scene);
  T sum(0);
  for (int local = 0; pose.acts && local < kBlockNodes<D>; local++) {
    const int64_t i = slot * kBlockNodes<D> + local;
    if (!a.hold.fixed[i] || a.counted[i] || !is_held(a.hold, pose, corner, local)) continue;
    a.counted[i] = true;
    sum += a.adjoints[kHeatSolved * i + kIncrementAdjoint] - a.product[i];
  }
  a.to.sums[slot * a.to.columns + a.to.first] = sum;
}

template <class T, int D>
MPM_HD void surface_temperature_of_slot(const HeatSurfaceTemperatureBackwardArguments<T, D>& a, int, const int (&)[D],
                                        int64_t slot) {
  T sum(0);
  for (int64_t i = slot * kBlockNodes<D>; i < (slot + 1) * kBlockNodes<D>; i++) sum += a.multiplier[i] * a.exchange[i];
  a.to.sums[slot * a.to.columns + a.to.first] = sum;
}

// At a node of a block of a scene.
template <class T, int D>
MPM_HD void heat_of_node_backward(const HeatNodesBackwardArguments<T, D>& a, int scene, int64_t i) {
  using Means = Applied<HeatMeans<2>, D>;
  const T step = step_of_scene(a.scene_dt, a.dt, scene);
  const T dt = step > T(0) ? step : T(1);  // no system of a paused scene is solved: d and λ are zero
  const T* const sum = a.sums + i * kHeatChannels;
  const T capacity = sum[kHeatCapacity], varying = sum[kHeatVarying], increment = sum[kHeatTheta];
  const T theta = a.theta[i], average = sum[kHeatMean], multiplier = a.multiplier[i],
          rate = multiplier * increment / dt;
  const T in[] = {capacity * theta, varying * average, capacity, varying};
  T by_theta = -a.product[i];
  if (a.exchange) by_theta -= a.exchange[i] * multiplier;
  if (a.by_terms) by_theta += a.by_terms[i];
  const T* const adjoints = a.adjoints + kHeatSolved * i;
  if (a.fixed && a.fixed[i]) by_theta = -adjoints[kIncrementAdjoint];  // the increment leads to the held temperature
  const T adjoint[] = {-rate, T(0), by_theta, adjoints[kAverageAdjoint]};
  T grad[Means::kIn];
  Means::pull_back(in, adjoint, [](int) { return true; }, [&](int n, const T& value) { grad[n] = value; });
  T* const by_sums = a.by_sums + i * kHeatChannels;
  by_sums[kHeatTheta] = grad[0];
  by_sums[kHeatMean] = grad[1];
  by_sums[kHeatCapacity] = grad[2];
  by_sums[kHeatVarying] = grad[3];
  T* const solved = a.solved + i * kHeatSolved - kHeatChannels;
  solved[kHeatIncrement] = increment;
  solved[kHeatAverage] = average;
  solved[kHeatAfter] = theta + increment;
  solved[kHeatMultiplier] = multiplier;
  if (a.rate) a.rate[i] = rate / dt;
  if (a.layer) a.layer[i] = multiplier * (a.temperature[scene * a.stride] - (theta + increment));
}

// Forms of a particle in a step: the values of those of P2G, and moments of these and of those of λ · H (θ + d).
template <class V, int D>
struct HeatForms {
  V value[kHeatChannels];
  Vector<V, D> theta, mean, after, multiplier;
};

// Heat of a particle as P2G transfers it, and the arguments of the weights: volume, specific heat, conductivity, mass,
// dt and |sym ∇v|.
template <class V, int D>
struct HeatOfParticle {
  V in[6];
  HeatWeights<V> weights;
  V theta;
  Vector<V, D> gradient;  // zero where particles have none

  MPM_HD const V& volume() const { return in[0]; }
  MPM_HD const V& dt() const { return in[4]; }
  // The forms of P2G.
  MPM_HD HeatForms<V, D> forms() const {
    HeatForms<V, D> f{};
    const HeatSums<V> sums = heat_sums(weights, theta);
    f.value[kHeatCapacity] = sums.capacity;
    f.value[kHeatVarying] = sums.varying;
    f.value[kHeatTheta] = sums.theta;
    f.value[kHeatMean] = sums.mean;
    MPM_UNROLL for (int d = 0; d < D; d++) {
      const HeatSums<V> moment = heat_sums(weights, gradient[d]);
      f.theta[d] = moment.theta, f.mean[d] = moment.mean;
    }
    return f;
  }
};

template <class At, class T, int D>
MPM_HD HeatOfParticle<typename At::Value, D> load_heat(const HeatToNodesArguments<T, D>& f, const At& at, int scene) {
  using V = typename At::Value;
  const HeatParticles<T>& particles = f.particles;
  HeatOfParticle<V, D> h{
      {load_scalar(at, particles.volume), load_value(at, f.specific_heat, scene), load_value(at, f.conductivity, scene),
       load_scalar(at, f.mass), V(step_of_scene(f.scene_dt, f.dt, scene)),
       strain_rate_of(load_matrix<D>(at, f.velocity_gradient))},
      {},
      load_scalar(at, particles.theta),
      particles.gradient.pointer ? load_vector<D>(at, particles.gradient) : zero_vector<V, D>()};
  h.weights = heat_weights(h.in[0], h.in[1], h.in[2], h.in[3], h.in[4], h.in[5], V(f.topology.geometry.dx));
  h.weights.blend = blend_of(f.transfer, h.weights.blend);
  return h;
}

// ∇(θ + d) and ∇λ at a particle.
template <class V, int D>
struct HeatGradients {
  Vector<V, D> after, multiplier;
};

// Adjoints to which the adjoint of P2G adds, zero where they are absent. They are loaded with the inputs of a particle,
// before any of them is stored, as in lanes.h.
template <class V, int D>
struct AddedAdjoints {
  V theta, mass, volume;
  Vector<V, D> gradient;
  Matrix<V, D> velocity_gradient;
};

// Whether β depends on the step and on ∇v.
template <class T, int D>
MPM_HD bool blend_varies(const HeatToNodesBackwardArguments<T, D>& a) {
  return a.forward.transfer == HeatTransfer::hybrid;
}

template <class At, class T>
MPM_HD typename At::Value load_if_present(const At& at, const Field<T>& f) {
  return f.pointer ? load_scalar(at, constant(f)) : typename At::Value(0);
}

template <class At, class T, int D>
MPM_HD AddedAdjoints<typename At::Value, D> load_sums(const HeatToNodesBackwardArguments<T, D>& a, const At& at) {
  using V = typename At::Value;
  return {load_if_present(at, a.theta), load_if_present(at, a.mass), load_if_present(at, a.volume),
          a.gradient.pointer ? load_vector<D>(at, constant(a.gradient)) : zero_vector<V, D>(),
          blend_varies(a) ? load_matrix<D>(at, constant(a.velocity_gradient)) : zero_matrix<V, D>()};
}

template <class At, class T, int D>
MPM_HD void store_sums(const HeatToNodesBackwardArguments<T, D>& a, const At& at,
                       const AddedAdjoints<typename At::Value, D>& sums) {
  if (a.theta.pointer) store_scalar(at, a.theta, sums.theta);
  if (a.mass.pointer) store_scalar(at, a.mass, sums.mass);
  if (a.volume.pointer) store_scalar(at, a.volume, sums.volume);
  if (a.gradient.pointer) store_vector<D>(at, a.gradient, sums.gradient);
  if (blend_varies(a)) store_matrix<D>(at, a.velocity_gradient, sums.velocity_gradient);
}

// Adjoint of κ V by λ · H (θ + d) = Σ_p κ V ∇(θ + d) · ∇λ, which the equation of the solve subtracts.
template <class V, class T, int D>
MPM_HD V pull_back_conduction(const HeatToNodesBackwardArguments<T, D>& a, const V& conductance,
                              const HeatGradients<V, D>& gradients, HeatForms<V, D>& forms) {
  const V scale = -(V(T(a.inverse_inertia)) * conductance);
  forms.after = scale * gradients.multiplier;
  forms.multiplier = scale * gradients.after;
  return -dot(gradients.after, gradients.multiplier);
}

constexpr int kPositionEntry = 1;  // of the first coordinate in ObstacleRow

// Derivative of the signed distance of a particle from the held surface, by an entry of the row of its obstacle. The
// derivative by the position of the particle is that of an obstacle which moves the other way.
template <class T, int D>
MPM_HD T distance_by_entry(const HeatLayersArguments<T, D>& a, int scene, const Vector<T, D>& x, int entry) {
  using S = Dual<T>;
  const ObstacleRow<T, D>& row = rows_of_scene(a.contact, scene)[a.obstacle];
  ObstacleRow<S, D> moved;
  const T* const values = reinterpret_cast<const T*>(&row);
  S* const lifted = reinterpret_cast<S*>(&moved);
  for (int k = 0; k < ObstacleRow<T, D>::width; k++) lifted[k] = S(values[k], T(k == entry));
  return distance_from(obstacle_pose(a.contact, a.contact.kind[a.obstacle], moved, scene), x).derivative;
}

// Adjoints of the conductance κ V of a particle and of its distance from the surface. A share of κ V conducts, and
// another exchanges heat with the surface.
template <class T, int D>
MPM_HD void heat_layer_backward(const HeatLayersBackwardArguments<T, D>& a, int64_t p) {
  const One<T> at{p};
  const Vector<T, D> after = load_vector<D>(at, entry(a.moment, kHeatAfter)), x = load_vector<D>(at, a.layers.x);
  const T by_rest = -dot(after, load_vector<D>(at, entry(a.moment, kHeatMultiplier)));
  const T by_exchange = load_scalar(at, a.exchange) - by_rest / T(a.layers.inverse_inertia);
  const int scene = scene_of_particle(a.layers, p);
  const T distance = distance_from(pose_of(a.layers.contact, a.layers.obstacle, scene), x), width = T(a.layers.width);
  store_scalar(at, a.conductance, by_rest);
  store_vector<D>(at, a.x, zero_vector<T, D>());
  if (a.distance.pointer) store_scalar(at, a.distance, T(0));
  if (distance >= width || (by_rest == T(0) && by_exchange == T(0))) return;  // the latter outside the grid
  const HeatLayerAt<Dual<T>> layer = heat_layer(Dual<T>(distance, T(1)), Dual<T>(width, T(0)));
  store_scalar(at, a.conductance, layer.share.value * by_rest + layer.rate.value * by_exchange);
  const HeatToNodesArguments<T, D>& f = a.down;
  const T conductance = heat_weights(load_scalar(at, f.particles.volume), load_value(at, f.specific_heat, scene),
                                     load_value(at, f.conductivity, scene), load_scalar(at, f.mass),
                                     step_of_scene(f.scene_dt, f.dt, scene), T(0), f.topology.geometry.dx)
                            .conductance;
  const T by_distance = conductance * (layer.share.derivative * by_rest + layer.rate.derivative * by_exchange);
  if (a.distance.pointer) store_scalar(at, a.distance, by_distance);
  Vector<T, D> grad;
  for (int i = 0; i < D; i++) grad[i] = -by_distance * distance_by_entry(a.layers, scene, x, kPositionEntry + i);
  store_vector<D>(at, a.x, grad);
}

// An entry of the row by the particles whose base block a slot has.
template <class T, int D>
MPM_HD void heat_surface_row_backward(const HeatSurfaceRowBackwardArguments<T, D>& a, int64_t slot, int entry) {
  T sum = T(0);
  for (int i = a.topology.offsets[slot]; i < a.topology.offsets[slot + 1]; i++) {
    const int64_t p = a.topology.index[i];
    const One<T> at{p};
    const T adjoint = load_scalar(at, a.distance);
    if (adjoint == T(0)) continue;
    const Vector<T, D> x = load_vector<D>(at, a.layers.x);
    sum += adjoint * distance_by_entry(a.layers, scene_of_particle(a.layers, p), x, entry);
  }
  a.sums[slot * ObstacleRow<T, D>::width + entry] = sum;
}

// Power of a particle by the energy that its law dissipates.
struct HeatOfDissipation {
  static constexpr const char* name = "heat_of_dissipation";
  static constexpr Entries arguments[] = {kScalar, kScalar, kScalar};
  static constexpr Entries results[] = {kScalar};

  template <class T, int D>
  MPM_HD static void evaluate(Reader<T, D>& in, Writer<T, D>& out) {
    const T energy = in.scalar(), rest = in.scalar();
    out.put(dissipated_power(energy, rest, in.scalar()));
  }
};

// Adjoint of the present volume by the free surface and by heat from inside the matter; the gathered adjoints become
// the factors of the forms of the sums.
template <class At, class T, int D>
MPM_HD typename At::Value pull_back_surface(const HeatToNodesBackwardArguments<T, D>& a, const At& at, int scene,
                                            const typename At::Value& volume, const typename At::Value& dt,
                                            AddedAdjoints<typename At::Value, D>& sums) {
  using V = typename At::Value;
  using Dissipation = Applied<HeatOfDissipation, D>;
  const HeatSurfaceArguments<T, D>& f = a.surface;
  const V by_power = load_scalar(at, entry(constant(a.surface_value), 0));
  V by_volume(0), power(0);
  MPM_UNROLL for (int k = 0; k <= D; k++) {
    Vector<V, D> factor = load_vector<D>(at, entry(constant(a.surface_gradient), k));
    MPM_UNROLL for (int d = 0; d < D; d++) {
      if (1 + d == k) by_volume = by_volume + factor[d];
      factor[d] = 1 + d == k ? volume : V(0);
    }
    store_vector<D>(at, entry(a.surface_gradient, k), factor);
  }
  if (f.power.pointer) {
    const V density = load_value(at, f.power, scene);
    by_volume = by_volume + density * by_power;
    power = density * volume;
    add_parameter(at, a.parameters, kPower, volume * by_power);
  }
  if (f.dissipated.pointer) {
    const V in[] = {V(T(f.share)) * load_scalar(at, f.dissipated), load_scalar(at, f.rest), dt}, adjoint[] = {by_power};
    V out[1], grad[3];
    Dissipation::evaluate(in, out);
    power = power + out[0];
    Dissipation::pull_back(in, adjoint, [](int) { return true; }, [&](int n, const V& sum) { grad[n] = sum; });
    store_scalar(at, a.dissipated, V(T(f.share)) * grad[0]);
    sums.volume = sums.volume + grad[1];
    add_scalar(at, a.dt, grad[2]);
  }
  store_scalar(at, entry(a.surface_value, 0), power);
  MPM_UNROLL for (int k = 1; k <= D; k++)
    store_scalar(at, entry(a.surface_value, k), V(0));
  return by_volume;
}

// Adjoints of what P2G adds to the sums of the nodes: those of θ and its gradient are added; returns those of the heat
// capacity and of β.
template <class V, int D>
MPM_HD HeatWeights<V> pull_back_sums(const HeatOfParticle<V, D>& heat,
                                     const HeatGathered<V, D, kHeatChannels>& gathered, AddedAdjoints<V, D>& sums) {
  V in[3 + D], grad[3 + D];
  Writer<V, D> arguments{in};
  arguments.put(heat.weights.capacity);
  arguments.put(heat.weights.blend);
  arguments.put(heat.theta);
  arguments.put(heat.gradient);
  pull_back(in, grad, [&](const Dual<V>(&x)[3 + D]) {
    HeatWeights<Dual<V>> w{};
    w.capacity = x[0];
    w.blend = x[1];
    const HeatSums<Dual<V>> value = heat_sums(w, x[2]);
    V sum = gathered.value[kHeatCapacity] * value.capacity.derivative +
            gathered.value[kHeatVarying] * value.varying.derivative +
            gathered.value[kHeatTheta] * value.theta.derivative + gathered.value[kHeatMean] * value.mean.derivative;
    MPM_UNROLL for (int d = 0; d < D; d++) {
      const HeatSums<Dual<V>> moment = heat_sums(w, x[3 + d]);
      sum = sum + gathered.moment[kHeatTheta][d] * moment.theta.derivative +
            gathered.moment[kHeatMean][d] * moment.mean.derivative;
    }
    return sum;
  });
  sums.theta = sums.theta + grad[2];
  MPM_UNROLL for (int d = 0; d < D; d++)
    sums.gradient[d] = sums.gradient[d] + grad[3 + d];
  HeatWeights<V> by{};
  by.capacity = grad[0];
  by.blend = grad[1];
  return by;
}

// Adjoints of J or F by the present volume; returns that of the rest volume.
template <class At, class T, int D>
MPM_HD typename At::Value pull_back_volume(const HeatToNodesBackwardArguments<T, D>& a, const At& at,
                                           const typename At::Value& by_volume) {
  using V = typename At::Value;
  V ratio(1);  // of the present volume to that at rest
  Matrix<V, D> by_F = zero_matrix<V, D>();
  const V by_ratio = by_volume * load_scalar(at, a.rest);
  if (a.J.pointer) {
    ratio = load_scalar(at, a.J);
    store_scalar(at, a.J_term, by_ratio);
  } else if (a.F.pointer) {
    const Matrix<V, D> F = load_matrix<D>(at, a.F);
    ratio = determinant(F);
    by_F = by_ratio * cofactor(F);
  }
  if (a.F_term.pointer) store_matrix<D>(at, a.F_term, by_F);
  return ratio * by_volume;
}

// Adjoint of P2G at a particle inside the grid, from the adjoints of the sums and the gradients. Completes the forms.
template <class At, class T, int D>
MPM_HD void heat_of_nodes_backward(const HeatToNodesBackwardArguments<T, D>& a, const At& at, int scene,
                                   const HeatOfParticle<typename At::Value, D>& heat,
                                   const HeatGathered<typename At::Value, D, kHeatChannels>& gathered,
                                   const HeatGradients<typename At::Value, D>& gradients,
                                   HeatForms<typename At::Value, D>& forms) {
  using V = typename At::Value;
  const HeatToNodesArguments<T, D>& f = a.forward;
  const V volume = heat.volume(), dt = heat.dt(), dx(f.topology.geometry.dx);
  V grad[6];
  AddedAdjoints<V, D> sums = load_sums(a, at);
  const Matrix<V, D> L = load_matrix<D>(at, f.velocity_gradient);
  HeatWeights<V> by = pull_back_sums(heat, gathered, sums);
  by.blend = by.blend + load_scalar(at, a.blend);
  const V by_rest = pull_back_conduction(a, load_scalar(at, constant(f.conductance)), gradients, forms);
  by.conductance = a.conductance.pointer ? load_scalar(at, a.conductance) : by_rest;
  const V by_volume = a.surface_value.pointer ? pull_back_surface(a, at, scene, volume, dt, sums) : V(0);
  const bool varies = blend_varies(a);
  pull_back(heat.in, grad, [&](const Dual<V>(&x)[6]) {
    const HeatWeights<Dual<V>> w = heat_weights(x[0], x[1], x[2], x[3], x[4], x[5], Dual<V>(dx, V(0)));
    const V sum = by.capacity * w.capacity.derivative + by.conductance * w.conductance.derivative;
    return varies ? sum + by.blend * w.blend.derivative : sum;
  });
  sums.volume = sums.volume + pull_back_volume(a, at, by_volume + grad[0]);
  sums.mass = sums.mass + grad[3];
  if (varies) sums.velocity_gradient = sums.velocity_gradient + grad[5] * strain_rate_slope(L);
  store_sums(a, at, sums);
  add_parameter(at, a.parameters, kSpecificHeat, grad[1]);
  add_parameter(at, a.parameters, kConductivity, grad[2]);
  if (a.rate.pointer) add_scalar(at, a.dt, heat.weights.capacity * load_scalar(at, a.rate));
  add_scalar(at, a.dt, grad[4]);
}

// A particle outside the grid takes no part.
template <class T, int D>
MPM_HD void skip_heat_of_nodes_backward(const HeatToNodesBackwardArguments<T, D>& a, int64_t p) {
  const One<T> at{p};
  if (a.dissipated.pointer) store_scalar(at, a.dissipated, T(0));
  if (a.J_term.pointer) store_scalar(at, a.J_term, T(0));
  if (a.F_term.pointer) store_matrix<D>(at, a.F_term, zero_matrix<T, D>());
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
