#pragma once

#include "rollout/step_kernels.h"

// The schedule with a thread block per scene, on CUDA.
namespace mpm {

// Computes n substeps of particles in place, after the activation of the first one. `after` is the number of earlier
// substeps of the call, `time` the time of the first one.
template <class T, int D>
void run_scenes(Substeps<T, D>& s, int64_t n, int64_t after, double time, const int* activated, int* status,
                backend::Stream stream) {
  const SubstepsInputs& in = s.in;
  const int64_t P = in.x.size(0), rows = (P + 64 * in.scenes) * kMostSceneRow;
  const Tensor row_memory = empty(in.x, {rows}, ScalarType::Byte);
  // A scene uses new spare blocks each time it grows; together, twice the expected number.
  const int64_t spare = std::min<int64_t>(2 * int64_t(s.activation.max_blocks), s.update.block_count);
  const Tensor block_memory = empty(in.x, {spare * kMostSceneBlock}, ScalarType::Byte);
  Tensor errors = empty_int(in.x, {1 + in.scenes * int64_t(sizeof(SceneErrors) / sizeof(int))});
  backend::clear(errors, stream);
  int* const first = static_cast<int*>(errors.data_ptr());
  BlockPerSceneArguments<T, D> a{s.p2g, s.advance, s.update, s.contact, s.obstacles, int(in.scenes), n, time, in.dt};
  a.contact.activations = nullptr;
  a.contact.row += after * a.contact.step_stride;
  give_clocks(s, a);
  a.rows = static_cast<char*>(row_memory.data_ptr());
  a.blocks = static_cast<char*>(block_memory.data_ptr());
  a.spare_blocks = int(spare);
  a.blocks_taken = first;
  a.errors = reinterpret_cast<SceneErrors*>(first + 1);
  s.fused_kernels.block_per_scene(s.laws[0], a, stream);
  backend::block_per_scene_status({int(in.scenes), s.activation.max_blocks, n, a.errors, activated, status,
                                   s.activation.id, s.activation.id_stride},
                                  stream);
}

}  // namespace mpm
