#pragma once

#include "common/signals.h"
#include "cuda/graph.h"

namespace mpm {

// Number of substeps, of at most `substeps`, that CUDA graphs compute by replays of `two(stream)`, a pair of substeps:
// results alternate between two buffers.
template <class Two>
int64_t replay_pairs(int64_t substeps, int64_t particles, cudaStream_t stream, const Two& two) {
  const auto launched = [&](int64_t pairs) { after_substeps(particles, 2 * pairs, stream); };
  return 2 * replay(substeps / 2, replays_of_graph(particles), stream, two, launched);
}

}  // namespace mpm
