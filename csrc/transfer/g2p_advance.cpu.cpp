#include "transfer/advance_chunk.cpu.h"

// G2P with the end of the step, so that v and C need not be read again.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <int Order, bool Gradient, class T, int D>
void g2p_advance_with(const G2PAdvanceArguments<T, D>& a) {
  constexpr int N = kWideLanes<T>;
  using P = Pack<T, N>;
  const GatherArguments<T, D>& in = a.gather;
  const Geometry<T, D>& geometry = in.topology.geometry;
  const P scale(in.moment_scale * double(geometry.dx)), inverse_dx(geometry.inverse_dx);
  const AdvancedRows<T, D> rows(a);
  const bool direct =
      unit_stride(in.x, a.residual, a.F, a.J, in.value, a.x_next, a.residual_next, in.moment, a.F_next, a.J_next);
  const auto advance = [&](const Chunk& chunk, int scene, const Motion<Gradient, T, D>& motion) {
    const P dt(time_step(a.scene_dt, a.dt, scene));
    int by_cell[kChunk];
    for (int i = 0; i < chunk.count && !chunk.sorted; i++) by_cell[i] = chunk.id[chunk.by_cell(i)];
    const int* const id = chunk.sorted ? chunk.id : by_cell;
    for (int i = 0; i < chunk.count; i += N) {
      Advanced<P, D> p;
      Matrix<P, D> L;
      motion.get(i, scale, inverse_dx, p, L);
      // One arithmetic for all, so that rounding does not depend on contiguity.
      const int rest = chunk.count - i;
      const bool run = direct && chunk.sorted && rest >= N;
      const GroupOf<N> g = run ? GroupOf<N>{} : group_of<N>(id + i, rest);
      run ? read(p, rows, RunOf<N>{chunk.id[0] + i}) : read(p, rows, g);
      end_step(p, L, dt, rows);
      run ? write(p, rows, RunOf<N>{chunk.id[0] + i}) : write(p, rows, g);
    }
  };
  gather_chunks<Order>(in.topology, in.nodes, 0, D, [&] {
    return [&, motion = Motion<Gradient, T, D>()](const BaseBlock<T, D>& base_block, const Chunk& chunk,
                                                  const Chunk& next, const Tile<Order, T, D>& tile) mutable {
      int prefetched = 0;
      const auto visit = [&](const Group&, int i, const Lanes<T> f[D], const T* at) {
        Sums<Lanes<T>, D> s[D];
        gather_channels<Order, D, true, Gradient, T, D>(f, at, s);
        motion.put(i, s);
        for (; direct && prefetched <= i && prefetched < next.count; prefetched += 64 / sizeof(T))
          rows.prefetch(next.id[prefetched]);
      };
      for_groups_of_cells(in.topology, in.x, base_block, chunk, tile, visit);
      advance(chunk, base_block.scene, motion);
    };
  });
}

template <int Order, class T, int D>
void g2p_advance(const G2PAdvanceArguments<T, D>& a) {
  if (a.form == StressForm::gradient)
    g2p_advance_with<Order, true>(a);
  else
    g2p_advance_with<Order, false>(a);
  skip_outside(a);
}

MPM_INSTANTIATE_ORDERS(g2p_advance, G2PAdvanceArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
