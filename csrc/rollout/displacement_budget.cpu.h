#pragma once

#include "common/pack.h"
#include "cpu/base_block.h"
#include "cpu/chunk.h"
#include "rollout/laws_p2g.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Displacement budget: cells that particles can still move on each axis within their activation. They may be in the
// cells of their base block and in one more on both sides, and must stay on the lattice. For quadratic splines.
template <class T, int D>
class DisplacementBudget {
 public:
  static constexpr int N = kWideLanes<T>;
  using P = Pack<T, N>;

  // `all`, which may be null, receives the budget of all particles at the end.
  DisplacementBudget(const Geometry<T, D>& geometry, Whereabouts* all)
      : geometry_(geometry), all_(all), most_(-kBlockWidth) {}
  ~DisplacementBudget() {
    if (all_) flush();
  }

  void begin(const BaseBlock<T, D>& base_block) {
    for (int a = 0; a < D; a++) {
      const int corner = base_block.corner[a], end = geometry_.blocks[a] * kBlockWidth - 2;
      low_[a] = P(T(corner > 0 ? corner - 1 : 0));
      high_[a] = P(T(corner + kBlockWidth + 1 < end ? corner + kBlockWidth + 1 : end));
    }
  }

  // Adds the first `count` particles of a pack.
  MPM_HD void add(const P x[D], int count) {
    P most = most_;
    MPM_UNROLL for (int a = 0; a < D; a++) {
      const P place =
          (x[a] - P(geometry_.lower[a])) * P(geometry_.inverse_dx) + P(T(kPadding - BSpline<2>::base_offset));
      most = max(most, max(place - high_[a], low_[a] - place));
    }
    if (count >= N) {
      most_ = most;
    } else {
      for (int l = 0; l < count; l++) most_.set(l, most[l]);
    }
  }

 private:
  void flush() const {
    T most = most_[0];
    for (int l = 1; l < N; l++) most = most_[l] > most ? most_[l] : most;
    const float own = float(-most);
    float now;
    __atomic_load(&all_->displacement_budget, &now, __ATOMIC_RELAXED);
    while (own < now && !__atomic_compare_exchange(&all_->displacement_budget, &now, const_cast<float*>(&own), false,
                                                   __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
    }
  }

  const Geometry<T, D>& geometry_;
  Whereabouts* const all_;
  P low_[D], high_[D];
  P most_;  // largest excess over these
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
