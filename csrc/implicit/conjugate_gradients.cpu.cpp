#include "cpu/parallel.h"
#include "implicit/arguments.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

// node(index, scene scalars) for all nodes, and the sum of its results for each slot.
template <class T, int D, class F>
void for_slots(const ConjugateGradientsArguments<T, D>& a, const F& node) {
  constexpr int64_t grain = 1024 / kBlockNodes<D>;
  parallel_ranges(a.max_blocks, grain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      if (a.block[slot] < 0) continue;
      const ConjugateGradients& scene = a.scene[a.block[slot] / a.blocks_per_scene];
      double sum = 0;
      for (int64_t n = slot * kBlockNodes<D>; n < (slot + 1) * kBlockNodes<D>; n++)
        if (a.mass[n] != T(0)) sum += node(n, scene);  // the vectors of others stay zero
      a.slots[slot] = sum;
    }
  });
}

// Sums of the slots of each scene in their order, and the decisions from them.
template <class T, int D>
void advance_scenes(const ConjugateGradientsArguments<T, D>& a, CGPhase phase, double* sums) {
  for (int b = 0; b < a.scenes; b++) sums[b] = 0;
  for (int slot = 0; slot < a.max_blocks; slot++)
    if (a.block[slot] >= 0) sums[a.block[slot] / a.blocks_per_scene] += a.slots[slot];
  for (int b = 0; b < a.scenes; b++) advance_scene(a.scene[b], phase, sums[b], double(a.relative[b]));
}

}  // namespace

template <class T, int D>
void cg_begin(const ConjugateGradientsArguments<T, D>& a) {
  for_slots(a, [&](int64_t node, const ConjugateGradients&) { return cg_start(a, node); });
  advance_scenes(a, CGPhase::start, a.slots + a.max_blocks);
}

template <class T, int D>
void cg_advance(const ConjugateGradientsArguments<T, D>& a) {
  for_slots(a, [&](int64_t node, const ConjugateGradients&) { return cg_curvature(a, node); });
  for (int group = 0; group < a.image_groups; group++) mirror_group(a, group);
  advance_scenes(a, CGPhase::curvature, a.slots + a.max_blocks);
  for_slots(a, [&](int64_t node, const ConjugateGradients& s) { return cg_step(a, node, s.step); });
  advance_scenes(a, CGPhase::step, a.slots + a.max_blocks);
  for_slots(a, [&](int64_t node, const ConjugateGradients& s) { return cg_turn(a, node, s), 0.0; });
}

template <class T, int D>
void cg_look(const ConjugateGradientsArguments<T, D>& a) {
  int count = 0;
  for (int b = 0; b < a.scenes; b++) count += a.scene[b].state == kSolving;
  *a.unfinished_on_host = count;
}

MPM_INSTANTIATE(cg_begin, ConjugateGradientsArguments)
MPM_INSTANTIATE(cg_advance, ConjugateGradientsArguments)
MPM_INSTANTIATE(cg_look, ConjugateGradientsArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
