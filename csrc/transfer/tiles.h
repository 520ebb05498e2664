#pragma once

#include <cstdint>

#include "grid/geometry.h"

// Sums over particles with an order, on CUDA: those of a base block are stored in a tile, which holds the nodes of the
// block and the next ones that its particles reach; then each node adds those of the tiles that have it, in the order
// of the base blocks. All particles are in their base blocks.
namespace mpm {

constexpr int kTileChannels = 4;  // at most

// Words of a tile of weights of an order.
template <int D>
constexpr int64_t tile_words(int order) {
  const int64_t width = kBlockWidth + order;
  return (D == 2 ? width : width * width) * (kBlockWidth + order) * kTileChannels;
}

}  // namespace mpm
