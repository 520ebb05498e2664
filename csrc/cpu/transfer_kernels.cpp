#include "cpu/kernels.h"
#include "cpu/parallel.h"
#include "cpu/schedule.h"
#include "math/matrix.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

template <class T>
MPM_HD T& at(const Field<T>& f, int64_t p, int i = 0, int j = 0) {
  return f.pointer[p * f.stride[0] + i * f.stride[1] + j * f.stride[2]];
}

// One particle in its home block: its weights and the rows of its nodes.
template <int Order, class T, int D>
struct Support {
  static constexpr int S = Order + 1;
  int base[D];
  T f[D], w[D][S], dw[D][S], ddw[D][S];

  bool locate(const Topology<T, D>& t, const Field<const T>& x, int64_t p) {
    T position[D];
    for (int i = 0; i < D; i++) position[i] = at(x, p, i);
    if (!mpm::locate<Order>(t.geometry, position, base, f)) return false;
    for (int i = 0; i < D; i++) {
      BSpline<Order>::weights(f[i], w[i]);
      BSpline<Order>::first_derivatives(f[i], dw[i]);
      BSpline<Order>::second_derivatives(f[i], ddw[i]);
    }
    return true;
  }

  // visit(row of the node, N, distance in cells, ∇N in cells, ∇∇N in cells)
  template <class F>
  void for_nodes(const Topology<T, D>& t, int scene, const F& visit) const {
    int count = 1;
    for (int i = 0; i < D; i++) count *= S;
    for (int n = 0; n < count; n++) {
      int k[D], node[D], block[D];
      for (int i = D - 1, rest = n; i >= 0; i--, rest /= S) k[i] = rest % S;
      Vector<T, D> r, g;
      Matrix<T, D> h;
      T N = 1;
      for (int i = 0; i < D; i++) {
        node[i] = base[i] + k[i];
        block[i] = node[i] / kBlockWidth;
        r[i] = T(k[i]) - f[i];
        N *= w[i][k[i]];
        g[i] = 1;
        for (int j = 0; j < D; j++) {
          g[i] *= i == j ? dw[j][k[j]] : w[j][k[j]];
          h[i][j] = 1;
          for (int l = 0; l < D; l++)
            h[i][j] *= l == i && l == j ? ddw[l][k[l]] : l == i || l == j ? dw[l][k[l]] : w[l][k[l]];
        }
      }
      const int slot = t.table[block_index(t.geometry, scene, block)];
      if (slot >= 0) visit(int64_t(slot) * kBlockNodes<D> + node_in_block<D>(node), N, r, g, h);
    }
  }
};

// f(particle, scene) for the particles of each home, homes of one colour in parallel.
template <class T, int D, class F>
void for_particles(const Topology<T, D>& t, const F& f) {
  const ScheduleIn s = schedule_of(t);
  PhaseCounter<kColours<D>> colours{s.colour_start};
  parallel_items(s.colour_start[kColours<D>], 4, [&](const auto& next) {
    int colour = 0;
    for (int64_t h; (h = next()) >= 0;) {
      while (h >= s.colour_start[colour + 1]) colour++;
      colours.wait_before(colour);
      const int slot = s.home_slot[h];
      int block[D];
      const int scene = block_coordinates(t.geometry, t.block[slot], block);
      for (int i = t.offsets[slot]; i < t.offsets[slot + 1]; i++) f(int64_t(t.index[i]), scene);
      colours.finish(colour);
    }
  });
}

template <class T, int D, class F>
void for_outside(const Topology<T, D>& t, const F& f) {
  for (int64_t i = t.offsets[t.capacity]; i < t.particles; i++) f(int64_t(t.index[i]));
}

template <class T, int D>
ParticleMomentum<T, D> load(const P2GArguments<T, D>& a, int64_t p, int scene) {
  ParticleMomentum<T, D> q;
  q.mass = at(a.mass, p);
  q.affine = q.stress = zero_matrix<T, D>();
  q.volume = a.stress.pointer ? at(a.volume, p) : T(0);
  q.dt = T(a.dt) * (a.scene_dt.pointer ? at(a.scene_dt, scene) : T(1));
  for (int i = 0; i < D; i++) {
    q.velocity[i] = at(a.velocity, p, i);
    for (int j = 0; j < D; j++) {
      if (a.affine.pointer) q.affine[i][j] = at(a.affine, p, i, j);
      if (a.stress.pointer) q.stress[i][j] = at(a.stress, p, i, j);
    }
  }
  return q;
}

template <int Order, class T, int D>
NodeMomentum<T, D> node_form(const P2GArguments<T, D>& a, const ParticleMomentum<T, D>& q) {
  const Geometry<T, D>& g = a.topology.geometry;
  return to_nodes<Order>(q, a.form, a.affine.pointer, a.stress.pointer, g.dx, g.inverse_dx);
}

template <class T, int D>
void store(const P2GBackwardArguments<T, D>& a, int64_t p, const ParticleMomentum<T, D>& g, const Vector<T, D>& x) {
  if (a.mass.pointer) at(a.mass, p) = g.mass;
  if (a.volume.pointer) at(a.volume, p) = g.volume;
  if (a.dt.pointer) at(a.dt, p) = g.dt;
  for (int i = 0; i < D; i++) {
    if (a.x.pointer) at(a.x, p, i) = x[i];
    if (a.velocity.pointer) at(a.velocity, p, i) = g.velocity[i];
    for (int j = 0; j < D; j++) {
      if (a.affine.pointer) at(a.affine, p, i, j) = g.affine[i][j];
      if (a.stress.pointer) at(a.stress, p, i, j) = g.stress[i][j];
    }
  }
}

template <int Order, class T, int D>
void p2g_backward(const P2GBackwardArguments<T, D>& a) {
  const P2GArguments<T, D>& in = a.forward;
  const Geometry<T, D>& geometry = in.topology.geometry;
  const ParticleMomentum<T, D> zero = {0, zero_vector<T, D>(), zero_matrix<T, D>(), zero_matrix<T, D>(), 0, 0};
  for_particles(in.topology, [&](int64_t p, int scene) {
    Support<Order, T, D> s;
    if (!s.locate(in.topology, in.x, p)) return store(a, p, zero, zero_vector<T, D>());
    const ParticleMomentum<T, D> q = load(in, p, scene);
    const NodeMomentum<T, D> n = node_form<Order>(in, q);
    NodeMomentum<T, D> sum = {0, zero_vector<T, D>(), zero_matrix<T, D>(), zero_matrix<T, D>()};
    Vector<T, D> x = zero_vector<T, D>();
    s.for_nodes(in.topology, scene, [&](int64_t row, T N, const auto& r, const auto& g, const auto& h) {
      const T* node = a.grad_nodes.pointer + row * a.grad_nodes.stride;
      Vector<T, D> m;
      for (int i = 0; i < D; i++) m[i] = node[1 + i];
      sum.mass += N * node[0];
      sum.momentum = sum.momentum + N * m;
      for (int i = 0; i < D; i++)
        for (int j = 0; j < D; j++) {
          sum.moment[i][j] += N * m[i] * r[j];
          sum.gradient[i][j] += m[i] * g[j];
        }
      const T value = n.mass * node[0] + dot(m, n.momentum + n.moment * r);
      x = x + value * g + (T(-1) * N) * (transpose(n.moment) * m) + h * (transpose(n.gradient) * m);
    });
    store(a, p, adjoint<Order>(q, sum, in.form, in.affine.pointer, in.stress.pointer, geometry.dx, geometry.inverse_dx),
          geometry.inverse_dx * x);
  });
  for_outside(in.topology, [&](int64_t p) { store(a, p, zero, zero_vector<T, D>()); });
}

template <int Order, class T, int D>
void gather(const GatherArguments<T, D>& a) {
  const T inverse_dx = a.topology.geometry.inverse_dx, scale = T(a.moment_scale * double(a.topology.geometry.dx));
  const auto zero = [&](int64_t p) {
    for (int c = 0; c < a.nodes.channels; c++) {
      if (a.value.pointer) at(a.value, p, c) = 0;
      for (int i = 0; i < D; i++) {
        if (a.moment.pointer) at(a.moment, p, c, i) = 0;
        if (a.gradient.pointer) at(a.gradient, p, c, i) = 0;
      }
    }
  };
  for_particles(a.topology, [&](int64_t p, int scene) {
    Support<Order, T, D> s;
    zero(p);
    if (!s.locate(a.topology, a.x, p)) return;
    s.for_nodes(a.topology, scene, [&](int64_t row, T N, const auto& r, const auto& g, const auto&) {
      const T* node = a.nodes.pointer + row * a.nodes.stride;
      for (int c = 0; c < a.nodes.channels; c++) {
        if (a.value.pointer) at(a.value, p, c) += N * node[c];
        for (int i = 0; i < D; i++) {
          if (a.moment.pointer) at(a.moment, p, c, i) += scale * N * r[i] * node[c];
          if (a.gradient.pointer) at(a.gradient, p, c, i) += inverse_dx * g[i] * node[c];
        }
      }
    });
  });
  for_outside(a.topology, zero);
}

template <int Order, class T, int D>
void position_gradient(const PositionGradientArguments<T, D>& a) {
  const T inverse_dx = a.topology.geometry.inverse_dx, scale = T(a.moment_scale * double(a.topology.geometry.dx));
  const auto store = [&](int64_t p, const Vector<T, D>& x) {
    for (int i = 0; i < D; i++) at(a.position_gradient, p, i) = x[i];
  };
  for_particles(a.topology, [&](int64_t p, int scene) {
    Support<Order, T, D> s;
    Vector<T, D> x = zero_vector<T, D>();
    if (!s.locate(a.topology, a.x, p)) return store(p, x);
    s.for_nodes(a.topology, scene, [&](int64_t row, T N, const auto& r, const auto& g, const auto& h) {
      const T* node = a.nodes.pointer + row * a.nodes.stride;
      for (int c = 0; c < a.nodes.channels; c++) {
        T v = at(a.value, p, c);
        Vector<T, D> moment = zero_vector<T, D>(), gradient = zero_vector<T, D>();
        for (int i = 0; i < D; i++) {
          if (a.moment.pointer) moment[i] = scale * at(a.moment, p, c, i);
          if (a.gradient.pointer) gradient[i] = inverse_dx * at(a.gradient, p, c, i);
        }
        v += dot(moment, r);
        x = x + (node[c] * v) * g + (-node[c] * N) * moment + node[c] * (h * gradient);
      }
    });
    store(p, inverse_dx * x);
  });
  for_outside(a.topology, [&](int64_t p) { store(p, zero_vector<T, D>()); });
}

MPM_CPU_INSTANTIATE(p2g_backward, P2GBackwardArguments)
MPM_CPU_INSTANTIATE(gather, GatherArguments)
MPM_CPU_INSTANTIATE(position_gradient, PositionGradientArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
