#pragma once

// Kernels of *_kernels.cpp exist once per instruction set, in a namespace named after it; the best one is chosen at run
// time.
namespace mpm::cpu {

enum class Level { baseline, avx2, avx512 };

// The best level of this machine, or a lower one asked for by the environment variable TORCH_MPM_ISA_LEVEL.
Level isa_level();

}  // namespace mpm::cpu

// The declarations in the namespace of every level, and a call of the best of them.
#ifdef __x86_64__
#define MPM_CPU_DECLARE_LEVELS(declarations) \
  inline namespace baseline {                \
  declarations                               \
  }                                          \
  namespace avx2 {                           \
  declarations                               \
  }                                          \
  namespace avx512 {                         \
  declarations                               \
  }
#define MPM_CPU_CALL_BEST(...)                                    \
  do {                                                            \
    if (isa_level() == Level::avx512) return avx512::__VA_ARGS__; \
    if (isa_level() == Level::avx2) return avx2::__VA_ARGS__;     \
    return baseline::__VA_ARGS__;                                 \
  } while (false)
#else
#define MPM_CPU_DECLARE_LEVELS(declarations) \
  inline namespace baseline {                \
  declarations                               \
  }
#define MPM_CPU_CALL_BEST(...) return baseline::__VA_ARGS__
#endif
