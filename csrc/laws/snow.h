#pragma once

#include "laws/elasticity.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// Snow (Stomakhin et al. 2013): fixed corotated elasticity whose principal stretches stay within [1 − θ_c, 1 + θ_s] and
// whose moduli grow with plastic compaction, μ e^(ξ (1 − J_p)).
struct Snow : FixedCorotatedElasticity {
  static constexpr const char* name = "snow";
  static constexpr std::array parameters = {not_negative("mu", "Pa"), real("lam", "Pa"),
                                            Quantity{"critical_compression", "", 0, 1, true, false},
                                            not_negative("critical_stretch", ""), not_negative("hardening", "")};
  static constexpr std::array history = {real("log_plastic_volume", "")};
  static constexpr bool plastic = true;

  template <class T, int D>
  MPM_HD static Flow<T> flow(Vector<T, D>& h, const T p[], T q[]) {
    const T low = log_1p(T(1) - p[2], T(0) - p[2]), high = log_1p(T(1) + p[3], p[3]);
    auto plastic = T(0) < T(0);
    T lost = T(0);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const auto short_ = h[i]<low, long_ = h[i]> high;
      const T clamped = select(short_, low, select(long_, high, h[i]));
      lost = lost + (h[i] - clamped);
      h[i] = clamped;
      plastic = plastic | short_ | long_;
    }
    q[0] = q[0] + lost;
    return {T(1), plastic, T(0) == T(0)};
  }

  template <class T, int D>
  MPM_HD static T map_quotient(const Flow<T>&, const Vector<T, D>& h, const Vector<T, D>& H, int i, int j) {
    const T trial = h[i] - h[j];
    const auto equal = trial == T(0);
    return select(equal, select(h[i] == H[i], T(1), T(0)), (H[i] - H[j]) / select(equal, T(1), trial));
  }

  // Hardening stores the energy that it adds to the elastic energy. The clamp may raise the volumetric energy by more
  // than it lowers the other: the sum is then zero.
  template <class T, int D>
  MPM_HD static T lost(const Vector<T, D>& h, const Vector<T, D>& H, const T p[], const T before[], const T q[]) {
    const T stored = energy(H, p, q) - energy(H, p, before);
    return max(plastic_work(stress(H, p, q), h, H) - stored, T(0));
  }

  template <class T, int D>
  MPM_HD static T energy(const Vector<T, D>& h, const T p[], const T q[]) {
    return hardening(p, q) * FixedCorotatedElasticity::energy(h, p, q);
  }

  template <class T, int D>
  MPM_HD static Vector<T, D> stress(const Vector<T, D>& h, const T p[], const T q[]) {
    return hardening(p, q) * FixedCorotatedElasticity::stress(h, p, q);
  }

  template <class T, int D>
  MPM_HD static PrincipalTangent<T, D> tangent(const Vector<T, D>& h, const T p[], const T q[]) {
    const T factor = hardening(p, q);
    PrincipalTangent<T, D> r = FixedCorotatedElasticity::tangent(h, p, q);
    return {factor * r.shear, factor * r.dilation};
  }

  template <class T>
  MPM_HD static T stress_quotient(const T& a, const T& b, const T p[], const T q[]) {
    return hardening(p, q) * FixedCorotatedElasticity::stress_quotient(a, b, p, q);
  }

 private:
  template <class T>
  MPM_HD static T hardening(const T p[], const T q[]) {
    return exponential(T(0) - p[4] * expm1(q[0]));
  }
};

MPM_REGISTER_LAW(Snow)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
