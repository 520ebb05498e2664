#pragma once

// Functions of the physics headers run on the host and on the device.
#if defined(__CUDACC__)
#define MPM_HD __host__ __device__ __forceinline__
#define MPM_UNROLL _Pragma("unroll")
#else
#define MPM_HD inline __attribute__((always_inline))
#define MPM_UNROLL _Pragma("GCC unroll 64")
#endif

// CPU kernels are compiled once per instruction set. Every template of these headers lives in an inline namespace named
// after it, so that the linker never merges an AVX-512 instance with a baseline one.
#ifndef TORCH_MPM_ISA
#define TORCH_MPM_ISA baseline
#endif
