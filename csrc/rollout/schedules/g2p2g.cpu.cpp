#include "rollout/g2p2g_chunks.h"

#include <type_traits>

#include "cpu/cell_sort.h"
#include "rollout/copies.cpu.h"
#include "rollout/displacement_budget.cpu.h"
#include "transfer/advance_chunk.cpu.h"
#include "transfer/lines.cpu.h"
#include "transfer/own_nodes.cpu.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

// Quadratic splines: the nodes of particles up to one cell outside of their base blocks never overlap for two blocks of
// one colour, and sums over the colours in turn have an order.
constexpr int kOrder = 2;

// Number of cells along an axis in which the particles of a base block may be.
constexpr int kNear = kBlockWidth + 2;

// Up to kLanes particles of one cell, by ascending numbers in the chunk.
struct GroupOfChunk {
  int first, count;
  bool loads_run, stores_run, whole;
  Group group;  // if they are not consecutive

  MPM_HD GroupOfChunk(const uint16_t* order, int rest, int particles)
      : first(order[0] % kChunk), count(rest < kLanes ? rest : kLanes) {
    stores_run = order[count - 1] % kChunk - first == count - 1;
    loads_run = stores_run && first + kLanes <= particles;
    whole = count == kLanes;
    if (loads_run && (whole || kMasks)) return;
    int id[kLanes];
    for (int l = 0; l < count; l++) id[l] = order[l] % kChunk;
    group = group_of<kLanes>(id, count);
  }

  template <class T>
  MPM_HD Lanes<T> load(const T* row) const {
    return loads_run ? Lanes<T>::load(row + first) : load_row(row, 1, group);
  }
  template <bool Gradient, class T, int D>
  MPM_HD void put(Motion<Gradient, T, D>& motion, const Sums<Lanes<T>, D> s[D]) const {
    if (stores_run && whole) return motion.put_by([&](const Lanes<T>& v, T* row) { v.store(row + first); }, s);
#ifdef __AVX512VL__
    if (stores_run)
      return motion.put_by([&](const Lanes<T>& v, T* row) { v.store(row + first, (1u << count) - 1); }, s);
#endif
    motion.put_by([&](const Lanes<T>& v, T* row) { store_row(v, row, 1, group); }, s);
  }

 private:
#ifdef __AVX512VL__
  static constexpr bool kMasks = true;
#else
  static constexpr bool kMasks = false;
#endif
};

// The work of a thread on the chunks of its base blocks.
template <bool Gradient, class T, int D>
class ChunkPass {
 public:
  ChunkPass(const G2P2GChunksArguments<T, D>& a, T* copies)
      : a_(a),
        t_(a.advance.gather.topology),
        schedule_(schedule_of(t_)),
        rows_(a.advance),
        mass_(a.to_nodes.p2g.mass),
        volume_(a.to_nodes.p2g.volume),
        displacement_budget_(t_.geometry, a.follows ? a.to_nodes.whereabouts : nullptr),
        copies_(a.to_nodes, copies) {
    lay_out<D>(written_, a.to_nodes.schedule, t_.max_blocks, t_.particles);
  }
  ~ChunkPass() {
    if (a_.follows) __atomic_fetch_add(&a_.to_nodes.whereabouts->out_of_block, out_of_block_, __ATOMIC_RELAXED);
  }

  // `my_turn` waits for the sums of earlier colours.
  template <class F>
  void process(int64_t b, const F& my_turn) {
    const BaseBlock<T, D> base_block(t_, schedule_.base_slot[b]);
    displacement_budget_.begin(base_block);
    velocities_.load_from(a_.advance.gather.nodes, base_block, 0, D);
    lines_.load_from(velocities_);
    if (a_.follows) momenta_.clear();
    const int64_t chunks = schedule_.base_chunk[schedule_.colour_start[kColours<D>]];
    for (int64_t c = schedule_.base_chunk[b]; c < schedule_.base_chunk[b + 1]; c++) {
      const Chunk chunk(t_, schedule_, c), next(t_, schedule_, c + 1 < chunks ? c + 1 : c);
      begin_ = int(chunk.id - t_.index);
      count_ = chunk.count;
      order_ = written_.order + begin_;
      cell_end_ = written_.cell_end + c * kBlockNodes<D>;
      gather(base_block, next);
      for (int k = cell_end_[kBlockNodes<D> - 1]; k < count_; k++)
        gather_out_of_block(base_block.scene, order_[k] % kChunk);
      advance(base_block.scene);
      if (!a_.follows) continue;
      give(base_block);
      sort();
      sum_cells(contributions_, order_, cell_end_, momenta_);
      for (int k = cell_end_[kBlockNodes<D> - 1]; k < count_; k++) {
        my_turn();
        add_one_out_of_block(base_block, order_[k]);
      }
    }
    if (!a_.follows) return;
    my_turn();
    momenta_.add_to(a_.to_nodes.p2g.nodes, base_block, 0, 1 + D);
  }

 private:
  static constexpr int N = kWideLanes<T>;
  using P = Pack<T, N>;
  using R = ChunkRows<D>;

  // Calls f(number in the chunk, pack of particles from there on) for all packs.
  template <class F>
  MPM_HD void for_packs(const F& f) const {
    int i = 0;
    for (; i + N <= count_; i += N) f(i, RunOf<N>{begin_ + i});
    if (i < count_) f(i, PartOf<N>{begin_ + i, count_ - i});
  }

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

  void sort() {
    uint16_t end[kBlockNodes<D> + 1];
    sort_by_cell<kBlockNodes<D> + 1>(cell_, count_, order_, end);
    __builtin_memcpy(cell_end_, end, sizeof(*end) * kBlockNodes<D>);
  }

  // Sums of G2P for the particles that are in their base block.
  void gather(const BaseBlock<T, D>& base_block, const Chunk& next) {
    int prefetched = 0;
    for (int cell = 0, i = 0; cell < kBlockNodes<D>; cell++) {
      int base[D];
      for (int a = 0; a < D; a++) base[a] = cell_coordinate<D>(cell, a);
      for (const int end = cell_end_[cell]; i < end; i += kLanes) {
        const GroupOfChunk g(order_ + i, end - i, count_);
        Lanes<T> f[D];
        MPM_UNROLL for (int a = 0; a < D; a++)
          f[a] = distance_in_cells(t_.geometry, a, g.load(rows_.x_next.row[a] + begin_),
                                   Lanes<T>(T(base_block.corner[a] + base[a])));
        const T* at = lines_.value + lines_.at(base);
        // Most cells have one group: otherwise the compiler would store nodes for a second one on the stack.
        asm volatile("" : "+r"(at));
        Sums<Lanes<T>, D> s[D];
        gather_lines<Gradient, T, D>(f, at, s);
        g.put(motion_, s);
        for (; prefetched <= i; prefetched += 64 / int(sizeof(T))) prefetch(next, prefetched);
      }
      i = cell_end_[cell];
    }
  }

  // Prefetches the cache lines of the i-th particle of the next chunk. (GCC removes calls of functions that only
  // prefetch, unless they are inlined.)
  MPM_HD void prefetch(const Chunk& next, int i) const {
    if (i >= next.count) return;
    const int64_t p = next.id - t_.index + i;
    for (int k = 0; k < a_.to_nodes.prefetched_count; k++) __builtin_prefetch(a_.to_nodes.prefetched[k] + p, 0, 2);
  }

  void gather_out_of_block(int scene, int i) {
    int base[D];
    T f[D];
    for (int a = 0; a < D; a++) {
      const T x = rows_.x_next.row[a][begin_ + i], node = base_node<kOrder>(t_.geometry, a, x);
      base[a] = int(node);
      f[a] = distance_in_cells(t_.geometry, a, x, node);
    }
    const NodesOf<kOrder, T, D> nodes(t_, scene, base);
    const Sums<Node<T>, D> own = gather_own_nodes<kOrder, Gradient>(f, a_.velocities, nodes);
    Sums<T, D> s[D];
    for (int c = 0; c < D; c++) {
      s[c].value = own.value[1 + c];
      for (int a = 0; a < D; a++) {
        s[c].moment[a] = own.moment[a][1 + c];
        if (Gradient) s[c].gradient[a] = own.gradient[a][1 + c];
      }
    }
    motion_.put_by([&](const T& v, T* row) { row[i] = v; }, s);
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
    for_packs([&](int i, const auto& g) {
      Advanced<P, D> p;
      Matrix<P, D> L;
      motion_.get(i, scale, inverse_dx, p, L);
      read(p, rows_, g);
      end_step(p, L, dt, rows_);
      write_moved(p, rows_, g);
      if (!a_.follows) return write_motion(p, rows_, g);
      MPM_UNROLL for (int k = 0; k < D * D; k++)
        p.affine[k / D][k % D].store(motion_.affine[k / D][k % D] + i);
    });
  }

  // Laws, and contributions of the particles to the nodes.
  void give(const BaseBlock<T, D>& base_block) {
    const P2GArguments<T, D>& p2g = a_.to_nodes.p2g;
    copies_.fetch_run(begin_, count_, motion_.affine[0][0], motion_.kLine);
    copies_.apply_laws();
    const P dt(time_step(p2g.scene_dt, p2g.dt, base_block.scene));
    for_packs([&](int i, const auto& g) {
      P x[D], f[D];
      ParticleMomentum<P, D> p;
      p.mass = load_row(mass_.row[0], 1, g);
      p.volume = load_row(volume_.row[0], 1, g);
      p.dt = dt;
      MPM_UNROLL for (int a = 0; a < D; a++) {
        x[a] = load_row(rows_.x_next.row[a], 1, g);
        p.velocity[a] = P::load(motion_.velocity[a] + i);
        MPM_UNROLL for (int b = 0; b < D; b++)
          p.affine[a][b] = p2g.affine.pointer ? P::load(motion_.affine[a][b] + i) : P(0);
      }
      p.stress = load_matrix_or_zero<T, D>(copies_.field(R::stress), RunOf<N>{i});
      find_cells(i, base_block, x, f);
      displacement_budget_.add(x, count_ - i);
      contributions_.put(i, f, momentum_contribution<kOrder, true, Gradient>(t_.geometry, p, f));
    });
    copies_.leave();
  }

  const G2P2GChunksArguments<T, D>& a_;
  const Topology<T, D>& t_;
  const ScheduleIn schedule_;
  const AdvancedRows<T, D> rows_;
  const FieldRows<const T, 1> mass_, volume_;
  DisplacementBudget<T, D> displacement_budget_;
  int out_of_block_ = 0, begin_ = 0, count_ = 0;
  ScheduleOut written_;  // its orders and cells, chunk by chunk
  uint16_t *order_ = nullptr, *cell_end_ = nullptr;
  // For each particle of the chunk: its cell in the base block, kBlockNodes if it is in another block; and its cell
  // among the kNear^D cells around.
  uint8_t cell_[kChunk + N], near_[kChunk + N];
  Copies<T, D> copies_;
  Motion<Gradient, T, D> motion_;
  Contributions<kOrder, T, D, true, Gradient> contributions_;
  Lines<T, D> lines_;  // of the velocities
  Tile<kOrder, T, D> momenta_, velocities_;
};

template <bool Gradient, class T, int D>
void g2p2g_with(const G2P2GChunksArguments<T, D>& a) {
  const Topology<T, D>& t = a.advance.gather.topology;
  const ScheduleIn s = schedule_of(t);
  PhaseCounter<kColours<D>> colours{s.colour_start};
  int taken = 0;
  parallel_base_blocks<D>(s, t.particles, [&](const auto& next) {
    const LawsP2GArguments<T, D>& to = a.to_nodes;
    ChunkPass<Gradient, T, D> pass(a, to.copies + to.copy_size * __atomic_fetch_add(&taken, 1, __ATOMIC_RELAXED));
    int colour = 0;
    for (int64_t b; (b = next()) >= 0;) {
      while (b >= s.colour_start[colour + 1]) colour++;
      pass.process(b, [&] { colours.wait_before(colour); });
      colours.finish(colour);
    }
  });
}

}  // namespace

template <class T, int D>
void g2p2g_chunks(const G2P2GChunksArguments<T, D>& a) {
  if (a.advance.form == StressForm::gradient)
    g2p2g_with<true>(a);
  else
    g2p2g_with<false>(a);
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
