#pragma once

namespace mpm {

// Units of node sums that do not depend on the order of their terms, in deterministic mode: terms are rounded to whole
// units and added as 64-bit integers. The units are powers of two, so that nothing else is rounded. The unit of mass
// follows from the largest mass of a particle times the number of particles, which no sum exceeds; that of momentum
// from this mass at the speed kMostCellsPerStep.
struct FixedPoint {
  const int* largest_mass = nullptr;  // the bits of a float; null for floating-point sums
  int mass_exponent = 0;              // 2^mass_exponent units are a power of two above that mass
  int momentum_exponent = 0;          // the same for that mass at a speed of 1
};

constexpr int kUnitBits = 61;  // of the largest sum; the next bit marks what is not a number
constexpr double kMostCellsPerStep = 16;

}  // namespace mpm
