#pragma once

#include "grid/fixed_point.h"
#include "grid/grid_update.h"

// Rows of nodes in integer units: mass, then momentum, 64 bits each.
namespace mpm::cuda {

constexpr long long kNotANumber = 1ll << (kUnitBits + 1);  // in the mass, for any added value

__device__ inline float power_of_two(int exponent) {
  return __int_as_float((::min(::max(exponent, -126), 126) + 127) << 23);
}

struct FixedUnits {
  float mass, momentum;  // units per mass and momentum

  __device__ explicit FixedUnits(const FixedPoint& fixed) {
    const int exponent = (*fixed.largest_mass >> 23) - 126;  // the largest mass is below two to this
    mass = power_of_two(fixed.mass_exponent - exponent);
    momentum = power_of_two(fixed.momentum_exponent - exponent);
  }
  __device__ float of(int channel) const { return channel == 0 ? mass : momentum; }
};

// A value that is not finite, or larger than any possible sum, makes the node invalid.
__device__ inline void add_fixed(long long* row, int channel, float value, const FixedUnits& units) {
  const float scaled = value * units.of(channel);
  const bool fits = fabsf(scaled) < float(1ll << kUnitBits);  // false for NaN
  using Word = unsigned long long;
  if (fits)
    atomicAdd(reinterpret_cast<Word*>(row + channel), Word(__float2ll_rn(scaled)));
  else
    atomicOr(reinterpret_cast<Word*>(row), Word(kNotANumber));
}

template <int D>
struct alignas(D == 3 ? 16 : 8) FixedRow {
  long long word[1 + D];
};

template <int D>
__device__ NodeRow<float, D> in_floats(const FixedRow<D>& row, const FixedUnits& units) {
  const bool is_number = !(row.word[0] & kNotANumber);
  NodeRow<float, D> r;
  r.mass = __ll2float_rn(row.word[0] & (kNotANumber - 1)) * (1 / units.mass);
  const float momentum = is_number ? 1 / units.momentum : NAN;
#pragma unroll
  for (int i = 0; i < D; i++) r.value[i] = __ll2float_rn(row.word[1 + i]) * momentum;
  return r;
}

// The sums of nodes of either kind.
template <class T, int D>
class NodeRows {
 public:
  __device__ NodeRows(const NodeRow<T, D>* nodes, const FixedPoint& fixed) : nodes_(nodes), fixed_(fixed) {}

  __device__ NodeRow<T, D> at(int64_t node) const {
    if constexpr (sizeof(T) == sizeof(float))
      if (fixed_.largest_mass) return in_floats(reinterpret_cast<const FixedRow<D>*>(nodes_)[node], FixedUnits(fixed_));
    return nodes_[node];
  }
  __device__ static void empty(NodeRow<T, D>* nodes, int64_t node, const FixedPoint& fixed) {
    if (sizeof(T) == sizeof(float) && fixed.largest_mass)
      reinterpret_cast<FixedRow<D>*>(nodes)[node] = {};
    else
      nodes[node] = {};
  }

 private:
  const NodeRow<T, D>* nodes_;
  const FixedPoint& fixed_;
};

}  // namespace mpm::cuda
