#pragma once

#include <map>
#include <string>

#include "laws/law.h"
#include "rollout/schedules/block_per_scene.h"
#include "rollout/schedules/fused_g2p2g.h"
#include "rollout/schedules/persistent.h"
#include "rollout/thermal_laws.h"

// Kernels that evaluate a law within a transfer, on CUDA, for quadratic weights and the MLS form. Each object file of
// rollout/fused_law.cu registers those of its laws when the library is loaded.
namespace mpm {

// For one scalar and dimension. Missing kernels are null.
template <class T, int D>
struct FusedLawKernels {
  // Update of F or J, law and P2G in one, the stress in registers.
  void (*p2g)(const LawUpdateArguments<T, D>&, const ThermalP2GArguments<T, D>&, const LateDeformation<T, D>&,
              const P2GArguments<T, D>&, const ReorderOnScatter<T, D>&, void* stream) = nullptr;
  bool reads_temperature = false;  // whether that P2G evaluates laws of temperature
  // G2P and the next P2G in one.
  void (*g2p2g)(const LawUpdateArguments<T, D>&, const G2P2GArguments<T, D>&, void* stream) = nullptr;
  // Substeps of few particles, with CUDA 13.
  void (*persistent)(const LawUpdateArguments<T, D>&, const PersistentArguments<T, D>&, void* stream) = nullptr;
  // All substeps of small scenes.
  void (*block_per_scene)(const LawUpdateArguments<T, D>&, const BlockPerSceneArguments<T, D>&, void* stream) = nullptr;
};

struct FusedLaw {
  FusedLawKernels<float, 2> in_2d;
  FusedLawKernels<float, 3> in_3d;
};

// By the name of the law.
inline std::map<std::string, FusedLaw>& fused_laws() {
  static std::map<std::string, FusedLaw> laws;
  return laws;
}

template <class T, int D>
FusedLawKernels<T, D> fused_kernels_of([[maybe_unused]] const std::string& law) {
  if constexpr (sizeof(T) == sizeof(float)) {
    const auto found = fused_laws().find(law);
    if (found == fused_laws().end()) return {};
    if constexpr (D == 2)
      return found->second.in_2d;
    else
      return found->second.in_3d;
  }
  return {};
}

}  // namespace mpm
