#include "rollout/g2p2g_chunks.h"

#include <type_traits>

#include "cpu/cell_sort.h"
#include "rollout/copies.cpu.h"
#include "rollout/displacement_budget.cpu.h"
#include "rollout/schedules/chunk_in_place.cpu.h"
#include "rollout/schedules/heat_gather.cpu.h"
#include "transfer/lines.cpu.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int kOrder = kOrderInPlace;

// The work of a thread on the chunks of its base blocks. With `Heat`, G2P of the velocities precedes it, and G2P of
// heat takes its place.
template <bool Gradient, bool Heat, class T, int D>
class ChunkPass {
 public:
  ChunkPass(const G2P2GChunksArguments<T, D>& a, int thread)
      : a_(a),
        t_(a.advance.gather.topology),
        chunk_(t_),
        rows_(a.advance),
        mass_(a.to_nodes.p2g.mass),
        volume_(a.to_nodes.p2g.volume),
        heat_(a.heat),
        displacement_budget_(t_.geometry, a.follows ? a.to_nodes.whereabouts : nullptr),
        copies_(a.to_nodes, a.to_nodes.copies + a.to_nodes.copy_size * thread) {
    lay_out<D>(written_, a.to_nodes.schedule, t_.max_blocks, t_.particles);
  }
  ~ChunkPass() {
    if (a_.follows) __atomic_fetch_add(&a_.to_nodes.whereabouts->out_of_block, out_of_block_, __ATOMIC_RELAXED);
  }

  // `my_turn` waits for the sums of earlier colours.
  template <class F>
  void process(int64_t b, const F& my_turn) {
    const BaseBlock<T, D> base_block(t_, chunk_.schedule.base_slot[b]);
    displacement_budget_.begin(base_block);
    if constexpr (Heat) {
      heat_.begin(base_block);
    } else {
      velocities_.load_from(a_.advance.gather.nodes, base_block, 0, D);
      lines_.load_from(velocities_);
    }
    if (a_.follows) momenta_.clear();
    chunk_.for_chunks(b, [&](int64_t c, const Chunk& next) {
      gather(base_block, next);
      chunk_.for_out_of_block([&](int i) { gather_out_of_block(base_block.scene, i); });
      advance(base_block.scene);
      if (!a_.follows) return;
      give(base_block);
      sort(c);
      sum_cells(contributions_, chunk_.order, chunk_.cell_end, momenta_);
      chunk_.for_out_of_block([&](int i) {
        my_turn();
        add_one_out_of_block(base_block, i);
      });
    });
    if constexpr (Heat) heat_.end(base_block.scene);
    if (!a_.follows) return;
    my_turn();
    momenta_.add_to(a_.to_nodes.p2g.nodes, base_block, 0, 1 + D);
  }

 private:
  static constexpr int N = kWideLanes<T>;
  using P = Pack<T, N>;
  using R = ChunkRows<D>;

  // Distances of particles i, i + 1, ... from their base nodes, and their entries of cell_ and near_.
  MPM_HD void find_cells(int i, const BaseBlock<T, D>& base_block, const P x[D], P f[D]) {
    Mask<T, N> inside;
    P cell, near;
    MPM_UNROLL for (int a = 0; a < D; a++) {
      const P node = base_node<kOrder>(t_.geometry, a, x[a]), local = node - P(T(base_block.corner[a]));
      f[a] = distance_in_cells(t_.geometry, a, x[a], node);
      const auto in = (local >= P(0)) & (local < P(kBlockWidth));
      inside = a ? inside & in : in;
      cell = a ? cell * P(kBlockWidth) + local : local;
      near = a ? near * P(kNear) + (local + P(1)) : local + P(1);
    }
    put_bytes(select(inside, cell, P(kBlockNodes<D>)), cell_ + i);
    put_bytes(near, near_ + i);
  }

  MPM_HD static void put_bytes(const P& numbers, uint8_t* to) {
    using Values = typename RegisterOf<T, N>::Value;
    using Integers = typename RegisterOf<float, N>::Integer;
    typedef uint8_t Bytes __attribute__((vector_size(N)));
    Values values;
    __builtin_memcpy(&values, &numbers, sizeof(values));
    const Bytes bytes = __builtin_convertvector(__builtin_convertvector(values, Integers), Bytes);
    __builtin_memcpy(to, &bytes, sizeof(bytes));
  }

  // The solver of heat finds the cell of each particle in the order.
  void sort(int64_t c) {
    uint16_t* const order = written_.order + chunk_.begin;
    uint16_t end[kBlockNodes<D> + 1];
    sort_by_cell<kBlockNodes<D> + 1>(cell_, chunk_.count, order, end);
    if (Heat)
      for (int i = 0; i < chunk_.count; i++) order[i] = uint16_t(cell_[i] * kChunk + order[i]);
    __builtin_memcpy(written_.cell_end + c * kBlockNodes<D>, end, sizeof(*end) * kBlockNodes<D>);
  }

  // Sums of G2P for the particles that are in their base block.
  void gather(const BaseBlock<T, D>& base_block, const Chunk& next) {
    int prefetched = 0;
    chunk_.for_groups(rows_.x_next, base_block,
                      [&](const GroupOfChunk& g, int i, const int base[D], const Lanes<T> f[D]) {
                        if constexpr (Heat) {
                          heat_.gather(g, base, f);
                        } else {
                          const T* at = lines_.value + lines_.at(base);
                          // Most cells have one group: otherwise the compiler would store nodes for a second one on the
                          // stack.
                          asm volatile("" : "+r"(at));
                          Sums<Lanes<T>, D> s[D];
                          gather_lines<D, Gradient, T, D>(f, at, s);
                          g.template store_by<T>([&](const auto& store) { motion_.put_by(store, s); });
                        }
                        for (; prefetched <= i; prefetched += 64 / int(sizeof(T))) prefetch(next, prefetched);
                      });
  }

  // Prefetches the cache lines of the i-th particle of the next chunk. (GCC removes calls of functions that only
  // prefetch, unless they are inlined.)
  MPM_HD void prefetch(const Chunk& next, int i) const {
    if (i >= next.count) return;
    const int64_t p = next.id - t_.index + i;
    for (int k = 0; k < a_.to_nodes.prefetched_count; k++) __builtin_prefetch(a_.to_nodes.prefetched[k] + p, 0, 2);
    if constexpr (Heat) heat_.prefetch(p);
  }

  void gather_out_of_block(int scene, int i) {
    int base[D];
    T f[D];
    chunk_.locate(rows_.x_next, i, base, f);
    const NodesOf<kOrder, T, D> nodes(t_, scene, base);
    if constexpr (Heat) {
      heat_.gather_one(i, f, nodes);
    } else {
      Sums<T, D> s[D];
      split_channels<1, Gradient>(gather_own_nodes<kOrder, Gradient>(f, a_.velocities, nodes), s);
      motion_.put_by([&](const T& v, T* row) { row[i] = v; }, s);
    }
  }

  // By the cell of `find_cells`: its weights belong to these nodes, independent of rounding elsewhere.
  void add_one_out_of_block(const BaseBlock<T, D>& base_block, int i) {
    int base[D];
    for (int a = D - 1, near = near_[i]; a >= 0; a--, near /= kNear) base[a] = base_block.corner[a] + near % kNear - 1;
    const NodesOf<kOrder, T, D> nodes(t_, base_block.scene, base);
    add_to_own_nodes(contributions_, i, a_.sums, nodes);
    out_of_block_++;
  }

  // The end of the step: x, F and J.
  void advance(int scene) {
    const P scale(a_.advance.gather.moment_scale * double(t_.geometry.dx)), inverse_dx(t_.geometry.inverse_dx);
    const P dt(time_step(a_.advance.scene_dt, a_.advance.dt, scene));
    chunk_.template for_packs<N>([&](int i, const auto& g) {
      Advanced<P, D> p;
      Matrix<P, D> L;
      if constexpr (Heat) {
        read_motion(p, rows_, g);
        L = p.affine;
        heat_.finish(i, g, scene, L);
      } else {
        motion_.get(i, scale, inverse_dx, p, L);
      }
      read(p, rows_, g);
      end_step(p, L, dt, rows_);
      write_moved(p, rows_, g);
      if (!a_.follows) {
        if (!Heat) write_motion(p, rows_, g);
        return;
      }
      if constexpr (Heat) return put(present_volume(p, g), a_.volume_next, g);
      MPM_UNROLL for (int k = 0; k < D * D; k++)
        p.affine[k / D][k % D].store(motion_.affine[k / D][k % D] + i);
    });
  }

  template <class G>
  MPM_HD P present_volume(const Advanced<P, D>& p, const G& g) const {
    const P rest = load_row(volume_.row[0], 1, g);
    return rows_.J ? rest * p.J : rows_.F ? rest * determinant(p.F) : rest;
  }

  // Motion of the particles of the chunk from the i-th one on: with heat from their rows, which an earlier pass has
  // written.
  template <class G>
  MPM_HD P velocity(int k, int i, const G& g) const {
    if constexpr (Heat) return load_row(rows_.v.row[k], 1, g);
    return P::load(motion_.velocity[k] + i);
  }
  template <class G>
  MPM_HD P affine(int k, int i, const G& g) const {
    if constexpr (Heat) return load_row(rows_.affine.row[k], 1, g);
    return P::load(affine_row(k) + i);
  }
  MPM_HD const T* affine_row(int k) const {
    return Heat ? rows_.affine.row[k] + chunk_.begin : motion_.affine[k / D][k % D];
  }

  // Laws, and contributions of the particles to the nodes.
  void give(const BaseBlock<T, D>& base_block) {
    const P2GArguments<T, D>& p2g = a_.to_nodes.p2g;
    copies_.fetch_run(chunk_.begin, chunk_.count, [this](int k) { return affine_row(k); });
    copies_.apply_laws();
    const P dt(time_step(p2g.scene_dt, p2g.dt, base_block.scene));
    chunk_.template for_packs<N>([&](int i, const auto& g) {
      P x[D], f[D];
      ParticleMomentum<P, D> p;
      p.mass = load_row(mass_.row[0], 1, g);
      p.volume = load_row(volume_.row[0], 1, g);
      p.dt = dt;
      MPM_UNROLL for (int a = 0; a < D; a++) {
        x[a] = load_row(rows_.x_next.row[a], 1, g);
        p.velocity[a] = velocity(a, i, g);
        MPM_UNROLL for (int b = 0; b < D; b++)
          p.affine[a][b] = p2g.affine.pointer ? affine(a * D + b, i, g) : P(0);
      }
      p.stress = load_matrix_or_zero<T, D>(copies_.field(R::stress), RunOf<N>{i});
      find_cells(i, base_block, x, f);
      displacement_budget_.add(x, chunk_.count - i);
      contributions_.put(i, f, momentum_contribution<kOrder, true, Gradient>(t_.geometry, p, f));
    });
    copies_.leave();
  }

  const G2P2GChunksArguments<T, D>& a_;
  const Topology<T, D>& t_;
  ChunkInPlace<T, D> chunk_;
  const AdvancedRows<T, D> rows_;
  const FieldRows<const T, 1> mass_, volume_;
  std::conditional_t<Heat, HeatGather<T, D>, NoHeatGather<T, D>> heat_;
  DisplacementBudget<T, D> displacement_budget_;
  int out_of_block_ = 0;
  ScheduleOut written_;  // its orders and cells, chunk by chunk
  // For each particle of the chunk: its cell in the base block, kBlockNodes if it is in another block; and its cell
  // among the kNear^D cells around.
  uint8_t cell_[kChunk + N], near_[kChunk + N];
  Copies<T, D> copies_;
  Motion<Gradient, T, D> motion_;
  Contributions<kOrder, T, D, true, Gradient> contributions_;
  Lines<T, D> lines_;  // of the velocities
  Tile<kOrder, T, D> momenta_, velocities_;
};

template <bool Gradient, bool Heat, class T, int D>
void g2p2g_with(const G2P2GChunksArguments<T, D>& a) {
  for_base_blocks_in_turn(a.advance.gather.topology,
                          [&](int thread) { return ChunkPass<Gradient, Heat, T, D>(a, thread); });
}

}  // namespace

template <class T, int D>
void g2p2g_chunks(const G2P2GChunksArguments<T, D>& a) {
  if (a.heat)
    g2p2g_with<false, true>(a);
  else if (a.advance.form == StressForm::gradient)
    g2p2g_with<true, false>(a);
  else
    g2p2g_with<false, false>(a);
  const Topology<T, D>& t = a.advance.gather.topology;
  const int first = t.offsets[t.max_blocks];
  if (!a.follows || a.fresh) skip_outside(a.advance);
  if (a.follows && first < t.particles) laws_outside(a.to_nodes, first);
}

template <class T, int D>
void longest_move(const LongestMoveArguments<T, D>& a) {
  constexpr int kRows = 16, kStride = 1 + D, kGroup = kRows * kStride;
  constexpr int64_t grain = 256;  // slots below which a range is not split
  static_assert(kBlockNodes<D> % kRows == 0 && sizeof(NodeRow<T, D>) == kStride * sizeof(T));
  using Bits = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  *a.longest = T(0);
  parallel_ranges(a.slots, grain, [&](int64_t begin, int64_t end) {
    T most[kGroup] = {}, nan[kGroup] = {};
    for (int64_t slot = begin; slot < end; slot++) {
      const T dt = a.scene_dt ? a.scene_dt[a.block[slot] / a.blocks_per_scene] : T(1);
      for (int first = 0; first < kBlockNodes<D>; first += kRows) {
        const T* const from = reinterpret_cast<const T*>(a.nodes + slot * kBlockNodes<D> + first);
        for (int k = 0; k < kGroup; k++) {
          const T way = dt * from[k], move = way < 0 ? -way : way;
          most[k] = move > most[k] ? move : most[k];
          nan[k] += way - way;  // NaN if the velocity is not finite
        }
      }
    }
    T longest = 0;
    for (int k = 0; k < kGroup; k++)
      if (k % kStride > 0) {
        longest = most[k] > longest ? most[k] : longest;
        if (nan[k] != T(0)) longest = T(__builtin_inf());
      }
    // Numbers that are not negative have the order of their bits.
    Bits* const all = reinterpret_cast<Bits*>(a.longest);
    const Bits own = __builtin_bit_cast(Bits, longest);
    Bits now = __atomic_load_n(all, __ATOMIC_RELAXED);
    while (now < own && !__atomic_compare_exchange_n(all, &now, own, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
    }
  });
}

MPM_INSTANTIATE(g2p2g_chunks, G2P2GChunksArguments)
MPM_INSTANTIATE(longest_move, LongestMoveArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
