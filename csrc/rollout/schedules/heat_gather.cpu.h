#pragma once

#include "heat/packs.cpu.h"
#include "rollout/schedules/chunk_in_place.cpu.h"
#include "transfer/lines.cpu.h"

// G2P of heat for chunks of particles in place.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T, int D>
class HeatGather {
 public:
  explicit HeatGather(const HeatToParticlesArguments<T, D>* a)
      : a_(*a), rows_(reinterpret_cast<const ChannelRow<T>*>(a->nodes.pointer - kHeatTheta)) {}

  // Prefetches a particle, without the fields of the step.
  MPM_HD void prefetch(int64_t p) const {
    __builtin_prefetch(a_.blend.pointer + p, 0, 2);
    if (a_.liquid.pointer) __builtin_prefetch(a_.number.pointer + p, 0, 2);
  }

  void begin(const BaseBlock<T, D>& base_block) {
    tile_.load_from(a_.nodes, base_block, 0, kFields);
    lines_.load_from(tile_);
  }

  MPM_HD void gather(const GroupOfChunk& g, const int base[D], const Lanes<T> f[D]) {
    const T* at = lines_.value + lines_.at(base);
    asm volatile("" : "+r"(at));  // as for velocities
    Sums<Lanes<T>, D> s[kFields];
    gather_fields(f, at, s);
    g.template store_by<T>([&](const auto& store) { put_by(store, s); });
  }

  void gather_one(int i, const T f[D], const NodesOf<kOrderInPlace, T, D>& nodes) {
    Sums<T, D> s[kFields];
    split_channels<kHeatTheta, false>(gather_own_nodes<kOrderInPlace, false>(f, rows_, nodes), s);
    put_by([&](const T& v, T* row) { row[i] = v; }, s);
  }

  // Temperatures of the i-th particle of the chunk and the following ones.
  template <class G>
  MPM_HD void finish(int i, const G& g, int scene, const Matrix<Pack<T, G::kSize>, D>& L) {
    using P = Pack<T, G::kSize>;
    Sums<P, D> s[kFields];
    MPM_UNROLL for (int c = 0; c < kFields; c++) {
      s[c].value = P::load(value_[c] + i);
      MPM_UNROLL for (int d = 0; d < D; d++)
        s[c].moment[d] = P::load(moment_[c][d] + i);
    }
    const P scale(a_.moment_scale * double(a_.topology.geometry.dx));
    front_.add(finish_heat(a_, g, scene, s, scale, L));
  }

  void end(int scene) {
    if (a_.liquid.pointer) front_.raise(a_.largest + scene * kHeatStatusSize);
    front_ = {};
  }

 private:
  static constexpr int kFields = kHeatChannels - kHeatTheta;  // increment and θ̄
  static constexpr int kLine = Motion<false, T, D>::kLine;

  MPM_HD static void gather_fields(const Lanes<T> f[D], const T* lines, Sums<Lanes<T>, D> s[kFields]) {
    if constexpr (kHasPairs<T>) {
      static_assert(kFields == 2);
      Pairs<T> distance[D];
      MPM_UNROLL for (int a = 0; a < D; a++)
        distance[a] = for_both(f[a]);
      Sums<Pairs<T>, D> both;
      gather_lines<1, false, T, D>(distance, lines, &both);
      s[0].value = of_channel<0>(both.value), s[1].value = of_channel<1>(both.value);
      MPM_UNROLL for (int a = 0; a < D; a++)
        s[0].moment[a] = of_channel<0>(both.moment[a]), s[1].moment[a] = of_channel<1>(both.moment[a]);
    } else {
      gather_lines<kFields, false, T, D>(f, lines, s);
    }
  }

  template <class F, class V>
  MPM_HD void put_by(const F& store, const Sums<V, D> s[kFields]) {
    const bool affine = a_.gradient.pointer;
    MPM_UNROLL for (int c = 0; c < kFields; c++) {
      store(s[c].value, value_[c]);
      if (affine) MPM_UNROLL
        for (int d = 0; d < D; d++) store(s[c].moment[d], moment_[c][d]);
    }
  }

  const HeatToParticlesArguments<T, D>& a_;
  const ChannelRow<T>* const rows_;
  Tile<kOrderInPlace, T, D> tile_;
  Lines<T, D> lines_;
  Largest<T> front_;
  alignas(64) T value_[kFields][kLine], moment_[kFields][D][kLine];
};

template <class T, int D>
struct NoHeatGather {
  explicit NoHeatGather(const HeatToParticlesArguments<T, D>*) {}
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
