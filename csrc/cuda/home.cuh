#pragma once

#include "cuda/schedule.h"
#include "transfer/arguments.h"

// What the kernels of one work item share: the home block, the tile of nodes that its particles touch, and which cell a
// particle lies in.
namespace mpm::cuda {

// The tile starts at the first node of the home block and is 4 + Order nodes wide.
template <int Order, int D>
struct Tile {
  static constexpr int width = kBlockWidth + Order;
  static constexpr int nodes = D == 2 ? width * width : width * width * width;
  static constexpr int neighbours = 1 << D;  // bit of axis i: D - 1 - i, set for the block one further along the axis

  __device__ static void node(int t, int n[D]) {
#pragma unroll
    for (int i = D - 1; i >= 0; i--) {
      n[i] = t % width;
      t /= width;
    }
  }
};

struct Item {
  int slot, begin, end;  // particles index[begin, end)
  int block;             // table index of the home block
};

template <class T, int D>
__device__ Item item_at(const Topology<T, D>& t, int i) {
  const int4 v = reinterpret_cast<const int4*>(t.schedule + kScheduleHeader)[i];
  return {v.x, v.y, v.z, v.w};
}

template <int D>
struct Home {
  int scene;
  int block[D];
};

template <class T, int D>
__device__ Home<D> home_of(const Topology<T, D>& t, const Item& item) {
  Home<D> h;
  h.scene = block_coordinates(t.geometry, item.block, h.block);
  return h;
}

// Slots of the home block and of the blocks after it; -1 where inactive. Call with the first 2^D threads or more.
template <class T, int D>
__device__ void load_slots(const Topology<T, D>& t, const Home<D>& home, int slots[1 << D]) {
  if (threadIdx.x >= 1 << D) return;
  int block[D];
  bool inside = true;
#pragma unroll
  for (int i = 0; i < D; i++) {
    block[i] = home.block[i] + (threadIdx.x >> (D - 1 - i) & 1);
    inside = inside && block[i] < t.geometry.blocks[i];
  }
  slots[threadIdx.x] = inside ? t.table[block_index(t.geometry, home.scene, block)] : -1;
}

// Row of the node tensor of node n of the tile, -1 where its block is inactive.
template <int D>
__device__ int64_t node_row(const int slots[1 << D], const int n[D]) {
  int neighbour = 0;
#pragma unroll
  for (int i = 0; i < D; i++) neighbour = neighbour * 2 + (n[i] >= kBlockWidth);
  const int slot = slots[neighbour];
  return slot < 0 ? -1 : int64_t(slot) * kBlockNodes<D> + node_in_block<D>(n);
}

template <class T>
__device__ T read(const Field<const T>& f, int64_t p, int i = 0, int j = 0) {
  return f.pointer[p * f.stride[0] + i * f.stride[1] + j * f.stride[2]];
}

template <class T>
__device__ void write(const Field<T>& f, T value, int64_t p, int i = 0, int j = 0) {
  if (f.pointer) f.pointer[p * f.stride[0] + i * f.stride[1] + j * f.stride[2]] = value;
}

template <class T, int D>
__device__ Vector<T, D> read_vector(const Field<const T>& f, int64_t p) {
  Vector<T, D> v;
#pragma unroll
  for (int i = 0; i < D; i++) v[i] = read(f, p, i);
  return v;
}

// Base node relative to the home block, and the distances from it. False, with base zero, for a particle that is not at
// home: its position is not the one that was activated.
template <int Order, class T, int D>
__device__ bool locate_at_home(const Topology<T, D>& t, const Home<D>& home, const Vector<T, D>& x, int* base, T* f) {
  bool inside = locate<Order>(t.geometry, x.e, base, f);
#pragma unroll
  for (int i = 0; i < D; i++) {
    base[i] -= home.block[i] * kBlockWidth;
    inside = inside && unsigned(base[i]) < unsigned(kBlockWidth);
  }
#pragma unroll
  for (int i = 0; i < D; i++) base[i] = inside ? base[i] : 0;
  return inside;
}

}  // namespace mpm::cuda
