#pragma once

#include "common/pack.h"
#include "cpu/base_block.h"
#include "rollout/laws_p2g.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// What particles have left to go before their activation no longer serves them: on each axis they may be in the cells
// of their base block and in one more on both sides, and must stay on the lattice. For quadratic splines.
template <class T, int D>
class Slack {
 public:
  static constexpr int N = kRegisterBytes / sizeof(T);
  using P = Pack<T, N>;

  // For `all`, which may be null.
  Slack(const Geometry<T, D>& geometry, Whereabouts* all) : geometry_(geometry), all_(all), least_(kBlockWidth) {}
  ~Slack() {
    if (all_) tell();
  }

  void begin(const BaseBlock<T, D>& base_block) {
    for (int a = 0; a < D; a++) {
      const int corner = base_block.corner[a], end = geometry_.blocks[a] * kBlockWidth - 2;
      low_[a] = P(T(corner > 0 ? corner - 1 : 0));
      high_[a] = P(T(corner + kBlockWidth + 1 < end ? corner + kBlockWidth + 1 : end));
    }
  }

  // Particles of which `count` count.
  MPM_HD void add(const P x[D], int count) {
    P least = least_;
    MPM_UNROLL for (int a = 0; a < D; a++) {
      const P place = (x[a] - P(geometry_.lower[a])) * P(geometry_.inverse_dx) +
                      P(T(kPadding - BSpline<2>::base_offset));
      least = min_of(least, min_of(place - low_[a], high_[a] - place));
    }
    T number[N];
    MPM_UNROLL for (int l = 0; l < N; l++)
      number[l] = T(l);
    least_ = select(P::load(number) < P(T(count)), least, least_);
  }

 private:
  void tell() const {
    T least = least_[0];
    for (int l = 1; l < N; l++) least = least_[l] < least ? least_[l] : least;
    const float own = float(least);
    float now;
    __atomic_load(&all_->slack, &now, __ATOMIC_RELAXED);
    while (own < now && !__atomic_compare_exchange(&all_->slack, &now, const_cast<float*>(&own), false,
                                                   __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
    }
  }

  MPM_HD static P min_of(const P& a, const P& b) { return select(a < b, a, b); }

  const Geometry<T, D>& geometry_;
  Whereabouts* const all_;
  P low_[D], high_[D], least_;
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
