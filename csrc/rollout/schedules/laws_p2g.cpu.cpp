#include "rollout/laws_p2g.h"

#include "rollout/copies.cpu.h"
#include "rollout/displacement_budget.cpu.h"
#include "transfer/scatter.cpu.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

// The rows of the particles that P2G reads, without their stress.
template <class T, int D>
struct GivenRows {
  FieldRows<const T, D> x, v;
  FieldRows<const T, D * D> affine;
  FieldRows<const T, 1> mass, volume;

  explicit GivenRows(const P2GArguments<T, D>& a)
      : x(a.x), v(a.velocity), affine(a.affine, D), mass(a.mass), volume(a.volume) {}

  template <class P, class G>
  MPM_HD void read(ParticleMomentum<P, D>& p, P position[D], const G& g) const {
    p.mass = load_row(mass.row[0], mass.stride, g);
    p.volume = load_row(volume.row[0], volume.stride, g);
    p.affine = zero_matrix<P, D>();
    MPM_UNROLL for (int i = 0; i < D; i++) {
      position[i] = load_row(x.row[i], x.stride, g);
      p.velocity[i] = load_row(v.row[i], v.stride, g);
    }
    if (affine) MPM_UNROLL
      for (int k = 0; k < D * D; k++) p.affine[k / D][k % D] = load_row(affine.row[k], affine.stride, g);
  }
};

// The order of a chunk whose particles are sorted by cell.
template <int D>
void write_order(const uint16_t* cell_end, uint16_t order[kCopyLine]) {
  for (int cell = 0, i = 0; cell < kBlockNodes<D>; cell++)
    for (; i < cell_end[cell]; i++) order[i] = uint16_t(cell * kChunk + i);
}

}  // namespace

template <int Order, bool Gradient, class T, int D>
void laws_p2g_with(const LawsP2GArguments<T, D>& a) {
  using R = ChunkRows<D>;
  const Topology<T, D>& t = a.p2g.topology;
  const ScheduleIn s = schedule_of(t);
  ScheduleOut out;
  lay_out<D>(out, a.schedule, t.max_blocks, t.particles);
  const int64_t chunks = s.base_chunk[s.colour_start[kColours<D>]];
  const bool direct = unit_stride(a.p2g.x, a.p2g.mass, a.p2g.velocity, a.p2g.affine, a.p2g.volume);
  const GivenRows<T, D> rows(a.p2g);
  int taken = 0;
  const auto memory = [&] { return a.copies + a.copy_size * __atomic_fetch_add(&taken, 1, __ATOMIC_RELAXED); };
  scatter_chunks<Order, true, Gradient>(t, a.p2g.nodes, 0, 1 + D, [&] {
    return [&, copies = Copies<T, D>(a, memory()),
            displacement_budget = DisplacementBudget<T, D>(t.geometry, a.whereabouts)](
               const BaseBlock<T, D>& base_block, int64_t c, auto& contributions, auto& tile) mutable {
      displacement_budget.begin(base_block);
      constexpr int N = kWideLanes<T>;
      const Chunk chunk(t, s, c), next(t, s, c + 1 < chunks ? c + 1 : c);
      const auto place = [&](const Chunk& k) { return int(k.id - t.index); };
      alignas(64) uint16_t order[kCopyLine];
      write_order<D>(chunk.cell_end, order);
      copies.fetch(place(chunk), chunk.count, place(next), next.count, &chunk);
      copies.apply_laws();
      const Pack<T, N> dt(time_step(a.p2g.scene_dt, a.p2g.dt, base_block.scene));
      for (int i = 0; i < chunk.count; i += N) {
        Pack<T, N> x[D], f[D];
        ParticleMomentum<Pack<T, N>, D> p;
        const int rest = chunk.count - i;
        if (direct && chunk.sorted && rest >= N) {
          rows.read(p, x, RunOf<N>{chunk.id[0] + i});
        } else {
          const GroupOf<N> g = copies.template group<N>(i);
          direct&& g.consecutive ? rows.read(p, x, RunOf<N>{g.id[0]}) : rows.read(p, x, g);
        }
        p.dt = dt;
        p.stress = load_matrix_or_zero<T, D>(copies.field(R::stress), RunOf<N>{i});
        distances(t, base_block, entries_of<N>(order + i, N), x, f);
        contributions.put(i, f, momentum_contribution<Order, true, Gradient>(t.geometry, p, f));
        if (a.whereabouts) displacement_budget.add(x, rest);
        copies.prefetch(i);
      }
      copies.leave();
      if (a.rearranges) {
        __builtin_memcpy(out.order + place(chunk), order, chunk.count * sizeof(uint16_t));
        out.chunk_sorted[c] = 1;
      }
      sum_cells(contributions, order, chunk.cell_end, tile);
    };
  });
}

template <int Order, class T, int D>
void laws_p2g(const LawsP2GArguments<T, D>& a) {
  const Topology<T, D>& t = a.p2g.topology;
  if (a.p2g.form == StressForm::gradient)
    laws_p2g_with<Order, true>(a);
  else
    laws_p2g_with<Order, false>(a);
  if (t.offsets[t.max_blocks] < t.particles) laws_outside(a, t.offsets[t.max_blocks]);
}

template <class T, int D>
void permute(const PermuteArguments<T, D>& a) {
  constexpr int64_t grain = 4096;  // particles below which a range is not split
  parallel_ranges(a.particles, grain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; p++) a.place[a.origin[p]] = int(p);
  });
  parallel_ranges(a.particles, grain, [&](int64_t begin, int64_t end) {
    for (int k = 0; k < a.row_count; k++) {
      const T* const from = a.rows[k].from;
      T* const to = a.rows[k].to;
#pragma GCC ivdep
      for (int64_t i = begin; i < end; i++) to[i] = from[a.place[i]];
    }
  });
}

MPM_INSTANTIATE_ORDERS(laws_p2g, LawsP2GArguments)
MPM_INSTANTIATE(permute, PermuteArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
