#pragma once

#include "common/fields.h"
#include "grid/obstacle.h"
#include "grid/topology.h"
#include "heat/solve.h"
#include "transfer/advance.h"

// Transfer of temperature between particles and nodes in a rollout. The particles of the call are those of its P2G and
// G2P, with the same activation.
namespace mpm {

// Columns of the status of a scene.
enum HeatStatus : int { kUnsolved, kLargestResidual, kLargestFront, kHeatStatusSize };

enum class HeatTransfer { hybrid, apic, flip, pic };

// A quantity that is uniform, per scene or per particle.
template <class T>
struct HeatValue {
  const T* pointer = nullptr;
  int64_t stride = 0;  // elements from particle to particle, or from scene to scene; zero where it is uniform
  bool per_scene = false;
};

// Fields of the particles.
template <class T>
struct HeatParticles {
  Field<const T> theta, gradient, liquid;  // [P], [P, D], [P]; the last two may be absent
  Field<const T> volume;                   // present volume [P]
};

// Present volumes, from rest volumes and F or J; before laws, whose dissipated energy begins with zero.
template <class T, int D>
struct HeatVolumesArguments {
  int64_t particles = 0;
  Field<const T> rest, F, J;
  Field<T> volume, dissipated;  // the energy is absent where none becomes heat
};

template <class T, int D>
struct HeatToNodesArguments {
  Topology<T, D> topology;
  Field<const T> x, mass, velocity_gradient;
  HeatParticles<T> particles;
  HeatValue<T> conductivity, specific_heat;
  HeatTransfer transfer = HeatTransfer::hybrid;
  Field<const T> scene_dt;
  double dt = 0;
  bool deterministic = false;
  Field<T> conductance, blend, number;  // results per particle; the number may be absent
  double* largest = nullptr;            // [scenes], raised to the largest number of a particle
  NodeField<T> sums;                    // kHeatChannels, zero on entry
};

// Whether G2P of the motion and P2G of heat may be one kernel: in float64 in 3-D its shared memory would exceed the
// 99 KB of many devices.
template <class T, int D>
constexpr bool kAdvancesHeat = sizeof(T) == sizeof(float) || D == 2;

// G2P of the motion and P2G of heat in one pass over the particles, on CUDA. It also stores the volumes after the step,
// and packs the particles for the products of the simple steps where there is a work space.
template <class T, int D>
struct HeatAdvanceArguments {
  G2PAdvanceArguments<T, D> advance;
  HeatToNodesArguments<T, D> to_nodes;
  Field<const T> rest;
  Field<T> volume_next;       // not written where P2G or laws update F and J
  void* workspace = nullptr;  // of the solve; may be absent
};

// On CUDA: other memory, which is set to zero for the next substep.
template <class T>
struct HeatCleared {
  T* memory = nullptr;
  int64_t size = 0;
};

// Averages of the nodes from their sums: θ, its heat capacity, and θ̄, which replaces w β θ. Where nodes may be held,
// `start` is θ too, and no node is fixed.
template <class T, int D>
struct HeatMeansArguments {
  int64_t nodes = 0;
  T* sums = nullptr;
  T* theta = nullptr;
  T* capacity = nullptr;
  T* start = nullptr;  // may be absent, and `fixed` with it
  bool* fixed = nullptr;
  HeatCleared<T> cleared;
};

template <class T, int D>
struct HeatToParticlesArguments {
  Topology<T, D> topology;
  Field<const T> x, velocity_gradient, blend, number;
  HeatParticles<T> particles;
  HeatValue<T> specific_heat, melting_point, latent_heat;
  Field<const T> scene_dt;
  double dt = 0, moment_scale = 1;
  NodeField<const T> nodes;            // the sums from kHeatTheta on: increment and θ̄
  Field<T> theta, gradient, liquid;    // results, on CUDA in other memory than the inputs
  HeatVolumesArguments<T, D> volumes;  // on CUDA, after the step; may be absent
  double* largest = nullptr;  // column [scenes] of the status, raised to the largest diffusion number of a particle
                              // whose liquid fraction changes
};

// Nodes with matter in an obstacle are held at a temperature.
template <class T, int D>
struct HeatHoldArguments {
  ContactArguments<T, D> contact;
  Topology<T, D> topology;
  int obstacle = 0;
  const T* temperature = nullptr;  // of scene b at temperature + b * stride
  int64_t stride = 0;
  const T* capacity = nullptr;  // of the nodes
  T* theta = nullptr;           // set to the temperature
  bool* fixed = nullptr;        // set; nodes that are already held are unchanged
};

// Particles near an obstacle whose surface is held: the remaining part of their conductance, and their exchange.
template <class T, int D>
struct HeatLayersArguments {
  ContactArguments<T, D> contact;
  int64_t particles = 0;
  int64_t scenes = 1;
  Field<const T> x;
  Field<const int> scene;  // absent: one scene
  int obstacle = 0;
  double width = 0, inverse_inertia = 1;  // w [m], and D⁻¹ [1/m²]
  Field<T> conductance, exchange;         // κ V, replaced by the rest; and the exchange
};

// These and the sums of the exchange at the nodes, on CUDA in one pass; particles may have left their base blocks.
template <class T, int D>
struct HeatExchangeArguments {
  HeatLayersArguments<T, D> layers;
  Topology<T, D> topology;
  NodeField<T> nodes;
  bool deterministic = false;
};

// Heat from the surface at a temperature: source = exchange · temperature, for nodes of every scene.
template <class T, int D>
struct HeatFromSurfaceArguments {
  Topology<T, D> topology;
  const T* temperature = nullptr;
  int64_t stride = 0;
  const T* exchange = nullptr;
  T* source = nullptr;
};

// Sums for heat from inside the matter, in the first channel: a power, and energy that laws have dissipated in the
// step; and for the free surface: Σ V ∇N of each node.
template <class T, int D>
struct HeatSurfaceArguments {
  Topology<T, D> topology;
  Field<const T> x, volume;         // present volume
  HeatValue<T> power;               // [W/m³]; without a pointer there is none
  Field<const T> dissipated, rest;  // energy per rest volume [J/m³], absent where there is none, and rest volume
  double share = 0;                 // of that energy
  Field<const T> scene_dt;
  double dt = 0;
  bool deterministic = false;
  NodeField<T> sums;  // kHeatChannels, zero on entry
};

// On CUDA: the sums of the exchange and of the free surface in one launch, where sums have no order.
template <class T, int D>
struct HeatExchangeAndSurfaceArguments {
  HeatExchangeArguments<T, D> exchange;
  HeatSurfaceArguments<T, D> surface;
};

// On the CPU: clears the sums of the slots that the substep before has used, and finds those of the next one.
template <class T, int D>
struct HeatSlotsArguments {
  Topology<T, D> topology;
  int64_t slots = 0;       // of the pool that may have a block
  int order = 2;           // of the splines
  T* sums = nullptr;       // [N, kHeatChannels]
  bool* matter = nullptr;  // [slots] whether particles are transferred to the slot
};

enum class HeatTerm : int64_t { flux, convection, radiation, power };

// Adds a term of the free surface, or the power, to the exchange and the source of the nodes.
template <class T, int D>
struct HeatTermArguments {
  Topology<T, D> topology;
  const T* sums = nullptr;   // of HeatSurfaceArguments
  const T* theta = nullptr;  // of the nodes
  HeatTerm term = HeatTerm::power;
  const T* number = nullptr;  // [scenes, 2]: flux; or coefficient, or ε σ, and ambient temperature
  double reference = 0;
  T* exchange = nullptr;
  T* source = nullptr;
};

// The averages of the nodes, and then the boundaries there: heat from a held surface, and the terms.
constexpr int kMostHeatTerms = 16;
template <class T, int D>
struct HeatNodesArguments {
  HeatMeansArguments<T, D> means;
  Topology<T, D> topology;
  HeatFromSurfaceArguments<T, D> surface;  // without an exchange: none
  int term_count = 0;
  HeatTerm term[kMostHeatTerms]{};
  const T* number[kMostHeatTerms]{};  // of each term
  HeatTermArguments<T, D> terms;      // what all terms share
};

// On CUDA: the nodes before the solve and the packed particles of the simple steps in one launch, where sums have no
// order.
template <class T, int D>
struct HeatPackArguments {
  HeatNodesArguments<T, D> nodes;
  HeatSimpleArguments<T, D> simple;  // its products are unused
};

// The increments of all nodes: those of simple steps, and those of the solve for the other scenes, whose solves are
// added to the status. With a solve that reads the sums, the averages θ̄ too.
template <class T, int D>
struct HeatFinishArguments {
  HeatSimpleArguments<T, D> simple;
  const T* theta = nullptr;  // averages of the nodes
  T* sums = nullptr;         // where w θ is replaced by the change of the temperature; may be absent
  T* increment = nullptr;    // may be absent
  HeatCleared<T> cleared;
  double* status = nullptr;  // [scenes, kHeatStatusSize]
  // Counters of the substep and of the next one, where activations are requested if a scene may soon need more. Absent
  // are both without activations that last, and the latter where P2G of the next substep may have begun.
  Displacement *displacement = nullptr, *next_displacement = nullptr;
};

// Adds the solves of a substep to the status of the scenes.
template <class T, int D>
struct HeatCountArguments {
  const bool* converged = nullptr;
  const T* residual = nullptr;
  const T* scene_dt = nullptr;  // may be absent
  double* status = nullptr;     // [scenes, kHeatStatusSize]
};

}  // namespace mpm
