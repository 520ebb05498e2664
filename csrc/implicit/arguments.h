#pragma once

#include "grid/topology.h"
#include "laws/tangent.h"
#include "transfer/arguments.h"

// The Hessian of an implicit step on the nodes,
//   H = diag(m) + Σ_p (∇N)ᵀ T_p ∇N,
// with T_p the weighted tangent of a particle (laws/tangent.h) and velocity gradients L = D⁻¹ Σ N_i v_i (x_i − x_p)ᵀ
// (MLS) or Σ v_i ∇N_iᵀ. It is never assembled: a product is a gather, the tangents, and a scatter.
namespace mpm {

// nodes += Σ_p (∇N)ᵀ T_p L_p of velocity gradients L.
template <class T, int D>
struct TangentScatterArguments {
  Topology<T, D> topology;
  Field<const T> x, tangent, gradient;  // [P, kTangentEntries<D>], [P, D, D]
  StressForm form = StressForm::mls;
  bool deterministic = false;
  NodeField<T> nodes;  // zero on entry, D channels
};

// Stresses T_p L_p, in place of the moments or gradients of a gather.
template <class T, int D>
struct TangentGatherArguments {
  GatherArguments<T, D> gather;
  Field<const T> tangent;  // [P, kTangentEntries<D>]
};

// The diagonal blocks of Σ_p (∇N)ᵀ T_p ∇N.
template <class T, int D>
struct NodeBlocksArguments {
  Topology<T, D> topology;
  Field<const T> x, tangent;
  StressForm form = StressForm::mls;
  bool deterministic = false;
  NodeField<T> nodes;  // zero on entry; kSymmetric<D> channels, the upper triangle
};

// Scalars of conjugate gradients of a scene. A scene that is done has steps of zero.
struct ConjugateGradients {
  double first, square;  // r · z at the start and now
  double step, turn;     // α, β
  int iterations;
  int state;  // a SolveState
};

enum SolveState : int { kSolving = 0, kConverged = 1, kNegativeCurvature = 2, kNotFinite = 3 };

// Vectors of conjugate gradients with a preconditioner of node blocks B⁻¹. Where B⁻¹ maps to a subspace of a node's
// velocities, as for held nodes, the solution stays in it. Where it does so only up to rounding, because the direction
// is not an axis, the reaction of a held node must be removed from the residual, which it would soon dominate: `held`.
template <class T, int D>
struct ConjugateGradientsArguments {
  int max_blocks = 0, scenes = 1, blocks_per_scene = 1;
  const int* block = nullptr;  // [max_blocks]
  const T* mass = nullptr;     // [N]
  const T* inverse = nullptr;  // [N, kSymmetric<D>], upper triangles
  const T* local = nullptr;    // likewise, additional diagonal block of a node; or null
  const T* held = nullptr;     // [N, D], unit vectors: directions in which nodes are held, zero for none; or null
  const T* rhs = nullptr;      // [N, D]
  int image_groups = 0;
  const int* images = nullptr;  // [image_groups, 2^D] rows of nodes that are images of one another, see `mirror_group`
  T* x = nullptr;               // [N, D], and the others
  T* r = nullptr;
  T* p = nullptr;
  T* q = nullptr;                       // on entry of `curvature` the product of the tangents alone
  double* slots = nullptr;              // [max_blocks], a sum over the nodes of each
  ConjugateGradients* scene = nullptr;  // [scenes]
  const T* relative = nullptr;          // [scenes], of the preconditioned residual
  int* unfinished = nullptr;            // scenes that are not done
  int* unfinished_on_host = nullptr;
  int max_iterations = 0;
  unsigned long long loop = 0;  // with CUDA 13: the condition of a graph of one iteration
};

inline namespace TORCH_MPM_ISA {

// A node's share of L: D⁻¹ N_i (x_i − x_p), or ∇N_i; offset from the base node, f distance of the particle, in cells.
template <int Order, class T, int D>
MPM_HD Vector<T, D> gradient_weight(StressForm form, const T (*w)[Order + 1], const T (*slope)[Order + 1],
                                    const int offset[D], const T f[D], const T& inverse_dx) {
  Vector<T, D> a;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    T product = inverse_dx;
    MPM_UNROLL for (int j = 0; j < D; j++)
      product = product * (i == j && form == StressForm::gradient ? slope[j][offset[j]] : w[j][offset[j]]);
    if (form == StressForm::mls) product = product * T(BSpline<Order>::inverse_inertia) * (T(offset[i]) - f[i]);
    a[i] = product;
  }
  return a;
}

// The product of a symmetric matrix, by its upper triangle, and a vector of a node.
template <class T, int D>
MPM_HD Vector<T, D> symmetric_times(const T* upper, const T* r) {
  Vector<T, D> z = zero_vector<T, D>();
  int n = 0;
  MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
    for (int j = i; j < D; j++, n++) {
      z[i] += upper[n] * r[j];
      if (i != j) z[j] += upper[n] * r[i];
    }
  return z;
}

// Decisions for a scene from a sum over its nodes.
enum class CGPhase : int { start, curvature, step };

MPM_HD void advance_scene(ConjugateGradients& s, CGPhase phase, double sum, double relative) {
  if (phase == CGPhase::start) {
    s = {sum, sum, 0, 0, 0, sum > 0 ? kSolving : sum < 0 ? kNegativeCurvature : kConverged};
  } else if (s.state != kSolving) {
    s.step = s.turn = 0;
  } else if (phase == CGPhase::curvature) {
    s.step = sum > 0 ? s.square / sum : 0;
    if (!(sum > 0)) s.state = kNegativeCurvature;
  } else {
    s.turn = sum / s.square;
    s.square = sum;
    s.iterations++;
    if (sum < 0) {  // preconditioner made indefinite by rounding
      s.state = kNegativeCurvature;
      s.turn = 0;
    } else if (sum <= relative * relative * s.first) {
      s.state = kConverged;
    }
  }
  if (!(sum - sum == 0)) {
    s.state = kNotFinite;
    s.step = s.turn = 0;
  }
}

// Operations at a node in each phase, and its summand in the sum of its slot. A node of an unused slot has zeros.
template <class T, int D>
MPM_HD double cg_start(const ConjugateGradientsArguments<T, D>& a, int64_t node) {
  double sum = 0;
  const Vector<T, D> z = symmetric_times<T, D>(a.inverse + node * kSymmetric<D>, a.rhs + node * D);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const int64_t k = node * D + i;
    a.x[k] = T(0);
    a.r[k] = a.rhs[k];
    a.p[k] = z[i];
    sum += double(a.rhs[k]) * double(z[i]);
  }
  return sum;
}

template <class T, int D>
MPM_HD double cg_curvature(const ConjugateGradientsArguments<T, D>& a, int64_t node) {
  double sum = 0;
  Vector<T, D> local = zero_vector<T, D>();
  if (a.local) local = symmetric_times<T, D>(a.local + node * kSymmetric<D>, a.p + node * D);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const int64_t k = node * D + i;
    a.q[k] += a.mass[node] * a.p[k] + local[i];
    sum += double(a.q[k]) * double(a.p[k]);
  }
  if (!a.held) return sum;
  const T* n = a.held + node * D;
  T along = T(0);
  MPM_UNROLL for (int i = 0; i < D; i++)
    along += n[i] * a.q[node * D + i];
  MPM_UNROLL for (int i = 0; i < D; i++)
    a.q[node * D + i] -= along * n[i];
  return sum;
}

template <class T, int D>
MPM_HD double cg_step(const ConjugateGradientsArguments<T, D>& a, int64_t node, double step) {
  double sum = 0;
  MPM_UNROLL for (int i = 0; i < D; i++) {
    const int64_t k = node * D + i;
    if (step == 0) continue;  // of a scene whose directions may not be finite
    a.x[k] += T(step) * a.p[k];
    a.r[k] -= T(step) * a.q[k];
  }
  const Vector<T, D> z = symmetric_times<T, D>(a.inverse + node * kSymmetric<D>, a.r + node * D);
  MPM_UNROLL for (int i = 0; i < D; i++)
    sum += double(a.r[node * D + i]) * double(z[i]);
  return sum;
}

template <class T, int D>
MPM_HD void cg_turn(const ConjugateGradientsArguments<T, D>& a, int64_t node, const ConjugateGradients& s) {
  const Vector<T, D> z = symmetric_times<T, D>(a.inverse + node * kSymmetric<D>, a.r + node * D);
  MPM_UNROLL for (int i = 0; i < D; i++) {
    T& p = a.p[node * D + i];
    p = s.state == kSolving ? z[i] + T(s.turn) * p : T(0);
  }
}

// Products of nodes that mirrors identify become their common part: the mean of their reflections. Entry k of a group
// is the row of the node that the axes of the bits of k reflect, -1 for none; a node on a plane is its own image.
template <class T, int D>
MPM_HD void mirror_group(const ConjugateGradientsArguments<T, D>& a, int group) {
  const int* rows = a.images + int64_t(group) * (1 << D);
  const int64_t N = int64_t(a.max_blocks) * kBlockNodes<D>;
  const auto present = [&](int k) { return rows[k] >= 0 && rows[k] < N; };
  Vector<T, D> mean = zero_vector<T, D>();
  int count = 0;
  for (int k = 0; k < 1 << D; k++) {
    if (!present(k)) continue;
    count++;
    MPM_UNROLL for (int i = 0; i < D; i++)
      mean[i] += (k >> i & 1 ? T(-1) : T(1)) * a.q[rows[k] * int64_t(D) + i];
  }
  for (int k = 0; k < 1 << D; k++) {
    if (!present(k)) continue;
    MPM_UNROLL for (int i = 0; i < D; i++)
      a.q[rows[k] * int64_t(D) + i] = (k >> i & 1 ? T(-1) : T(1)) * mean[i] / T(count);
  }
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
