#include "heat/patches.h"
#include "heat/solve.h"
#include "heat/sum_particles.cpu.h"
#include "heat/workspace.cpu.h"

// The solve of heat, and the products with H by themselves.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

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
    parallel_ranges(near_blocks(a), kGrain, [&](int64_t begin, int64_t end) {
      for (int64_t slot = begin; slot < end; slot++)
        if (const int scene = scene_of(slot); wanted(scene)) f(slot, scene, slot * kBlockNodes<D>);
    });
  }
  bool running(int scene) const { return scene >= 0 && takes(scene) && w.scene[scene].running; }

  // Whether the scene is solved here, and not by heat_simple_step().
  bool takes(int scene) const { return !(a.leaves_simple && simple_steps(a, scene) > 0); }
  bool takes_any() const {
    bool any = false;
    for (int scene = 0; scene < a.topology.scenes && !any; scene++) any = takes(scene);
    return any;
  }

  // θ of the nodes, in the vector p where the solve reads their sums.
  template <class Wanted>
  const T* node_theta(const Wanted& wanted) const {
    if (!a.sums) return a.theta;
    for_slots(wanted, [&](int64_t, int, int64_t first) {
      for (int64_t i = first; i < first + kBlockNodes<D>; i++) w.v.p[i] = theta_at(a, i);
    });
    return w.v.p;
  }

  void start() const {
    const int64_t nodes = near_blocks(a) * int64_t(kBlockNodes<D>);
    parallel_ranges(nodes, 65536, [&](int64_t begin, int64_t end) {
      T* const vectors[] = {w.v.product, w.v.inverse, w.v.weight};
      for (T* vector : vectors) __builtin_memset(vector + begin, 0, (end - begin) * sizeof(T));
    });
    const auto all = [&](int scene) { return takes(scene); };
    const auto nothing = [](int, double) {};
    if (has_theta(a)) sum_to<HeatSum::product>(node_theta(all), w.v.product, all, nothing);
    if (a.method == HeatMethod::chebyshev)
      sum_to<HeatSum::bound>(nullptr, w.v.weight, all, nothing);
    else
      sum_to<HeatSum::diagonal>(nullptr, w.v.inverse, all, nothing);
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

  // f(scene, sum over its slots); the order of the sums does not depend on threads.
  template <class Wanted, class Kept, class Sum, class F>
  void for_scenes(const Wanted& wanted, const Kept* kept, const Sum& zero, const F& f) const {
    static_assert(sizeof(Sum) <= sizeof(StartSums<double>));
    Sum* const sums = static_cast<Sum*>(w.sums);
    for (int scene = 0; scene < a.topology.scenes; scene++) sums[scene] = zero;
    for (int64_t slot = 0; slot < near_blocks(a); slot++)
      if (const int scene = scene_of(slot); scene >= 0 && wanted(scene)) sums[scene].add(kept[slot]);
    for (int scene = 0; scene < a.topology.scenes; scene++)
      if (wanted(scene)) f(scene, sums[scene]);
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
    for_slots([&](int scene) { return scene >= 0 && takes(scene); },
              [&](int64_t, int scene, int64_t first) {
                const T shift = T(energy_shift(w.scene[scene]));
                for (int64_t i = first; i < first + kBlockNodes<D>; i++)
                  if (w.v.mass[i] != T(0)) a.increment[i] += shift;
              });
    for (int scene = 0; scene < a.topology.scenes; scene++)
      if (takes(scene)) report_scene(a, scene, w.scene[scene]);
  }
};

template <int Order, class T, int D>
void heat_cg(const HeatArguments<T, D>& a) {
  const HeatSolver<Order, T, D> solver(a);
  if (!solver.takes_any()) return;
  solver.start();
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
