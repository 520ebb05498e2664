#pragma once

// Kernels of *.cpu.cpp exist once per instruction set, in a namespace named after it; the best one is chosen at run
// time.
namespace mpm::cpu {

enum class Level { none, baseline, avx2, avx512 };

// Best compiled level that this machine supports, or a lower one set by the environment variable TORCH_MPM_ISA_LEVEL.
Level isa_level();

[[noreturn]] void refuse_machine();

}  // namespace mpm::cpu

// Declarations in the namespace of every compiled level (setup.py), and a call of the best of them.
#ifdef TORCH_MPM_HAS_BASELINE
#define MPM_CPU_DECLARE_BASELINE(...) \
  inline namespace baseline {         \
  __VA_ARGS__                         \
  }
#define MPM_CPU_CALL_BASELINE(...) \
  if (isa_level() == Level::baseline) return baseline::__VA_ARGS__
#else
#define MPM_CPU_DECLARE_BASELINE(...)
#define MPM_CPU_CALL_BASELINE(...)
#endif
#ifdef TORCH_MPM_HAS_AVX2
#define MPM_CPU_DECLARE_AVX2(...) \
  namespace avx2 {                \
  __VA_ARGS__                     \
  }
#define MPM_CPU_CALL_AVX2(...) \
  if (isa_level() == Level::avx2) return avx2::__VA_ARGS__
#else
#define MPM_CPU_DECLARE_AVX2(...)
#define MPM_CPU_CALL_AVX2(...)
#endif
#ifdef TORCH_MPM_HAS_AVX512
#define MPM_CPU_DECLARE_AVX512(...) \
  namespace avx512 {                \
  __VA_ARGS__                       \
  }
#define MPM_CPU_CALL_AVX512(...) \
  if (isa_level() == Level::avx512) return avx512::__VA_ARGS__
#else
#define MPM_CPU_DECLARE_AVX512(...)
#define MPM_CPU_CALL_AVX512(...)
#endif
#define MPM_CPU_DECLARE_LEVELS(...)     \
  MPM_CPU_DECLARE_BASELINE(__VA_ARGS__) \
  MPM_CPU_DECLARE_AVX2(__VA_ARGS__)     \
  MPM_CPU_DECLARE_AVX512(__VA_ARGS__)
#define MPM_CPU_CALL_BEST(...)          \
  do {                                  \
    MPM_CPU_CALL_AVX512(__VA_ARGS__);   \
    MPM_CPU_CALL_AVX2(__VA_ARGS__);     \
    MPM_CPU_CALL_BASELINE(__VA_ARGS__); \
    refuse_machine();                   \
  } while (false)
