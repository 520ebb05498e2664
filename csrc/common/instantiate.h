#pragma once

// Explicit instantiation of kernels for every scalar, dimension and kernel order that is compiled. setup.py compiles
// large files in parts, one for MPM_SCALAR and MPM_DIMENSION each.
#if defined(MPM_SCALAR) && defined(MPM_DIMENSION)
#define MPM_EACH_SHAPE(CALL, ...) CALL(MPM_SCALAR, MPM_DIMENSION, __VA_ARGS__)
#elif defined(MPM_SCALAR)
#define MPM_EACH_SHAPE(CALL, ...)  \
  CALL(MPM_SCALAR, 2, __VA_ARGS__) \
  CALL(MPM_SCALAR, 3, __VA_ARGS__)
#else
#define MPM_EACH_SHAPE(CALL, ...) \
  CALL(float, 2, __VA_ARGS__)     \
  CALL(float, 3, __VA_ARGS__)     \
  CALL(double, 2, __VA_ARGS__)    \
  CALL(double, 3, __VA_ARGS__)
#endif

#ifdef __CUDACC__
#define MPM_KERNEL_STREAM , Stream
#else
#define MPM_KERNEL_STREAM
#endif

#define MPM_INSTANTIATE(name, Arguments) MPM_EACH_SHAPE(MPM_INSTANTIATE_PLAIN, name, Arguments)
#define MPM_INSTANTIATE_PLAIN(T, D, name, Arguments) template void name<T, D>(const Arguments<T, D>& MPM_KERNEL_STREAM);

#define MPM_INSTANTIATE_ORDERS(name, Arguments) MPM_EACH_SHAPE(MPM_INSTANTIATE_ORDERED, name, Arguments)
#define MPM_INSTANTIATE_ORDERED(T, D, name, Arguments)                   \
  template void name<2, T, D>(const Arguments<T, D>& MPM_KERNEL_STREAM); \
  template void name<3, T, D>(const Arguments<T, D>& MPM_KERNEL_STREAM);

#define MPM_INSTANTIATE_SIZE(name, Arguments) MPM_EACH_SHAPE(MPM_INSTANTIATE_SIZE_OF, name, Arguments)
#define MPM_INSTANTIATE_SIZE_OF(T, D, name, Arguments) template int64_t name<T, D>(const Arguments<T, D>&);
