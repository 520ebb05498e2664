#include "cpu/parallel.h"
#include "cpu/transpose.h"
#include "heat/cell.h"
#include "heat/patches.h"
#include "heat/solve.h"
#include "heat/workspace.cpu.h"

// H applied in one pass: the particles of a cell read its nodes into registers as packs, and add to them there. Base
// blocks add their tiles colour by colour, so that every sum has the same order for any number of threads.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// One value at each node in the support of a base block; rows along the last axis.
template <int Order, class T, int D>
struct ScalarTile {
  static constexpr int kWidth = kBlockWidth + Order, kRow = 2 * kBlockWidth;
  static constexpr int kRows = D == 3 ? kWidth * kWidth : kWidth;
  static constexpr int S = Order + 1, kNodes = kSupportNodes<Order, D>;
  alignas(64) T value[kRows * kRow];

  void clear() { __builtin_memset(value, 0, sizeof(value)); }

  // visit(tile values, node row of the pool, nodes) for every run of nodes in an active block
  template <class F>
  MPM_HD void for_runs(const BaseBlock<T, D>& base_block, const F& visit) {
    for (int row = 0; row < kRows; row++) {
      const int i = D == 3 ? row / kWidth : 0, j = row % kWidth;
      const int o = (D == 3 ? i / kBlockWidth * 4 : 0) + j / kBlockWidth * 2;
      const int inside = (i % kBlockWidth * kBlockWidth + j % kBlockWidth) * kBlockWidth;
      const int low = base_block.slot[o], high = base_block.slot[o + 1];
      if (low >= 0) visit(value + row * kRow, int64_t(low) * kBlockNodes<D> + inside, kBlockWidth);
      if (high >= 0) visit(value + row * kRow + kBlockWidth, int64_t(high) * kBlockNodes<D> + inside, Order);
    }
  }
  void load_from(const T* nodes, const BaseBlock<T, D>& base_block) {
    clear();
    for_runs(base_block, [&](T* tile, int64_t row, int n) {
      for (int k = 0; k < n; k++) tile[k] = nodes[row + k];
    });
  }
  void add_to(T* nodes, const BaseBlock<T, D>& base_block) {
    for_runs(base_block, [&](const T* tile, int64_t row, int n) {
      for (int k = 0; k < n; k++) nodes[row + k] += tile[k];
    });
  }

  // The support of a cell, in the order of csrc/heat/cell.h.
  template <class F>
  MPM_HD void for_support(int cell, const F& visit) {
    int first = 0;
    MPM_UNROLL for (int a = 0; a < D; a++)
      first = a == D - 1 ? first * kRow + cell_coordinate<D>(cell, a) : first * kWidth + cell_coordinate<D>(cell, a);
    MPM_UNROLL for (int i = 0; i < (D == 3 ? S : 1); i++) MPM_UNROLL
      for (int j = 0; j < S; j++) MPM_UNROLL
        for (int k = 0; k < S; k++) visit((i * S + j) * S + k, value[first + (i * kWidth + j) * kRow + k]);
  }
};

// Sums over the lanes of packs, added to the support of a cell.
template <HeatSum Sum, int Order, class T, int D>
void add_support(Lanes<T>* packs, int cell, ScalarTile<Order, T, D>& tile) {
  constexpr int kNodes = kSupportNodes<Order, D>, kPadded = (kNodes + kLanes - 1) / kLanes * kLanes;
  alignas(64) T rows[kLanes][kPadded];
  store_transposed<kPadded>(packs, rows[0], kPadded);
  MPM_UNROLL for (int n = 0; n < kPadded; n++) {
    T sum = rows[0][n];
    for (int l = 1; l < kLanes; l++) sum += rows[l][n];
    rows[0][n] = sum;
  }
  if (Sum == HeatSum::product) to_nodes<Order, D>(rows[0]);
  tile.for_support(cell, [&](int n, T& value) { value += rows[0][n]; });
}

// The particles order[begin, end) of a chunk, which lie in one cell; returns Σ κ V |∇u|².
template <HeatSum Sum, int Order, class T, int D>
T sum_cell(const Topology<T, D>& t, const Field<const T>& x, const Field<const T>& conductance,
           const BaseBlock<T, D>& base_block, const Chunk& chunk, int cell, int begin, int end,
           ScalarTile<Order, T, D>& u, ScalarTile<Order, T, D>& sum, const int* e) {
  using P = Lanes<T>;
  constexpr int kNodes = kSupportNodes<Order, D>, kPadded = (kNodes + kLanes - 1) / kLanes * kLanes;
  static constexpr T kLane[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7};
  T from[kNodes];
  if (Sum == HeatSum::product) {
    u.for_support(cell, [&](int n, T& value) { from[n] = value; });
    to_differences<Order, D>(from);
  }
  P to[kPadded], power(0);
  for (int n = 0; n < kPadded; n++) to[n] = P(0);
  for (int i = begin; i < end; i += kLanes) {
    const Group g = group_by_cell(chunk, i, end);
    P f[D];
    MPM_UNROLL for (int a = 0; a < D; a++) {
      const T base = T(base_block.corner[a] + cell_coordinate<D>(cell, a));
      f[a] = distance_in_cells(t.geometry, a, load(x, g, a), P(base));
    }
    const auto real = P::load(kLane) < P(g.count);
    const P scaled = scaled_conductance<Order>(load(conductance, g), t.geometry.inverse_dx);
    power += add_particle<Sum, Order, P, D>(f, select(real, scaled, P(0)), from, to, e);
  }
  add_support<Sum, Order, T, D>(to, cell, sum);
  T total = power[0];
  for (int l = 1; l < kLanes; l++) total += power[l];
  return total;
}

// Adds a sum over the particles of every base block of an active scene to the nodes; finish(slot, Σ κ V |∇u|²) per base
// block.
template <HeatSum Sum, int Order, class T, int D, class Wanted, class Finish>
void sum_particles(const Topology<T, D>& t, const Field<const T>& x, const Field<const T>& conductance, const T* nodes,
                   T* out, const Wanted& wanted, const Finish& finish, const int* e = nullptr) {
  const ScheduleIn s = schedule_of(t);
  PhaseCounter<kColours<D>> colours{s.colour_start};
  parallel_base_blocks<D>(s, t.particles, [&](const auto& next) {
    ScalarTile<Order, T, D> u, sum;
    int colour = 0;
    for (int64_t b; (b = next()) >= 0;) {
      const int slot = s.base_slot[b];
      const BaseBlock<T, D> base_block(t, slot);
      while (b >= s.colour_start[colour + 1]) colour++;
      if (!wanted(base_block.scene)) {
        colours.finish(colour);
        continue;
      }
      if (Sum == HeatSum::product) u.load_from(nodes, base_block);
      sum.clear();
      double power = 0;
      for (int64_t c = s.base_chunk[b]; c < s.base_chunk[b + 1]; c++) {
        const Chunk chunk(t, s, c);
        for (int cell = 0, begin = 0; cell < kBlockNodes<D>; begin = chunk.cell_end[cell++])
          if (const int end = chunk.cell_end[cell]; begin < end)
            power += double(sum_cell<Sum, Order>(t, x, conductance, base_block, chunk, cell, begin, end, u, sum, e));
      }
      finish(slot, power);
      colours.wait_before(colour);
      sum.add_to(out, base_block);
      colours.finish(colour);
    }
  });
}

template <int Order, class T, int D>
struct HeatSolver {
  const HeatArguments<T, D>& a;
  const HeatWorkspace<T> w;
  static constexpr int64_t kGrain = 4096 / kBlockNodes<D>;  // slots below which a range is not split

  explicit HeatSolver(const HeatArguments<T, D>& a) : a(a), w(lay_out_heat(a, static_cast<char*>(a.workspace))) {}

  int scene_of(int64_t slot) const {
    const Topology<T, D>& t = a.topology;
    const int block = t.block[slot], scene = block / t.geometry.blocks_per_scene;
    return block < 0 || scene >= t.scenes ? -1 : scene;
  }
  template <HeatSum Sum, class Wanted, class Finish>
  void sum_to(const T* nodes, T* out, const Wanted& wanted, const Finish& finish) const {
    sum_particles<Sum, Order>(a.topology, a.x, a.conductance, nodes, out, wanted, finish);
  }
  // f(node) for the nodes of every slot of an active scene; the returned sums are stored by slot.
  template <class Wanted, class F>
  void for_slots(const Wanted& wanted, const F& f) const {
    parallel_ranges(a.topology.max_blocks, kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t slot = begin; slot < end; slot++)
        if (const int scene = scene_of(slot); wanted(scene)) f(slot, scene, slot * kBlockNodes<D>);
    });
  }
  bool running(int scene) const { return scene >= 0 && w.scene[scene].running; }

  void start() const {
    const int64_t nodes = a.topology.max_blocks * int64_t(kBlockNodes<D>);
    parallel_ranges(nodes, 65536, [&](int64_t begin, int64_t end) {
      T* const vectors[] = {w.v.product, w.v.inverse, w.v.weight};
      for (T* vector : vectors) __builtin_memset(vector + begin, 0, (end - begin) * sizeof(T));
    });
    const auto all = [](int) { return true; };
    const auto nothing = [](int, double) {};
    if (a.theta) sum_to<HeatSum::product>(a.theta, w.v.product, all, nothing);
    if (a.method == HeatMethod::chebyshev)
      sum_to<HeatSum::bound>(nullptr, w.v.weight, all, nothing);
    else
      sum_to<HeatSum::diagonal>(nullptr, w.v.inverse, [&](int scene) { return simple_steps(a, scene) == 0; }, nothing);
    for_slots(all, [&](int64_t slot, int scene, int64_t first) {
      auto sums = StartSums<T>::zero();
      const double dt = scene < 0 ? 1 : step_of_scene(a, scene);
      for (int64_t i = first; i < first + kBlockNodes<D>; i++) {
        sums.add(start_node(a, w.v, i, i, dt, scene >= 0));
        a.increment[i] = T(0);
      }
      w.start[slot] = sums;
    });
    for_scenes(all, w.start, StartSums<double>::zero(),
               [&](int scene, const StartSums<double>& sums) { w.scene[scene] = start_scene(a, scene, sums); });
  }

  // Solves the scenes for which a few steps without scalar products suffice.
  void solve_by_simple_steps() const {
    for (int k = 0; k < kMostSimpleSteps; k++) {
      const auto takes = [&](int scene) { return running(scene) && w.scene[scene].simple > k; };
      bool any = false;
      for (int scene = 0; scene < a.topology.scenes; scene++) any |= takes(scene);
      if (!any) break;
      take_simple_step(k, takes);
    }
    for (int scene = 0; scene < a.topology.scenes; scene++)
      if (running(scene) && w.scene[scene].simple > 0) finish_simple_steps(a, scene, w.scene[scene]);
  }

  // Step k, after the product for the residual that the step before has left.
  template <class Takes>
  void take_simple_step(int k, const Takes& takes) const {
    if (k > 0) sum_to<HeatSum::product>(w.v.p, w.v.product, takes, [](int, double) {});
    for_slots(takes, [&](int64_t, int scene, int64_t first) {
      const int steps = w.scene[scene].simple;
      const double c = bound_of_scene(a, scene);
      const T omega = T(simple_weight(steps, k, c)), before = k > 0 ? T(simple_weight(steps, k - 1, c)) : T(0);
      for (int64_t i = first; i < first + kBlockNodes<D>; i++) {
        w.v.r[i] = (T(1) - before) * w.v.r[i] - before * w.v.product[i];
        w.v.p[i] = w.v.inverse[i] * w.v.r[i];
        a.increment[i] += omega * w.v.p[i];
        w.v.product[i] = T(0);
      }
    });
  }

  // f(scene, sum over its slots); the order of the sums does not depend on threads.
  template <class Wanted, class Kept, class Sum, class F>
  void for_scenes(const Wanted& wanted, const Kept* kept, const Sum& zero, const F& f) const {
    int64_t slot = 0;
    for (int scene = 0; scene < a.topology.scenes; scene++) {
      Sum sum = zero;
      for (; slot < a.topology.max_blocks && scene_of(slot) <= scene && scene_of(slot) >= 0; slot++)
        if (wanted(scene)) sum.add(kept[slot]);
      if (wanted(scene)) f(scene, sum);
    }
  }

  bool iterate() const {
    const auto active = [&](int scene) { return running(scene); };
    bool any = false;
    for (int scene = 0; scene < a.topology.scenes; scene++) any = any || running(scene);
    if (!any) return false;
    for_slots(active, [&](int64_t slot, int scene, int64_t first) {
      const T beta = T(w.scene[scene].beta), gamma = T(w.scene[scene].gamma);
      T weighted = 0;
      for (int n = 0; n < kBlockNodes<D>; n++) weighted += direct_node(w.v, first + n, beta, gamma);
      w.curvature[slot] = {double(weighted)};
    });
    sum_to<HeatSum::product>(w.v.p, w.v.product, active,
                             [&](int slot, double power) { w.curvature[slot].value += power; });
    if (a.method == HeatMethod::conjugate_gradients)
      for_scenes(active, w.curvature, Curvature{0},
                 [&](int scene, const Curvature& sum) { set_step(w.scene[scene], sum.value); });
    for_slots(active, [&](int64_t slot, int scene, int64_t first) {
      auto sums = StepSums<T>::zero();
      const T alpha = T(w.scene[scene].alpha);
      for (int n = 0; n < kBlockNodes<D>; n++) sums.add(update_node(w.v, a.increment, first + n, alpha));
      w.step[slot] = sums;
    });
    for_scenes(active, w.step, StepSums<double>::zero(),
               [&](int scene, const StepSums<double>& sums) { finish_iteration(a, scene, w.scene[scene], sums); });
    return true;
  }

  void finish() const {
    for_slots([](int scene) { return scene >= 0; },
              [&](int64_t, int scene, int64_t first) {
                const T shift = T(energy_shift(w.scene[scene]));
                for (int64_t i = first; i < first + kBlockNodes<D>; i++)
                  if (w.v.mass[i] != T(0)) a.increment[i] += shift;
              });
    for (int scene = 0; scene < a.topology.scenes; scene++) report_scene(a, scene, w.scene[scene]);
  }
};

template <int Order, class T, int D>
void heat_cg(const HeatArguments<T, D>& a) {
  const HeatSolver<Order, T, D> solver(a);
  solver.start();
  solver.solve_by_simple_steps();
  while (solver.iterate()) {
  }
  solver.finish();
}

template <int Order, class T, int D>
void heat_operator(const HeatOperatorArguments<T, D>& a) {
  const auto all = [](int) { return true; };
  const auto nothing = [](int, double) {};
  if (a.nodes)
    sum_particles<HeatSum::product, Order>(a.topology, a.x, a.conductance, a.nodes, a.sum, all, nothing);
  else
    sum_particles<HeatSum::diagonal, Order>(a.topology, a.x, a.conductance, a.nodes, a.sum, all, nothing);
}

template <int Order, class T, int D>
void heat_stencil(const HeatOperatorArguments<T, D>& a) {
  const auto all = [](int) { return true; };
  const auto nothing = [](int, double) {};
  for (int pair = 0; pair < kPairs<D>; pair++) {
    int e[D];
    pair_offset<D>(pair, e);
    T* const sum = a.sum + pair * int64_t(a.topology.max_blocks) * kBlockNodes<D>;
    sum_particles<HeatSum::pair, Order>(a.topology, a.x, a.conductance, a.nodes, sum, all, nothing, e);
  }
}

template <class T, int D>
int64_t heat_workspace(const HeatArguments<T, D>& a) {
  return lay_out_heat(a, nullptr).size;
}

template <class T, int D>
int64_t heat_operator_workspace(const HeatOperatorArguments<T, D>&) {
  return 0;
}

template <class T, int D>
void heat_patches(const PatchArguments<T, D>& a) {
  constexpr int64_t grain = 1024;  // patches below which a range is not split
  parallel_ranges(a.count, grain, [&](int64_t begin, int64_t end) {
    for (int64_t o = begin; o < end; o++)
      for (int k = 0; k < kCorners<D>; k++) solve_corner(a, o, k);
  });
  parallel_ranges(a.count, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i++) sum_corners(a, i);
  });
}

MPM_INSTANTIATE_SIZE(heat_workspace, HeatArguments)
MPM_INSTANTIATE_ORDERS(heat_cg, HeatArguments)
MPM_INSTANTIATE_SIZE(heat_operator_workspace, HeatOperatorArguments)
MPM_INSTANTIATE_ORDERS(heat_operator, HeatOperatorArguments)
MPM_INSTANTIATE_ORDERS(heat_stencil, HeatOperatorArguments)
MPM_INSTANTIATE(heat_patches, PatchArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
