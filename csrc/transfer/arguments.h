#pragma once

#include <cstdint>

#include "grid/geometry.h"
#include "transfer/momentum.h"

// Arguments of the transfer kernels: plain pointers and strides, shared by the CPU and the CUDA launchers. Only the
// launchers know threads and streams; only the files *.op.cpp know tensors.
namespace mpm {

// A tensor [P], [P, I] or [P, I, J] of any strides (in elements); a null pointer is an absent field.
template <class T>
struct Field {
  T* pointer = nullptr;
  int64_t stride[3] = {0, 0, 0};
};

// Node values [capacity * 4^D, channels] with unit channel stride.
template <class T>
struct NodeField {
  T* pointer = nullptr;
  int64_t stride = 0;  // elements from node to node
  int channels = 0;
};

// The active blocks of one activation (see csrc/grid/activate.op.cpp for the meaning of each tensor).
template <class T, int D>
struct Topology {
  Geometry<T, D> geometry;
  int scenes = 1;
  int capacity = 0;
  int64_t particles = 0;
  const int* table = nullptr;  // [scenes * blocks_per_scene] slot of a block, -1 where inactive
  const int* block = nullptr;  // [capacity] table index of a slot, -1 where unused
  const int* offsets =
      nullptr;  // [capacity + 1] particles whose base node lies in the slot's block: index[offsets[s], offsets[s+1])
  const int* index = nullptr;     // [P] particles grouped by block; those outside the grid come last
  const int* schedule = nullptr;  // device-specific order of work
  int64_t schedule_size = 0;
};

template <class T, int D>
struct P2GArguments {
  Topology<T, D> topology;
  Field<const T> x, mass, velocity, affine, stress, volume;
  Field<const T> scene_dt;  // [scenes], or absent; the time step of a particle is dt * scene_dt[its scene]
  double dt = 0;
  StressForm form = StressForm::mls;
  bool deterministic = false;
  NodeField<T> nodes;  // zero on entry; 1 + D channels: mass, momentum
};

template <class T, int D>
struct P2GBackwardArguments {
  P2GArguments<T, D> forward;  // its `nodes` unused
  NodeField<const T> grad_nodes;
  Field<T> x, mass, velocity, affine, stress, volume,
      dt;  // adjoints per particle, dt with respect to the product dt * scene_dt; absent where not needed
};

// nodes_i += Σ_p N_i (value_p + scale moment_p · (x_i − x_p)) + gradient_p · ∇N_i, for any number of channels. The
// scale is 1 for an affine field, D⁻¹ for the adjoint of G2P.
template <class T, int D>
struct ScatterArguments {
  Topology<T, D> topology;
  Field<const T> x, value, moment, gradient;  // [P, K], [P, K, D], [P, K, D]; the last two may be absent
  double moment_scale = 1;
  bool deterministic = false;
  NodeField<T> nodes;  // zero on entry, K channels
};

// The adjoint of scatter: value_p = Σ_i N_i g_i, moment_p = scale Σ_i N_i g_i (x_i − x_p), gradient_p = Σ_i g_i ∇N_i.
template <class T, int D>
struct GatherArguments {
  Topology<T, D> topology;
  Field<const T> x;
  NodeField<const T> nodes;
  double moment_scale = 1;
  double lost = 0;                   // what a particle gets whose position is not finite
  Field<T> value, moment, gradient;  // absent where not wanted; zero for other particles outside
};

// ∂Φ/∂x_p of the trilinear form Φ = Σ_p Σ_i g_i · [N_i (value_p + scale moment_p (x_i − x_p)) + gradient_p ∇N_i] that
// has scatter as ∂Φ/∂g and gather as ∂Φ/∂(value, moment, gradient): the position gradient of both.
template <class T, int D>
struct PositionGradientArguments {
  Topology<T, D> topology;
  Field<const T> x, value, moment, gradient;
  NodeField<const T> nodes;  // g
  double moment_scale = 1;
  Field<T> position_gradient;  // [P, D], zero for particles outside
};

// Entries of the schedule tensor: room for the work items of both backends, with the number of particles of each cell,
// and for an entry for each particle (the fake kernel in torch_mpm/ops/activation.py has the same formula).
template <int D>
int64_t schedule_size(int64_t capacity, int64_t particles) {
  return 16 + (8 + kBlockNodes<D> / 2) * (capacity + particles / 128) + particles;
}

template <class T, int D>
struct ActivateArguments {
  Geometry<T, D> geometry;
  int scenes = 1;
  int capacity = 0;
  int64_t particles = 0;
  bool deterministic = false;
  Field<const T> x;
  const int* scene = nullptr;  // [P] or null for one scene
  int64_t scene_stride = 0;
  const int64_t* id = nullptr;  // [P] or null
  int64_t id_stride = 0;
  const int* previous_status = nullptr;  // [1 + scenes, 8] or null
  int *table = nullptr, *block = nullptr, *offsets = nullptr, *index = nullptr, *schedule = nullptr, *status = nullptr;
  int64_t schedule_size = 0;
  void* workspace = nullptr;  // bytes asked for by activate_workspace()
  int64_t workspace_size = 0;
};

}  // namespace mpm
