#pragma once

#include "laws/elasticity.h"

namespace mpm {
inline namespace TORCH_MPM_ISA {

// J2 plasticity with linear isotropic hardening on Hencky elasticity: √(3/2) |dev τ| ≤ σ_y + H ε̄, associated flow with
// dε̄ = √(2/3) |dh_p|. Backward Euler is a radial return in closed form (Simo 1992; Simo and Hughes 1998, section 3.3).
// In 2-D the same bound on the in-plane deviator is the shear strength σ_y/√3, as in fully plastic plane strain.
struct VonMises : HenckyElasticity {
  static constexpr const char* name = "von_mises";
  static constexpr std::array parameters = {not_negative("mu", "Pa"), real("lam", "Pa"),
                                            not_negative("yield_stress", "Pa"), not_negative("hardening", "Pa")};
  static constexpr std::array history = {real("plastic_strain", "")};
  static constexpr bool plastic = true;

  template <class T, int D>
  MPM_HD static Flow<T> flow(Vector<T, D>& h, const T p[], T q[]) {
    const Deviator<T, D> s = measure_deviator(h);
    const T shear = T(2) * p[0], hardening = T(2.0 / 3) * p[3];
    const T radius = T(0.81649658092772603) * max(p[2] + p[3] * q[0], T(0));
    const auto plastic = shear * s.norm > radius;
    const T norm = select(plastic, s.norm, T(1)), stiffness = select(plastic, shear + hardening, T(1));
    // |H| = |h| − (2μ |h| − radius)/(2μ + 2H/3), written without the difference.
    const T kappa = select(plastic, (hardening * norm + radius) / (stiffness * norm), T(1));
    const T step = select(plastic, (shear * s.norm - radius) / stiffness, T(0));
    h = select(plastic, scale_deviator(h, s.mean, s.mean, kappa), h);
    q[0] = q[0] + T(0.81649658092772603) * step;
    return {kappa, plastic, T(0) == T(0)};
  }

  // σ_y Δε̄: of the plastic work (σ_y + H ε̄) Δε̄ hardening stores ½ H ε̄² (Simo and Hughes 1998, section 3.2).
  template <class T, int D>
  MPM_HD static T lost(const Vector<T, D>& h, const Vector<T, D>& H, const T p[], const T[], const T[]) {
    return T(0.81649658092772603) * max(p[2], T(0)) * max(measure_deviator(h).norm - measure_deviator(H).norm, T(0));
  }
};

MPM_REGISTER_LAW(VonMises)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
