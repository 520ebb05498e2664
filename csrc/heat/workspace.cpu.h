#pragma once

#include "heat/solve.h"

// The work space of a heat solve on the CPU.
namespace mpm::cpu {

// Part of p · A p.
struct Curvature {
  double value;
  void add(const Curvature& o) { value += o.value; }
};

template <class T>
struct HeatWorkspace {
  HeatVectors<T> v;
  StartSums<T>* start;   // [max_blocks] of each slot
  StepSums<T>* step;     // [max_blocks]
  Curvature* curvature;  // [max_blocks]
  HeatScene* scene;      // [scenes]
  void* sums;            // [scenes], of any kind
  int64_t size;          // in bytes
};

inline namespace TORCH_MPM_ISA {

template <class T, int D>
HeatWorkspace<T> lay_out_heat(const HeatArguments<T, D>& a, char* start) {
  const int64_t slots = a.topology.max_blocks, nodes = slots * kBlockNodes<D>;
  HeatWorkspace<T> w;
  int64_t used = 0;
  const auto take = [&](int64_t bytes) {
    char* p = start + used;
    used += (bytes + 63) / 64 * 64;
    return p;
  };
  T** const vectors[] = {&w.v.mass, &w.v.weight, &w.v.inverse, &w.v.r, &w.v.p, &w.v.product};
  for (T** vector : vectors) *vector = reinterpret_cast<T*>(take(nodes * int64_t(sizeof(T))));
  w.start = reinterpret_cast<StartSums<T>*>(take(slots * int64_t(sizeof(StartSums<T>))));
  w.step = reinterpret_cast<StepSums<T>*>(take(slots * int64_t(sizeof(StepSums<T>))));
  w.curvature = reinterpret_cast<Curvature*>(take(slots * int64_t(sizeof(Curvature))));
  w.scene = reinterpret_cast<HeatScene*>(take(a.topology.scenes * int64_t(sizeof(HeatScene))));
  w.sums = take(a.topology.scenes * int64_t(sizeof(StartSums<double>)));
  w.size = used;
  return w;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
