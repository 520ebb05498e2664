#pragma once

#include <cstdint>

#include "common/host_device.h"

// Particle and node values in the form of kernels: plain pointers and strides, shared by the CPU and CUDA kernels. Only
// the files *.op.cpp use tensors.
namespace mpm {

// A tensor [P], [P, I] or [P, I, J] of any strides (in elements); a null pointer is an absent field.
template <class T>
struct Field {
  T* pointer = nullptr;
  int64_t stride[3] = {0, 0, 0};
};

template <class T>
MPM_HD Field<const T> constant(const Field<T>& f) {
  return {f.pointer, {f.stride[0], f.stride[1], f.stride[2]}};
}

// Node values [max_blocks * 4^D, channels] with unit channel stride.
template <class T>
struct NodeField {
  T* pointer = nullptr;
  int64_t stride = 0;  // elements from node to node
  int channels = 0;
  T* tiles = nullptr;  // memory for sums with an order, on CUDA: see csrc/transfer/tiles.h; may be absent
};

}  // namespace mpm
