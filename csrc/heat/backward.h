#pragma once

#include "heat/transfer.h"

// Arguments of the adjoint of a step of heat, as torch_mpm/heat/heat.py computes the step: particles gather the adjoint
// of G2P, nodes have that of the solve (heat_cg in torch_mpm/ops/heat.py), and particles gather that of P2G.
namespace mpm {

// Trilinear forms of particles and nodes whose position gradients belong to the step: those of P2G, in the order of
// HeatChannel, those of G2P, and the two of λ · H (θ + d).
enum HeatForm : int { kHeatIncrement = kHeatChannels, kHeatAverage, kHeatAfter, kHeatMultiplier, kHeatForms };
constexpr int kHeatSolved = int(kHeatForms) - int(kHeatChannels);  // forms after those of P2G
constexpr int kIncrementAdjoint = 0, kAverageAdjoint = 1;  // channels of the adjoints of the nodes by these forms

// Columns of the adjoints of the parameters.
enum HeatParameter : int { kConductivity, kSpecificHeat, kMeltingPoint, kLatentHeat, kPower, kHeatParameters };

// Adjoint of G2P: from the adjoints of the temperature, its gradient and the liquid fraction to those of the nodes.
template <class T, int D>
struct HeatToParticlesBackwardArguments {
  HeatToParticlesArguments<T, D> forward;  // its results are unused
  Field<T> theta, gradient, liquid;        // adjoints after the step, replaced by their parts by the values before it
  Field<T> value, moment;                  // [P, kHeatForms], [P, kHeatForms, D]: those of G2P, the moments times D⁻¹
  Field<T> blend;                          // adjoint of β
  Field<T> velocity_gradient;              // added, as those below
  Field<T> parameters, dt;                 // [P, kHeatParameters], [P]; may be absent
};

// Adjoint of a term of the boundary by the sums of its free surface and by the node temperatures.
template <class T, int D>
struct HeatTermBackwardArguments {
  HeatTermArguments<T, D> forward;  // its results are unused
  const T* sums = nullptr;          // of the step after the solve, kHeatChannels
  const T* multiplier = nullptr;    // λ, see HeatNodesBackwardArguments
  T* surface = nullptr;             // [N, kHeatChannels], added
  T* theta = nullptr;               // [N], added
};

// Adjoints of the numbers of the boundary, summed over the nodes of each slot: of both numbers of a term, of the
// temperature of the nodes that an obstacle holds, or of that of the held surface.
template <class T>
struct HeatSlotSums {
  T* sums = nullptr;  // [max_blocks, columns]
  int columns = 0, first = 0;
};

template <class T, int D>
struct HeatNumbersBackwardArguments {
  HeatTermBackwardArguments<T, D> term;  // its results are unused
  HeatSlotSums<T> to;
};

template <class T, int D>
struct HeatHeldBackwardArguments {
  HeatHoldArguments<T, D> hold;  // its temperatures are unused
  const T* adjoints = nullptr;   // as those of HeatNodesBackwardArguments
  const T* product = nullptr;
  bool* counted = nullptr;  // [N], nodes of an obstacle that came before, and of this one
  HeatSlotSums<T> to;
};

template <class T, int D>
struct HeatSurfaceTemperatureBackwardArguments {
  Topology<T, D> topology;
  const T* multiplier = nullptr;
  const T* exchange = nullptr;  // of the layer alone [N]
  HeatSlotSums<T> to;
};

// Adjoint of the solve and of the averages, with the solution λ of A λ = adjoint of the increment.
template <class T, int D>
struct HeatNodesBackwardArguments {
  Topology<T, D> topology;
  const T* sums = nullptr;        // after the solve, kHeatChannels
  const T* theta = nullptr;       // averages before it
  const T* multiplier = nullptr;  // λ
  const T* product = nullptr;     // H λ
  const T* adjoints = nullptr;    // of the increment and θ̄ [N, kHeatSolved]; the other channels are unused
  const T* exchange = nullptr;    // [N], as those below; absent without boundaries
  const T* by_terms = nullptr;    // adjoint of θ by the terms of the boundary
  const bool* fixed = nullptr;
  Field<const T> scene_dt;
  double dt = 0;
  const T* temperature = nullptr;  // of the held surface in scene b at temperature + b * stride, absent without one
  int64_t stride = 0;
  T* layer = nullptr;    // [N], adjoint of its exchange
  T* by_sums = nullptr;  // [N, kHeatChannels], adjoints of the sums
  T* solved = nullptr;   // [N, kHeatSolved]: increment, θ̄, θ + d and λ
  T* rate = nullptr;     // λ d/dt², whose sum with the heat capacities is the adjoint of dt; may be absent
};

// Adjoint of the layer of particles around a held surface.
template <class T, int D>
struct HeatLayersBackwardArguments {
  HeatToNodesArguments<T, D> down;
  HeatLayersArguments<T, D> layers;  // its results are unused
  Field<const T> exchange;           // gathered adjoint of the exchange of the particles
  Field<const T> moment;             // [P, kHeatForms, D] with ∇(θ + d) and ∇λ
  Field<T> conductance;              // adjoint of κ V
  Field<T> x;                        // adjoint of the position by the distance from the surface
  Field<T> distance;                 // adjoint of that distance [P], absent where that of the obstacle is not wanted
};

// Adjoint of the row of the obstacle with the held surface, by the distances of particles.
template <class T, int D>
struct HeatSurfaceRowBackwardArguments {
  Topology<T, D> topology;
  HeatLayersArguments<T, D> layers;  // its results are unused
  Field<const T> distance;           // adjoint of the distance of each particle
  T* sums = nullptr;                 // [max_blocks, width of a row], written for slots of the scenes
};

// Adjoint of P2G and of the weights of the particles.
template <class T, int D>
struct HeatToNodesBackwardArguments {
  HeatToNodesArguments<T, D> forward;
  Field<const T> rest, F, J;                 // of the present volume; the last two may be absent
  NodeField<const T> nodes;                  // adjoints of the sums, kHeatChannels
  NodeField<const T> solved;                 // on CUDA, kHeatSolved, see HeatNodesBackwardArguments
  Field<const T> blend;                      // adjoint of β by G2P
  Field<const T> rate;                       // gathered λ d/dt², absent where the adjoint of dt is not wanted
  HeatSurfaceArguments<T, D> surface;        // of the boundary, absent without `surface_value`; its sums are unused
  Field<T> surface_value, surface_gradient;  // [P, 1 + D], [P, 1 + D, D]: gathered adjoints of its sums, then forms
  Field<T> dissipated;                       // adjoint of the energy that laws dissipate, written; may be absent
  double inverse_inertia = 1;                // D⁻¹ [1/m²]
  Field<const T> conductance;                // adjoint of κ V, where a layer has changed it; or absent
  Field<T> value, moment;  // forms: those of G2P; on the CPU those of P2G are written, and ∇(θ + d) and ∇λ become those
                           // of the solve
  Field<T> x_term;         // on CUDA, position gradient of all forms, written
  Field<T> theta, gradient;  // adjoints, added, as those below
  Field<T> velocity_gradient;
  Field<T> mass, volume, parameters, dt;  // of the rest volume; may be absent
  Field<T> F_term, J_term;                // written, absent with F and J
};

}  // namespace mpm
