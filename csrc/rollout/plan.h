#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>

// The choice of the schedule of a call of many substeps: facts of the call, a table of schedules with conditions of
// support and of profit, and all thresholds. Host code without tensors, so a build without CUDA plans for CUDA too.
namespace mpm {

// INT(name) and BOOL(name) in the order of the op `plan_substeps`.
#define MPM_PLAN_FACTS(INT, BOOL)                                                            \
  BOOL(cuda) /* the particles are on a CUDA device */                                        \
  BOOL(float32)                                                                              \
  INT(dim)                                                                                   \
  INT(particles)                                                                             \
  INT(scenes)                                                                                \
  INT(steps)            /* that are left of the rollout, or those of the call */             \
  INT(blocks_per_scene) /* of the domain */                                                  \
  INT(max_blocks)       /* of the pool now; negative where no activation has measured it */  \
  BOOL(grows)           /* the pool follows the scene */                                     \
  BOOL(deterministic)                                                                        \
  BOOL(quadratic) /* weights, else cubic */                                                  \
  BOOL(apic)                                                                                 \
  BOOL(flips)     /* a share of FLIP velocities is kept */                                   \
  BOOL(mls)       /* the stress form, else that of the gradients of the weights */           \
  BOOL(mirrors)   /* among the walls */                                                      \
  BOOL(impulses)  /* on obstacles and walls are summed up */                                 \
  BOOL(clocks)    /* each scene has its own time step and time */                            \
  BOOL(scene_ids) /* particles have the number of a scene */                                 \
  BOOL(sorted)    /* particles have ids: their owner sorts them */                           \
  INT(laws)                                                                                  \
  BOOL(materials)          /* particles have the number of a material */                     \
  BOOL(additive)           /* the first law is one that is added to others */                \
  BOOL(uniform_parameters) /* each parameter of the laws has one value */                    \
  BOOL(one_deformation)    /* either F or J moves, not both */                               \
  BOOL(gradients)          /* are wanted */                                                  \
  BOOL(records)            /* what gradients need is stored */                               \
  BOOL(captured)           /* the stream is captured into a CUDA graph */                    \
  BOOL(graph_loops)        /* the device runs CUDA graphs with loops: CUDA 13, and no MPS */ \
  INT(path_bytes)          /* of the table of obstacles on paths, of one substep */          \
  INT(obstacles)                                                                             \
  BOOL(heat)   /* is conducted */                                                            \
  BOOL(rests)  /* the material does not move */                                              \
  BOOL(bodies) /* free ones that the material pushes */

struct PlanFacts {
#define MPM_INT(name) int64_t name = 0;
#define MPM_BOOL(name) bool name = false;
  MPM_PLAN_FACTS(MPM_INT, MPM_BOOL)
#undef MPM_INT
#undef MPM_BOOL

  int64_t blocks() const { return std::max<int64_t>(scenes, 1) * blocks_per_scene; }
};

// ---- thresholds

constexpr int64_t kMostSteps = 1 << 16;  // of one call

// Block per scene. Larger scenes on average, or larger domains, are computed by kernels over the whole grid.
template <int D>
constexpr int kMostSceneParticles = D == 2 ? 4096 : 2304;
constexpr int kMostSceneBlocks = 4096;
constexpr int64_t kLeastSceneSteps = 4;

// Fused G2P2G. Fewer particles are faster with separate kernels: the launches without work cost more than half of the
// bytes.
constexpr int64_t kLeastFusedSteps = 4, kLeastFusedParticles = 1 << 18;
// Particles whose F or J is updated by P2G, without G2P2G. More particles exceed the caches and lose their order, and
// then G2P can pass over them in the order of memory, but P2G cannot.
constexpr int64_t kMostLateParticles = 1 << 18;

// Particles whose P2G runs beside the solve of heat of the substep before, which leaves multiprocessors idle. Of more
// particles each kernel fills the device, and the second launch of P2G costs more.
constexpr int64_t kMostParticlesAhead = 1 << 17;

// Particles whose exchange with a held surface and sums for the free surface are one launch. All of its thread blocks
// have the registers of the second, 124 in place of 79, so of more particles it takes longer than two.
constexpr int64_t kMostParticlesAtOnce = 1 << 17;

// Persistent. For a deterministic grid, or a pool of fixed size, half as many particles.
constexpr int64_t kLeastPersistentSteps = 10, kMostPersistentParticles = 1 << 15, kMostPersistentBlocks = 256;
// Largest number of particles of an item, with a thread each. It grows with the number of particles, so that one wave
// of thread blocks suffices for all items.
template <int D>
constexpr int persistent_item(int64_t particles) {
  return D == 2 ? 192 : particles <= 11000 ? 128 : particles <= 20000 ? 256 : 384;
}
// Blocks of a domain, and items of a step, for which about one wave of thread blocks suffices.
constexpr int64_t kFewBlocks = 1 << 12;
template <int D>
constexpr int kFewItems = D == 2 ? 250 : 140;

// Steps of a call on CUDA whose pool follows the scene. The pool cannot grow within a call.
constexpr int64_t kGrowingSteps = 64;
// kParticlesPerBlock particles need as much memory as the nodes of a block. A larger pool allows longer calls:
// kRoomySteps with kRoomy times the blocks of a pool that follows the scene, twice as many steps with twice that size,
// and kWholeSteps with all blocks of the domain.
constexpr int64_t kParticlesPerBlock = 32, kRoomy = 3, kRoomySteps = 256, kWholeSteps = 1024;
// Blocks of a small domain, over all of whose nodes a kernel with heat passes in no more time than over a few. A call
// with heat costs 1.5 ms, as much as 20 steps.
constexpr int64_t kSmallDomain = 1 << 10;
// Particles times steps of a call on CUDA that may be one kernel, which cannot be interrupted: about a quarter of a
// second on an H100. Shorter calls cost more per step, and fewer particles take no less time.
constexpr int64_t kWorkOfCall = 1 << 28, kLeastStepsOfCall = 512, kLeastParticlesOfCall = 1 << 13;
constexpr int64_t kMostPathBytes = 1 << 26;  // of a call, for obstacles on paths

// Smallest call for which sorting unsorted particles, and restoring their order, pays: both cost about four steps, and
// a step of unsorted particles takes up to five times as long on a GPU.
constexpr int64_t kLeastSortedSteps = 64, kLeastSortedParticles = 1 << 15;

// The same for particles with heat in any order, which they lose while the steps of a long call move them
// (`STEPS_WITH_HEAT` in torch_mpm/rollouts/sorting.py): on an H200 a step of 8M particles takes a fifth longer after 80
// of them, and sorting as long as two.
constexpr int64_t kLeastHeatedSteps = 128, kLeastHeatedParticles = 1 << 18;

// The same for heat of a body at rest, whose particles keep their order; on CUDA that many particles. There a step of a
// million in any order takes 670 us, in order 220, and sorting 450 (H200).
constexpr int64_t kLeastRestingSteps = 8, kLeastRestingParticles = 1 << 18;

// Whether a block per scene is faster than kernels of whole grids, by times measured on an H200 [µs].
template <int D>
bool block_per_scene_pays(int64_t particles, int64_t scenes) {
  if (scenes == 1)
    return particles <= 96;  // otherwise a kernel with many thread blocks (rollout/schedules/persistent.h)
  const double turns = std::fmax(1, double(scenes) / 132), size = double(particles) / double(scenes);
  const double per_scene = 8 + turns * (2.5 + (D == 2 ? 0.019 : 0.021) * size);
  const double together = 14 + double(particles) / 3500 + 0.07 * double(scenes);
  return per_scene < together;
}

// Estimated number of items of a step with a pool of `blocks` (rollout/schedules/persistent.h).
inline double items_of_step(const PlanFacts& f, int64_t blocks) {
  const double active = double(blocks) / 1.5;  // active blocks of a pool that has grown
  if (f.dim == 2)
    return std::max(0.8 * active, double(f.particles) / 150);  // most blocks have particles, few have two items
  return 0.5 * active + double(f.particles) / (1.25 * persistent_item<3>(f.particles));
}

// ---- schedules

enum Schedule : int64_t {
  kChoose = -1,
  kPerStep,        // kernel by kernel
  kFusedG2P2G,     // G2P and the next P2G in one kernel; the call owns the particles (CUDA)
  kPersistent,     // one kernel, whose thread blocks all run at once (CUDA)
  kBlockPerScene,  // a thread block computes all substeps of a scene (CUDA)
  kSortedCpu       // particles sorted by cell; G2P and the next P2G in one pass (CPU)
};

// Each function returns the reason against the schedule, or an empty text.
struct ScheduleEntry {
  Schedule schedule;
  const char* name;
  std::string (*unsupported)(const PlanFacts&);
  std::string (*unprofitable)(const PlanFacts&);  // for a supported call
};

// Whether sums of nodes are independent of the order of their terms, in deterministic mode on CUDA. Only without
// gradients: the backward pass recomputes its steps one by one. With heat, sums keep their order,
// as the solver adds in it.
inline bool sums_are_fixed(const PlanFacts& f) {
  return f.cuda && f.float32 && f.deterministic && !f.gradients && !f.impulses && !f.clocks && !f.mirrors && !f.heat;
}

// Reason why no kernel combines the law and P2G.
inline std::string why_not_fused_law(const PlanFacts& f) {
  if (!f.cuda) return "the particles are on the CPU";
  if (!f.float32) return "the particles are in float64";
  if (f.laws != 1 || f.materials) return "there is more than one law";
  if (f.additive) return "the law is one that is added to others";
  if (!f.quadratic) return "the weights are cubic";
  if (!f.mls) return "the stress form is not mls";
  return {};
}

// Reason why kernels of several phases do not support a call.
inline std::string why_not_many_phases(const PlanFacts& f) {
  if (std::string reason = why_not_fused_law(f); !reason.empty()) return reason;
  if (f.flips) return "FLIP needs the velocities before the forces";
  if (!f.apic) return "the transfer is not APIC";
  if (f.mirrors) return "mirrors read nodes of other blocks";
  if (f.impulses) return "impulses are accumulated";
  if (f.heat) return "heat is conducted";
  if (f.bodies) return "bodies move with the material";
  return {};
}

// Reason why P2G cannot update F or J in place of the previous G2P.
inline std::string why_not_late(const PlanFacts& f) {
  if (std::string reason = why_not_many_phases(f); !reason.empty()) return reason;
  if (f.gradients) return "gradients are wanted";
  if (f.deterministic && !sums_are_fixed(f)) return "deterministic sums have an order where scenes have their own dt";
  if (!f.one_deformation) return "both F and J move";
  return {};
}

inline std::string count(int64_t value, const char* what) { return std::to_string(value) + " " + what; }

inline std::string nothing(const PlanFacts&) { return {}; }

namespace block_per_scene {
inline std::string unsupported(const PlanFacts& f) {
  if (std::string reason = why_not_fused_law(f); !reason.empty()) return reason;
  if (f.flips) return "FLIP needs the velocities before the forces";
  if (f.mirrors) return "mirrors read nodes of other blocks";
  if (f.impulses) return "impulses are accumulated";
  if (f.heat) return "heat is conducted";
  if (f.bodies) return "bodies move with the material";
  if (f.gradients) return "gradients are wanted";
  if (f.particles == 0) return "there are no particles";
  if (f.steps < kLeastSceneSteps) return "a call has fewer than " + count(kLeastSceneSteps, "steps");
  const int64_t most = f.dim == 2 ? kMostSceneParticles<2> : kMostSceneParticles<3>;
  if (f.particles > most * f.scenes) return "scenes have more than " + count(most, "particles on average");
  if (f.blocks_per_scene > kMostSceneBlocks) return "a domain has more than " + count(kMostSceneBlocks, "blocks");
  return {};
}
inline std::string unprofitable(const PlanFacts& f) {
  if (f.deterministic && !sums_are_fixed(f)) return {};
  const bool pays =
      f.dim == 2 ? block_per_scene_pays<2>(f.particles, f.scenes) : block_per_scene_pays<3>(f.particles, f.scenes);
  return pays ? "" : "kernels of whole grids are faster for scenes of this number and size";
}
}  // namespace block_per_scene

namespace fused_g2p2g {
inline std::string unsupported(const PlanFacts& f) {
  if (std::string reason = why_not_late(f); !reason.empty()) return reason;
  if (f.scene_ids) return "particles have the number of a scene";
  if (!f.uniform_parameters) return "a parameter has more than one value";
  if (f.particles == 0) return "there are no particles";
  if (f.particles > INT32_MAX / 2) return "there are more than 2^30 particles";
  if (f.steps < kLeastFusedSteps) return "a call has fewer than " + count(kLeastFusedSteps, "steps");
  return {};
}
inline std::string unprofitable(const PlanFacts& f) {
  return f.particles < kLeastFusedParticles ? "there are fewer than " + count(kLeastFusedParticles, "particles") : "";
}
}  // namespace fused_g2p2g

namespace persistent {
inline std::string unsupported(const PlanFacts& f) {
  if (std::string reason = why_not_late(f); !reason.empty()) return reason;
  if (f.particles == 0) return "there are no particles";
  if (f.particles > kMostPersistentParticles)
    return "there are more than " + count(kMostPersistentParticles, "particles");
  if (f.steps < kLeastPersistentSteps) return "a call has fewer than " + count(kLeastPersistentSteps, "steps");
  if (f.captured) return "the stream is captured into a CUDA graph";
  if (!f.graph_loops) return "the device runs no CUDA graphs with loops";
  return {};
}
// It pays if one wave of thread blocks suffices for all items. Pools with this property are small, or grow and were
// given room for all blocks by `pool_for`. On deterministic grids the choice must not depend on the growth of another
// pool, or of this one.
inline std::string unprofitable(const PlanFacts& f) {
  if (f.grows && f.max_blocks < 0) return "the size of the pool is not known before the first activation";
  if (f.grows && f.max_blocks != f.blocks()) return "the pool has no room for all blocks of the domain";
  if (f.grows && f.deterministic && f.blocks() > kFewBlocks)
    return "the grid is deterministic, and a pool for all blocks of the domain may come from growth alone";
  if (!f.grows && f.max_blocks > kMostPersistentBlocks)
    return "the pool has more than " + count(kMostPersistentBlocks, "blocks");
  const int64_t most = kMostPersistentParticles / (f.grows && !f.deterministic ? 1 : 2);
  return f.particles > most ? "there are more than " + count(most, "particles") : "";
}
}  // namespace persistent

namespace sorted_cpu {
inline std::string unsupported(const PlanFacts& f) {
  if (f.cuda) return "the particles are on a CUDA device";
  return f.records ? "each step is recorded for its gradient" : "";
}
inline std::string unprofitable(const PlanFacts& f) { return f.steps < 2 ? "there is no step after the first" : ""; }
}  // namespace sorted_cpu

// The first one supports every call.
constexpr ScheduleEntry kSchedules[] = {
    {kPerStep, "per_step", nothing, nothing},
    {kFusedG2P2G, "fused_g2p2g", fused_g2p2g::unsupported, fused_g2p2g::unprofitable},
    {kPersistent, "persistent", persistent::unsupported, persistent::unprofitable},
    {kBlockPerScene, "block_per_scene", block_per_scene::unsupported, block_per_scene::unprofitable},
    {kSortedCpu, "sorted_cpu", sorted_cpu::unsupported, sorted_cpu::unprofitable},
};
constexpr Schedule kOrderOfChoice[] = {kBlockPerScene, kFusedG2P2G, kPersistent, kSortedCpu};

// The first profitable schedule for a call with the pool of `facts`.
inline Schedule choose_schedule(const PlanFacts& facts) {
  for (const Schedule s : kOrderOfChoice)
    if (kSchedules[s].unsupported(facts).empty() && kSchedules[s].unprofitable(facts).empty()) return s;
  return kPerStep;
}

// ---- pools

struct PlannedPool {
  int64_t blocks;  // least size of the pool, or -1: it follows the scene, or is fixed
  int64_t steps;   // largest number of steps of a call
};

// Whether the persistent schedule pays if the pool has all blocks of the domain.
inline bool takes_few_blocks(const PlanFacts& f) {
  if (f.blocks() > kFewBlocks || !why_not_many_phases(f).empty() || f.steps < kLeastPersistentSteps) return false;
  if (f.particles > kMostPersistentParticles) return false;
  if (f.deterministic || f.max_blocks < 0) return f.deterministic && f.particles <= kMostPersistentParticles / 2;
  return items_of_step(f, f.max_blocks) <= (f.dim == 2 ? kFewItems<2> : kFewItems<3>);
}

// The pool and the steps of a call. A pool with all blocks of the domain never has to grow: for few blocks with heat or
// with the persistent schedule, or if the particles need more memory. The size of a larger pool is checked less often,
// unless kernels pass over all of its blocks. On deterministic grids the choice is independent of the number of blocks
// so far, since a second run must equal the first bit by bit.
inline PlannedPool pool_for(const PlanFacts& f) {
  if (!f.cuda) return {-1, kMostSteps};
  if (!f.grows) {
    const int64_t most = kWorkOfCall / std::max(f.particles, kLeastParticlesOfCall);
    return {-1, std::clamp(most, kLeastStepsOfCall, kMostSteps)};
  }
  if (f.gradients) return {-1, kGrowingSteps};
  const int64_t room = f.particles >= kLeastFusedParticles ? f.particles / kParticlesPerBlock : 0;
  const bool is_small = f.heat && f.blocks() <= kSmallDomain;
  if (room >= f.blocks() || is_small || takes_few_blocks(f)) return {f.blocks(), kWholeSteps};
  const bool passes = f.deterministic || f.mirrors || f.flips || f.heat;
  const int64_t times = f.max_blocks < 0 || passes ? 0 : room / std::max<int64_t>(kRoomy * f.max_blocks, 1);
  if (times > 0) return {room, kRoomySteps * std::min<int64_t>(times, 2)};
  return {-1, kGrowingSteps};
}

// Order of the particles in the steps.
enum Order : int64_t {
  kAsGiven,
  kSortedBefore,  // sorted before the call, restored after it
  kSortedByCall   // sorted by the schedule
};

inline Order order_for(const PlanFacts& f) {
  const bool pays_at_rest = f.steps >= kLeastRestingSteps && (!f.cuda || f.particles >= kLeastRestingParticles);
  if (f.rests && pays_at_rest && !f.captured && !f.gradients && !f.sorted) return kSortedBefore;
  if (!f.cuda || f.captured) return kAsGiven;
  if (f.heat && !f.gradients && f.steps >= kLeastHeatedSteps && f.particles >= kLeastHeatedParticles)
    return kSortedBefore;
  if (f.sorted || f.steps < kLeastSortedSteps || f.particles < kLeastSortedParticles) return kAsGiven;
  const bool itself = f.particles >= kLeastFusedParticles && !f.scene_ids && !f.gradients;
  return itself && why_not_many_phases(f).empty() ? kSortedByCall : kSortedBefore;
}

}  // namespace mpm
