#pragma once

#include "heat/solve.h"

// The work space of a heat solve on the CPU.
namespace mpm::cpu {

template <class T>
struct HeatWorkspace {
  HeatVectors<T> v;
  NodeSums* sums;     // [capacity] of each slot
  double* curvature;  // [capacity] parts of p · A p from the slot's particles
  double* weighted;   // [capacity] and from its nodes
  HeatScene* scene;   // [scenes]
  int64_t size;       // in bytes
};

inline namespace TORCH_MPM_ISA {

template <class T, int D>
HeatWorkspace<T> lay_out_heat(const HeatArguments<T, D>& a, char* start) {
  const int64_t slots = a.topology.capacity, nodes = slots * kBlockNodes<D>;
  HeatWorkspace<T> w;
  int64_t used = 0;
  const auto take = [&](int64_t bytes) {
    char* p = start + used;
    used += (bytes + 63) / 64 * 64;
    return p;
  };
  T** const vectors[] = {&w.v.mass, &w.v.weight, &w.v.inverse, &w.v.r, &w.v.p, &w.v.product};
  for (T** vector : vectors) *vector = reinterpret_cast<T*>(take(nodes * int64_t(sizeof(T))));
  w.sums = reinterpret_cast<NodeSums*>(take(slots * int64_t(sizeof(NodeSums))));
  w.curvature = reinterpret_cast<double*>(take(slots * int64_t(sizeof(double))));
  w.weighted = reinterpret_cast<double*>(take(slots * int64_t(sizeof(double))));
  w.scene = reinterpret_cast<HeatScene*>(take(a.topology.scenes * int64_t(sizeof(HeatScene))));
  w.size = used;
  return w;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
