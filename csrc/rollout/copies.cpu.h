#pragma once

#include "cpu/chunk.h"
#include "cpu/parallel.h"
#include "rollout/laws_p2g.h"

// Copies of the rows of a chunk of particles, on which laws act.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

static_assert(kCopyLine >= kChunk + kRegisterBytes / int(sizeof(float)));

// Particles `first`, ... that are consecutive in memory and in the order of cells, from place `at` of the chunk on.
struct Stretch {
  int first, at, count;
};

// Copies `count` values. Places after these, up to `room` from the first one, may be overwritten.
template <class T>
MPM_HD void copy(const T* from, T* to, int count, [[maybe_unused]] int room) {
#ifdef __AVX512VL__
  constexpr int N = kRegisterBytes / sizeof(T);
  for (int i = 0; i < count; i += N) {
    const unsigned lanes = count - i < N ? (1u << (count - i)) - 1 : (2u << (N - 1)) - 1;
    if constexpr (sizeof(T) == 4) {
      const __m512i values = _mm512_maskz_loadu_epi32(__mmask16(lanes), from + i);
      i + N <= room ? _mm512_storeu_si512(to + i, values) : _mm512_mask_storeu_epi32(to + i, __mmask16(lanes), values);
    } else {
      const __m512i values = _mm512_maskz_loadu_epi64(__mmask8(lanes), from + i);
      i + N <= room ? _mm512_storeu_si512(to + i, values) : _mm512_mask_storeu_epi64(to + i, __mmask8(lanes), values);
    }
  }
#else
  for (int i = 0; i < count; i++) to[i] = from[i];
#endif
}

// Particles of a chunk, or particles outside, copied in the order of cells.
template <class T, int D>
class Copies {
 public:
  using R = ChunkRows<D>;

  Copies(const LawsP2GArguments<T, D>& arguments, T* memory) : a_(arguments), rows_(memory) {}

  T* row(int r) const { return rows_ + r * kCopyLine; }
  Field<const T> field(int r, int inner = D) const { return {row(r), {1, inner * kCopyLine, kCopyLine}}; }

  // Copies the particles at a place of the index, in the order of a chunk, if given. `next` and `next_count` are the
  // place and number of the particles of the next call.
  void fetch(int position, int count, int next, int next_count, const Chunk* order) {
    position_ = position;
    count_ = count;
    find_stretches(order);
    next_ = next;
    next_count_ = next_count;
    next_first_ = next_count ? __atomic_load_n(a_.index + next, __ATOMIC_RELAXED) : 0;
    find_rows();
  }

  // Copies consecutive particles from a place in memory on; affine(k) is row k of their affine fields.
  template <class F>
  void fetch_run(int position, int count, const F& affine) {
    position_ = position;
    count_ = count;
    stretches_ = 1;
    stretch_[0] = {position, 0, count};
    find_rows();
    for (int k = 0; k < D * D; k++) given_[R::C + k] = affine(k);
  }

  // Prefetches the cache lines of the i-th particle of the next call. The address may be wrong, even beyond the end of
  // a tensor, since nothing is read. (GCC removes calls of functions that only prefetch, unless they are inlined.)
  MPM_HD void prefetch(int i) const {
    if (i >= next_count_) return;
    for (int k = 0; k < a_.prefetched_count; k++) __builtin_prefetch(a_.prefetched[k] + (next_first_ + i), 0, 2);
    for (int k = 0; a_.rearranges && k < a_.row_count; k++) __builtin_prefetch(a_.rows[k].to + next_ + i, 1, 2);
  }

  // Particles i, i + 1, ... of the chunk.
  template <int N>
  MPM_HD GroupOf<N> group(int i) const {
    return group_of<N>(id_ + i, count_ - i);
  }

  // Evaluates stress and return maps.
  void apply_laws() {
    const int* const material = a_.has_material ? numbers_[kMaterialRow] : nullptr;
    bool mixed = false;
    for (int i = 1; material && i < count_; i++) mixed |= material[i] != material[0];
    const int only = material && !mixed ? material[0] : -1;
    if (mixed || (material && (only < 0 || only >= a_.material_count))) {  // some particles may have no law
      for (int k = 0; k < D * D; k++) __builtin_memset(row(R::stress + k), 0, count_ * sizeof(T));
    }
    for (int k = 0; k < a_.law_count; k++) {
      const ChunkLaw<T, D>& own = a_.laws[k];
      if (own.melts || (material && !mixed && own.material != only)) continue;  // its solid is before it
      const Members members = mixed ? Members{material, 1, own.material} : Members{};
      if (a_.temperature_row < 0 && a_.fraction_row < 0)
        own.update(here(own, members), nullptr);
      else
        apply_thermal_laws(own, k + 1 < a_.law_count && a_.laws[k + 1].melts ? &own + 1 : nullptr, members);
    }
  }

  // Writes the rows that change, or that change places.
  void leave() const {
    for (int k = 0; k < a_.row_count; k++) {
      const ParticleRow<T>& r = a_.rows[k];
      if (!r.to) continue;
      if (r.row >= 0)
        put(r, row(r.row));
      else
        get(r, r.to + position_, count_);  // only changes places
    }
    for (int k = 0; k < a_.number_count; k++)
      if (a_.numbers[k].to) put(a_.numbers[k], numbers_[a_.numbers[k].row]);
    if (a_.rearranges)
      for (int i = 0; i < count_; i++) a_.index[position_ + i] = position_ + i;
  }

 private:
  void find_stretches(const Chunk* order) {
    id_ = a_.index + position_;
    if (order && !order->sorted) {
      for (int i = 0; i < count_; i++) by_cell_[i] = id_[order->by_cell(i)];
      id_ = by_cell_;
    }
    stretches_ = 1;
    stretch_[0] = {id_[0], 0, count_};
    if (order && order->sorted) return;
    for (int i = 1; i < count_; i++) {  // without a branch
      stretch_[stretches_] = {id_[i], i, count_ - i};
      stretches_ += id_[i] != id_[i - 1] + 1;
    }
    for (int k = 1; k < stretches_; k++) stretch_[k - 1].count = stretch_[k].at - stretch_[k - 1].at;
    stretch_[stretches_ - 1].count = count_ - stretch_[stretches_ - 1].at;
  }

  void find_rows() {
    for (int k = 0; k < a_.row_count; k++) find_row(a_.rows[k]);
    for (int k = 0; k < a_.number_count; k++) get(a_.numbers[k], numbers_[a_.numbers[k].row], kCopyLine);
  }

  // Rows that laws only read are not copied if the particles are consecutive in memory.
  void find_row(const ParticleRow<T>& r) {
    if (r.row < 0) return;
    const bool stays = r.row < R::rest && !r.to && r.stride == 1 && stretches_ == 1;
    if (r.row < R::rest) given_[r.row] = stays ? r.from + stretch_[0].first : row(r.row);
    if (!stays) get(r, row(r.row), kCopyLine);
  }

  // D x D rows from r on, where they are read.
  Field<const T> given(int r) const { return {given_[r], {1, given_[r + D] - given_[r], given_[r + 1] - given_[r]}}; }

  template <class E>
  void get(const ParticleRow<E>& r, E* to, int room) const {
    if (r.stride == 1)
      for (int k = 0; k < stretches_; k++)
        copy(r.from + stretch_[k].first, to + stretch_[k].at, stretch_[k].count, room - stretch_[k].at);
    else
      for (int i = 0; i < count_; i++) to[i] = r.from[id_[i] * r.stride];
  }

  template <class E>
  void put(const ParticleRow<E>& r, const E* from) const {
    if (a_.rearranges) return copy(from, r.to + position_, count_, count_);
    for (int k = 0; k < stretches_; k++)
      copy(from + stretch_[k].at, r.to + stretch_[k].first, stretch_[k].count, stretch_[k].count);
  }

  Field<T> written(int r, int inner) const { return {row(r), {1, inner * kCopyLine, kCopyLine}}; }

  // Evaluates the first law of a material, and that of its liquid if it melts.
  void apply_thermal_laws(const ChunkLaw<T, D>& first, const ChunkLaw<T, D>* liquid, const Members& members) const {
    const ThermalLawsArguments<T, D> a = thermal_laws(first, liquid, members);
    for (int i = 0; i < count_ && a.begins(); i++) begin_laws_of(a, i);
    for (const ChunkLaw<T, D>* law : {&first, liquid}) {
      if (!law) continue;
      LawUpdateArguments<T, D> u = here(*law, members);
      if (a.has_elastic()) use_elastic(*law, u);
      if (law->melts) u.stress = written(a_.liquid_row, D);
      law->update(u, nullptr);
    }
    for (int i = 0; i < count_ && a.ends(); i++) end_laws_of(a, i);
  }

  // The state of a law is F or J without expansion.
  void use_elastic(const ChunkLaw<T, D>& law, LawUpdateArguments<T, D>& u) const {
    u.law.state = law.gradient ? field(a_.elastic_row) : Field<const T>{row(a_.elastic_row + D * D), {1, 0, 0}};
    if (law.plastic) u.state = written(a_.elastic_row, D);
  }

  ThermalLawsArguments<T, D> thermal_laws(const ChunkLaw<T, D>& first, const ChunkLaw<T, D>* liquid,
                                          const Members& members) const {
    ThermalLawsArguments<T, D> a;
    a.members = members;
    add_tables(first, a);
    if (liquid) add_tables(*liquid, a);
    a.theta = column(a_.temperature_row);
    a.expansion = first.temperature.expansion;
    if (!liquid && a.expansion.knots == 0) return a;
    a.F = given(R::F);
    a.J = {given_[R::J], {1, 0, 0}};
    if (liquid || first.gradient) a.elastic_F = written(a_.elastic_row, D);
    if (liquid || !first.gradient) a.elastic_J = {row(a_.elastic_row + D * D), {1, 0, 0}};
    a.is_plastic = first.plastic;
    if (liquid || first.plastic) a.next_F = written(R::F, D);
    if (!liquid) return a;
    a.next_J = {row(R::J), {1, 0, 0}};
    a.fraction = column(a_.fraction_row);
    a.coherency = liquid->temperature.coherency;
    a.stress = written(R::stress, D);
    a.liquid_stress = field(a_.liquid_row);
    if (a_.dissipated_row >= 0) a.dissipated = {row(a_.dissipated_row), {1, 0, 0}};
    return a;
  }

  void add_tables(const ChunkLaw<T, D>& law, ThermalLawsArguments<T, D>& a) const {
    for (int k = 0; k < kMostParameters; k++) {
      const TemperatureTable<T>& table = law.temperature.parameters[k];
      if (table.knots > 0) a.parameters[a.parameter_count++] = {table, row(law.parameters[k])};
    }
  }

  Field<const T> column(int r) const { return r < 0 ? Field<const T>{} : Field<const T>{row(r), {1, 0, 0}}; }

  LawUpdateArguments<T, D> here(const ChunkLaw<T, D>& law, const Members& members) const {
    LawUpdateArguments<T, D> u = law.arguments;
    LawArguments<T, D>& a = u.law;
    a.particles = count_;
    a.members = members;
    a.state = law.gradient ? given(R::F) : Field<const T>{given_[R::J], {1, 0, 0}};
    if (law.viscous && a_.has_C) a.C = given(R::C);
    a.scene = numbers_[kSceneRow];
    a.scene_stride = 1;
    for (int k = 0; k < kMostParameters; k++)
      if (law.parameters[k] >= 0) a.parameters[k] = {row(law.parameters[k]), 1, 0};
    for (int k = 0; k < kMostHistory; k++) {
      a.history[k] = {};
      if (law.history[k] >= 0) a.history[k] = field(law.history[k], law.matrix[k] ? D : 1);
    }
    u.stress = written(R::stress, D);
    if (a_.dissipated_row >= 0 && (law.plastic || law.history[0] >= 0))
      u.dissipated = {row(a_.dissipated_row), {1, 0, 0}};
    if (law.plastic) u.state = written(R::F, D);
    if (law.history[0] >= 0) u.history = written(law.history[0], 1);
    return u;
  }

  const LawsP2GArguments<T, D>& a_;
  T* const rows_;
  int position_ = 0, count_ = 0, stretches_ = 0, next_ = 0, next_first_ = 0, next_count_ = 0;
  const T* given_[R::rest];
  const int* id_ = nullptr;  // in the order of cells
  int by_cell_[kChunk], numbers_[kNumberRows][kCopyLine];
  Stretch stretch_[kChunk + 1];
};

// Evaluates the laws for particles outside the grid.
template <class T, int D>
void laws_outside(const LawsP2GArguments<T, D>& a, int first) {
  const int last = int(a.p2g.topology.particles), pieces[2] = {0, (last - first + kChunk - 1) / kChunk};
  int taken = 0;
  parallel_phases<1>(pieces, pieces[1], [&](const auto& next) {
    Copies<T, D> copies(a, a.copies + a.copy_size * __atomic_fetch_add(&taken, 1, __ATOMIC_RELAXED));
    for (int64_t piece; (piece = next()) >= 0;) {
      const int begin = first + int(piece) * kChunk;
      copies.fetch(begin, last - begin < kChunk ? last - begin : kChunk, begin, 0, nullptr);
      copies.apply_laws();
      copies.leave();
    }
  });
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
