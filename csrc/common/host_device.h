#pragma once

// Functions of the physics headers run on the host and on the device. MPM_LOOP keeps a loop as it is on a device: code
// that few nodes need, and that is longer than the instruction cache, runs at the speed of its loads. MPM_LOOP_OF(N)
// unrolls a loop of at most N turns where N is not zero.
#if defined(__CUDACC__)
#define MPM_HD __host__ __device__ __forceinline__
#define MPM_UNROLL _Pragma("unroll")
#define MPM_LOOP _Pragma("unroll 1")
#define MPM_PRAGMA(...) _Pragma(#__VA_ARGS__)
#define MPM_LOOP_OF(N) MPM_PRAGMA(unroll((N) > 0 ? (N) : 1))
#else
#define MPM_HD inline __attribute__((always_inline))
#define MPM_UNROLL _Pragma("GCC unroll 64")
#define MPM_LOOP
#define MPM_LOOP_OF(N)
#endif

// CPU kernels are compiled once per instruction set. Every template of these headers lives in an inline namespace named
// after it, so that the linker never merges an AVX-512 instance with a baseline one.
#ifndef TORCH_MPM_ISA
#define TORCH_MPM_ISA baseline
#endif
