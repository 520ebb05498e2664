#include "cpu/tile.h"
#include "implicit/arguments.h"
#include "implicit/grouped.cpu.h"
#include "transfer/gather.cpu.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

// Adds the blocks of a group, whose particles share their nodes, to the tiles of the first four channels and the rest.
template <int Order, class T, int D>
void add_group(const Tangent<Lanes<T>, D>& tangent, const Lanes<T> f[D], StressForm form, const Lanes<T>& inverse_dx,
               int count, T* first, T* rest) {
  using P = Lanes<T>;
  constexpr int S = Order + 1, nodes = D == 2 ? S * S : S * S * S;
  const Weights<Order, P, D> s(f, form == StressForm::gradient ? 1 : 0);
  for (int n = 0; n < nodes; n++) {
    int offset[D], place = 0;
    for (int i = D - 1, left = n; i >= 0; i--, left /= S) {
      offset[i] = left % S;
      place += offset[i] * Tile<Order, T, D>::stride(i);
    }
    const Matrix<P, D> block =
        node_block(tangent, gradient_weight<Order, P, D>(form, s.w, s.dw, offset, s.f, inverse_dx));
    int channel = 0;
    for (int i = 0; i < D; i++)
      for (int j = i; j < D; j++, channel++) {
        T sum = T(0);
        for (int l = 0; l < count; l++) sum += block[i][j][l];
        (channel < kChannels ? first[place + channel] : rest[place + channel - kChannels]) += sum;
      }
  }
}

}  // namespace

template <int Order, class T, int D>
void node_blocks(const NodeBlocksArguments<T, D>& a) {
  const Topology<T, D>& t = a.topology;
  const ScheduleIn s = schedule_of(t);
  constexpr int first = kSymmetric<D> < kChannels ? kSymmetric<D> : kChannels, rest = kSymmetric<D> - first;
  PhaseCounter<kColours<D>> colours{s.colour_start};
  parallel_base_blocks<D>(s, t.particles, [&](const auto& next) {
    Tile<Order, T, D> tiles[2];
    int colour = 0;
    for (int64_t b; (b = next()) >= 0;) {
      const BaseBlock<T, D> base_block(t, s.base_slot[b]);
      for (auto& tile : tiles) tile.clear();
      for (int64_t c = s.base_chunk[b]; c < s.base_chunk[b + 1]; c++) {
        const Chunk chunk(t, s, c);
        for (int cell = 0, i = 0; cell < kBlockNodes<D>; cell++) {
          int base[D];
          for (int k = 0; k < D; k++) base[k] = cell_coordinate<D>(cell, k);
          const int at = Tile<Order, T, D>::at(base);
          for (const int end = chunk.cell_end[cell]; i < end; i += kLanes) {
            const Group g = group_by_cell(chunk, i, end);
            Lanes<T> f[D];
            for (int k = 0; k < D; k++)
              f[k] = distance_in_cells(t.geometry, k, load(a.x, g, k), Lanes<T>(T(base_block.corner[k] + base[k])));
            add_group<Order, T, D>(load_tangent<Grouped<T, kLanes>, T, D>(Grouped<T, kLanes>{g}, a.tangent), f, a.form,
                                   Lanes<T>(t.geometry.inverse_dx), g.count, tiles[0].value + at, tiles[1].value + at);
          }
          i = chunk.cell_end[cell];
        }
      }
      while (b >= s.colour_start[colour + 1]) colour++;
      colours.wait_before(colour);
      tiles[0].add_to(a.nodes, base_block, 0, first);
      if (rest > 0) tiles[1].add_to(a.nodes, base_block, first, rest);
      colours.finish(colour);
    }
  });
}

MPM_INSTANTIATE_ORDERS(node_blocks, NodeBlocksArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
