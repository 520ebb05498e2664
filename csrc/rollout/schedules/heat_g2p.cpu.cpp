#include "heat/packs.cpu.h"
#include "rollout/g2p2g_chunks.h"
#include "rollout/schedules/heat_gather.cpu.h"
#include "transfer/scatter.cpu.h"

// G2P of the velocities and P2G of heat in one pass over the particles, while an activation lasts.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

// The work of a thread on the chunks of its base blocks.
template <class T, int D>
class HeatChunkPass {
 public:
  explicit HeatChunkPass(const HeatG2PChunksArguments<T, D>& a)
      : a_(a),
        t_(a.advance.gather.topology),
        chunk_(t_),
        rows_(a.advance),
        nodes_(reinterpret_cast<ChannelRow<T>*>(a.to_nodes.sums.pointer)) {
    const HeatParticles<T>& p = a.to_nodes.particles;
    for (const Field<const T>& f : {p.volume, a.to_nodes.mass, p.theta}) prefetched_[count_++] = f.pointer;
    for (int d = 0; d < D; d++) {
      prefetched_[count_++] = rows_.x_next.row[d];
      if (p.gradient.pointer) prefetched_[count_++] = row_of(p.gradient, d);
    }
    for (const Field<T>& f : {a.to_nodes.conductance, a.to_nodes.blend, a.to_nodes.number})
      if (f.pointer) written_[written_count_++] = f.pointer;
  }

  // `my_turn` waits for the sums of earlier colours.
  template <class F>
  void process(int64_t b, const F& my_turn) {
    const BaseBlock<T, D> base_block(t_, chunk_.schedule.base_slot[b]);
    velocities_.load_from(a_.advance.gather.nodes, base_block, 0, D);
    lines_.load_from(velocities_);
    sums_.clear();
    largest_ = {};
    chunk_.for_chunks(b, [&](int64_t, const Chunk& next) {
      gather(base_block, next);
      chunk_.for_out_of_block([&](int i) { gather_out_of_block(base_block, i); });
      give(base_block.scene);
      sum_cells(contributions_, chunk_.order, chunk_.cell_end, sums_);
      chunk_.for_out_of_block([&](int i) {
        my_turn();
        add_to_own_nodes(contributions_, i, nodes_, nodes_of(base_block, i));
      });
    });
    largest_.raise(a_.to_nodes.largest + base_block.scene);
    my_turn();
    sums_.add_to(a_.to_nodes.sums, base_block, 0, kHeatChannels);
  }

 private:
  static constexpr int kOrder = kOrderInPlace;
  static constexpr int N = kWideLanes<T>;
  using P = Pack<T, N>;

  void gather(const BaseBlock<T, D>& base_block, const Chunk& next) {
    int prefetched = 0;
    chunk_.for_groups(rows_.x_next, base_block,
                      [&](const GroupOfChunk& g, int i, const int base[D], const Lanes<T> f[D]) {
                        const T* at = lines_.value + lines_.at(base);
                        asm volatile("" : "+r"(at));  // as in g2p2g.cpu.cpp
                        Sums<Lanes<T>, D> s[D];
                        gather_lines<D, false, T, D>(f, at, s);
                        g.template store_by<T>([&](const auto& store) {
                          motion_.put_by(store, s);
                          MPM_UNROLL for (int a = 0; a < D; a++)
                            store(f[a], distance_[a]);
                        });
                        for (; prefetched <= i; prefetched += 64 / int(sizeof(T))) prefetch(next, prefetched);
                      });
  }

  // Prefetches the cache lines of the i-th particle of the next chunk.
  MPM_HD void prefetch(const Chunk& next, int i) const {
    if (i >= next.count) return;
    const int64_t p = next.id - t_.index + i;
    for (int k = 0; k < count_; k++) __builtin_prefetch(prefetched_[k] + p, 0, 2);
    for (int k = 0; k < written_count_; k++) __builtin_prefetch(written_[k] + p, 1, 2);
    MPM_UNROLL for (int k = 0; k < D; k++)
      __builtin_prefetch(rows_.v.row[k] + p, 1, 2);
    MPM_UNROLL for (int k = 0; k < D * D; k++)
      __builtin_prefetch(rows_.affine.row[k] + p, 1, 2);
  }

  void gather_out_of_block(const BaseBlock<T, D>& base_block, int i) {
    int base[D];
    T f[D];
    chunk_.locate(rows_.x_next, i, base, f);
    int near = 0;
    for (int a = 0; a < D; a++) {
      near = near * kNear + base[a] - base_block.corner[a] + 1;
      distance_[a][i] = f[a];
    }
    near_[i] = uint8_t(near);
    Sums<T, D> s[D];
    split_channels<1, false>(gather_own_nodes<kOrder, false>(f, a_.velocities, nodes_of(base_block, i)), s);
    motion_.put_by([&](const T& v, T* row) { row[i] = v; }, s);
  }

  // Of a particle out of its block.
  NodesOf<kOrder, T, D> nodes_of(const BaseBlock<T, D>& base_block, int i) const {
    int base[D];
    for (int a = D - 1, near = near_[i]; a >= 0; a--, near /= kNear) base[a] = base_block.corner[a] + near % kNear - 1;
    return {t_, base_block.scene, base};
  }

  // Writes v and C, and finds the contributions to the nodes.
  void give(int scene) {
    const P scale(a_.advance.gather.moment_scale * double(t_.geometry.dx)), inverse_dx(t_.geometry.inverse_dx);
    chunk_.template for_packs<N>([&](int i, const auto& g) {
      Advanced<P, D> p;
      Matrix<P, D> L;
      motion_.get(i, scale, inverse_dx, p, L);
      write_motion(p, rows_, g);
      P f[D];
      MPM_UNROLL for (int a = 0; a < D; a++)
        f[a] = P::load(distance_[a] + i);
      contributions_.put(i, f, heat_contribution(a_.to_nodes, g, scene, f, strain_rate_of(L), largest_));
    });
  }

  const HeatG2PChunksArguments<T, D>& a_;
  const Topology<T, D>& t_;
  ChunkInPlace<T, D> chunk_;
  const AdvancedRows<T, D> rows_;
  ChannelRow<T>* const nodes_;
  const T* prefetched_[3 + 2 * D];
  T* written_[3];
  int count_ = 0, written_count_ = 0;
  Largest<T> largest_;
  uint8_t near_[kChunk];  // of particles out of the block: their cells among the kNear^D cells around
  Motion<false, T, D> motion_;
  alignas(64) T distance_[D][Motion<false, T, D>::kLine];  // from the base nodes [cells]
  Contributions<kOrder, T, D, true, false> contributions_;
  Lines<T, D> lines_;  // of the velocities
  Tile<kOrder, T, D> sums_, velocities_;
};

}  // namespace

template <class T, int D>
void heat_g2p_chunks(const HeatG2PChunksArguments<T, D>& a) {
  for_base_blocks_in_turn(a.advance.gather.topology, [&](int) { return HeatChunkPass<T, D>(a); });
  heat_outside(a.to_nodes);
}

MPM_INSTANTIATE(heat_g2p_chunks, HeatG2PChunksArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
