#pragma once

#include "laws/principal_law.h"

// Elasticities in principal strains shared by several laws.
namespace mpm {
inline namespace TORCH_MPM_ISA {

// Small strain elasticity in Hencky strains: ψ = μ Σ hᵢ² + λ/2 (tr h)² (Hencky 1928). The parameters begin with μ, λ
// [Pa]. Convex maps of the deviator and the trace are radial.
struct HenckyElasticity : PrincipalLaw {
  template <class T, int D>
  MPM_HD static T energy(const Vector<T, D>& h, const T p[], const T[]) {
    const T trace = sum(h);
    return p[0] * dot(h, h) + T(0.5) * p[1] * trace * trace;
  }

  template <class T, int D>
  MPM_HD static Vector<T, D> stress(const Vector<T, D>& h, const T p[], const T[]) {
    const T dilation = p[1] * sum(h);
    Vector<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r[i] = T(2) * p[0] * h[i] + dilation;
    return r;
  }

  template <class T, int D>
  MPM_HD static PrincipalTangent<T, D> tangent(const Vector<T, D>&, const T p[], const T[]) {
    PrincipalTangent<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r.shear[i] = T(2) * p[0];
    r.dilation = p[1];
    return r;
  }

  template <class T>
  MPM_HD static T stress_quotient(const T&, const T&, const T p[], const T[]) {
    return T(2) * p[0];
  }

  template <class T, int D>
  MPM_HD static T map_quotient(const Flow<T>& flow, const Vector<T, D>&, const Vector<T, D>&, int, int) {
    return flow.kappa;
  }

  // Without a stored energy of hardening all plastic work is heat.
  template <class T, int D>
  MPM_HD static T lost(const Vector<T, D>& h, const Vector<T, D>& H, const T p[], const T[], const T q[]) {
    return max(plastic_work(stress(H, p, q), h, H), T(0));
  }
};

// Fixed corotated elasticity (Stomakhin et al. 2012, section 4): ψ = μ Σ (σᵢ − 1)² + λ/2 (J − 1)², so
// τᵢ = 2μ σᵢ (σᵢ − 1) + λ J (J − 1). With σ − 1 = e^h − 1, nothing cancels near rest.
struct FixedCorotatedElasticity : PrincipalLaw {
  template <class T, int D>
  MPM_HD static T energy(const Vector<T, D>& h, const T p[], const T[]) {
    const T volumetric = expm1(sum(h));
    T squares = T(0);
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const T e = expm1(h[i]);
      squares = squares + e * e;
    }
    return p[0] * squares + T(0.5) * p[1] * volumetric * volumetric;
  }

  template <class T, int D>
  MPM_HD static Vector<T, D> stress(const Vector<T, D>& h, const T p[], const T[]) {
    const T volumetric = expm1(sum(h)), dilation = p[1] * (volumetric + T(1)) * volumetric;
    Vector<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const T e = expm1(h[i]);
      r[i] = T(2) * p[0] * (e + T(1)) * e + dilation;
    }
    return r;
  }

  template <class T, int D>
  MPM_HD static PrincipalTangent<T, D> tangent(const Vector<T, D>& h, const T p[], const T[]) {
    const T volumetric = expm1(sum(h));
    PrincipalTangent<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++) {
      const T e = expm1(h[i]);
      r.shear[i] = T(2) * p[0] * (e + T(1)) * (T(2) * e + T(1));
    }
    r.dilation = p[1] * (volumetric + T(1)) * (T(2) * volumetric + T(1));
    return r;
  }

  // 2μ (σᵢ + σⱼ − 1) (σᵢ − σⱼ)/(hᵢ − hⱼ).
  template <class T>
  MPM_HD static T stress_quotient(const T& a, const T& b, const T p[], const T[]) {
    const T slope = exponential(T(0.5) * (a + b)) * sinhc(T(0.5) * (a - b));
    return T(2) * p[0] * (expm1(a) + expm1(b) + T(1)) * slope;
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
