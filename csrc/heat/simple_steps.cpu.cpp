#include "heat/blocks.cpu.h"
#include "heat/local.h"
#include "heat/sum_particles.cpu.h"
#include "heat/workspace.cpu.h"

// The simple steps of heat (csrc/heat/solve.h): their products, and the increments of all nodes. Nodes are computed in
// packs where nothing but a source acts on them. Slots without particles in their support are skipped: around small
// bodies they are the most.
namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

template <class T, int D>
class SimpleNodes {
 public:
  static constexpr int N = kCells;
  using P = Cells<T>;
  static_assert(kBlockNodes<D> % N == 0);

  explicit SimpleNodes(const HeatSimpleArguments<T, D>& a)
      : a_(a), w_(lay_out_heat(a.solve, static_cast<char*>(a.solve.workspace))) {
    for (int l = 0; l < N; l++) row_[l] = l * kHeatChannels;
  }

  T* directions() const { return w_.v.p; }
  bool plain() const { return !a_.solve.exchange && !a_.solve.fixed; }
  bool has_matter(int64_t slot) const { return !a_.solve.matter || a_.solve.matter[slot]; }

  // Sets the directions u of the step in a slot with matter, of a scene that takes the step.
  void direct(int scene, int64_t slot) const {
    const int64_t first = slot * kBlockNodes<D>, end = first + kBlockNodes<D>;
    const int steps = simple_steps(a_.solve, scene);
    const double c = bound_of_scene(a_.solve, scene), dt = step_of_scene(a_.solve, scene);
    T* const u = directions();
    if (!plain())
      for (int64_t i = first; i < end; i++) u[i] = simple_direction(a_, i, steps, c, dt);
    else
      for (int64_t i = first; i < end; i += N)
        if (a_.step == 0) {
          theta(i).store(u + i);
        } else {
          const SimpleNode<P> n = node(i, steps, a_.step - 1, c, dt);
          (n.residual / n.weight).store(u + i);
        }
    clear(a_.product[a_.step] + first);
  }

  // The increments of some nodes.
  P increment(int scene, int64_t i) const {
    const int steps = simple_steps(a_.solve, scene);
    return node(i, steps, steps, bound_of_scene(a_.solve, scene), step_of_scene(a_.solve, scene)).increment;
  }

  P sums(int64_t i, int channel) const { return take(a_.solve.sums + i * kHeatChannels + channel, row_); }

 private:
  static void clear(T* nodes) { __builtin_memset(nodes, 0, kBlockNodes<D> * sizeof(T)); }

  P capacity(int64_t i) const { return a_.solve.sums ? sums(i, kHeatCapacity) : P::load(a_.solve.heat_capacity + i); }
  P theta(int64_t i) const {
    return a_.solve.theta ? P::load(a_.solve.theta + i) : mean_of(sums(i, kHeatTheta), capacity(i));
  }

  // As simple_node() without exchange and held nodes.
  SimpleNode<P> node(int64_t i, int steps, int k, double c, double dt) const {
    const auto product = [&](int j) { return P::load(a_.product[j] + i); };
    const P mass = capacity(i), source = a_.solve.source ? P::load(a_.solve.source + i) : P(0);
    const auto empty = mass <= P(0);
    SimpleNode<P> n{select(empty, P(0), source - product(0)), P(0), select(empty, P(1), mass / P(dt))};
    take_simple_steps<T>(n, steps, k, c, [&](int j) { return select(empty, P(0), product(j)); });
    return n;
  }

  const HeatSimpleArguments<T, D>& a_;
  const HeatWorkspace<T> w_;
  int row_[N];
};

// visit(scene, slot) for the slots with a block of the scenes.
template <class T, int D, class F>
void for_near_slots(const HeatArguments<T, D>& a, const F& visit) {
  constexpr int64_t grain = 4096 / kBlockNodes<D>;  // slots below which a range is not split
  const Topology<T, D>& t = a.topology;
  parallel_ranges(near_blocks(a), grain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      const int block = t.block[slot], scene = block / t.geometry.blocks_per_scene;
      if (block >= 0 && scene < t.scenes) visit(scene, slot);
    }
  });
}

// Writes the increments of the nodes of a slot, and the averages θ̄, to the sums that the solve has read.
template <class T, int D>
void finish_slot(const HeatFinishArguments<T, D>& a, const SimpleNodes<T, D>& nodes, int scene, int64_t slot) {
  using P = typename SimpleNodes<T, D>::P;
  constexpr int N = SimpleNodes<T, D>::N;
  P difference(0);  // NaN in lanes with an increment that is not finite
  for (int64_t i = slot * kBlockNodes<D>; i < (slot + 1) * kBlockNodes<D>; i += N) {
    const P increment = nodes.increment(scene, i),
            mean = mean_of(nodes.sums(i, kHeatMean), nodes.sums(i, kHeatVarying));
    difference += increment - increment;
    for (int l = 0; l < N; l++) {
      a.sums[(i + l) * kHeatChannels + kHeatTheta] = increment[l];
      a.sums[(i + l) * kHeatChannels + kHeatMean] = mean[l];
    }
  }
  if (!all(difference == P(0)) || step_of_scene(a.simple.solve, scene) < 0)
    report_unsolved(a.status + scene * kHeatStatusSize);
}

// Marks slots of the support of base blocks.
template <class T, int D>
class Marks {
 public:
  explicit Marks(const HeatSlotsArguments<T, D>& a) : a_(a), schedule_(schedule_of(a.topology)) {}

  int base_blocks() const { return schedule_.colour_start[kColours<D>]; }

  void mark_support(int64_t b) const {
    const BaseBlock<T, D> block(a_.topology, schedule_.base_slot[b]);
    bool leaves = false;  // whether a particle has left the block
    int beyond = 0;       // axes along which the support of a particle exceeds the block, as the bits of a colour
    for (int64_t c = schedule_.base_chunk[b]; c < schedule_.base_chunk[b + 1]; c++) {
      const Chunk chunk(a_.topology, schedule_, c);
      leaves |= chunk.cell_end[kBlockNodes<D> - 1] < chunk.count;
      for (int cell = 0, before = 0; cell < kBlockNodes<D> && beyond + 1 < kColours<D>; before = chunk.cell_end[cell++])
        for (int i = 0; i < D && chunk.cell_end[cell] > before; i++)
          beyond |= int(cell_coordinate<D>(cell, i) + a_.order >= kBlockWidth) << (D - 1 - i);
    }
    if (leaves) return mark_around(block);
    for (int o = 0; o < kColours<D>; o++)
      if ((o & ~beyond) == 0) mark(block.slot[o]);
  }

 private:
  // Particles that have left the block are up to one cell outside of it.
  void mark_around(const BaseBlock<T, D>& block) const {
    constexpr int kAround = D == 3 ? 27 : 9;
    const Geometry<T, D>& g = a_.topology.geometry;
    for (int n = 0; n < kAround; n++) {
      int other[D];
      bool inside = true;
      for (int i = 0, digits = n; i < D; i++, digits /= 3) {
        other[i] = block.corner[i] / kBlockWidth + digits % 3 - 1;
        inside = inside && other[i] >= 0 && other[i] < g.blocks[i];
      }
      if (inside) mark(a_.topology.table[block_index(g, block.scene, other)]);
    }
  }
  void mark(int slot) const {
    if (slot >= 0) __atomic_store_n(a_.matter + slot, true, __ATOMIC_RELAXED);
  }

  const HeatSlotsArguments<T, D>& a_;
  const ScheduleIn schedule_;
};

}  // namespace

template <class T, int D>
void heat_find_slots(const HeatSlotsArguments<T, D>& a) {
  constexpr int64_t grain = 64;  // slots or base blocks below which a range is not split
  constexpr int64_t size = kBlockNodes<D> * kHeatChannels;
  parallel_ranges(a.slots, grain, [&](int64_t begin, int64_t end) {
    for (int64_t slot = begin; slot < end; slot++) {
      if (a.matter[slot]) __builtin_memset(a.sums + slot * size, 0, size * sizeof(T));
      a.matter[slot] = false;
    }
  });
  const Marks<T, D> marks(a);
  parallel_ranges(marks.base_blocks(), grain, [&](int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; b++) marks.mark_support(b);
  });
}

template <int Order, class T, int D>
void heat_simple_step(const HeatSimpleArguments<T, D>& a) {
  const HeatArguments<T, D>& solve = a.solve;
  const SimpleNodes<T, D> nodes(a);
  const auto takes = [&](int scene) { return simple_steps(solve, scene) > a.step; };
  bool any = false;
  for (int scene = 0; scene < solve.topology.scenes && !any; scene++) any = takes(scene);
  if (!any) return;
  for_near_slots(solve, [&](int scene, int64_t slot) {
    if (takes(scene) && nodes.has_matter(slot)) nodes.direct(scene, slot);
  });
  sum_particles<HeatSum::product, Order>(solve.topology, solve.x, solve.conductance, nodes.directions(),
                                         a.product[a.step], takes, [](int, double) {});
}

template <class T, int D>
void heat_finish(const HeatFinishArguments<T, D>& a) {
  const HeatArguments<T, D>& solve = a.simple.solve;
  const SimpleNodes<T, D> nodes(a.simple);
  const bool packs = nodes.plain() && solve.sums && a.sums && !a.increment;
  for_near_slots(solve, [&](int scene, int64_t slot) {
    if (!nodes.has_matter(slot) && !a.increment) return;
    if (packs && simple_steps(solve, scene) > 0) return finish_slot(a, nodes, scene, slot);
    for (int64_t i = slot * kBlockNodes<D>; i < (slot + 1) * kBlockNodes<D>; i++) finish_node(a, scene, i);
  });
  for (int scene = 0; scene < solve.topology.scenes; scene++)
    if (simple_steps(solve, scene) == 0) count_solve(count_of(a), scene);
}

MPM_INSTANTIATE(heat_find_slots, HeatSlotsArguments)
MPM_INSTANTIATE_ORDERS(heat_simple_step, HeatSimpleArguments)
MPM_INSTANTIATE(heat_finish, HeatFinishArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
