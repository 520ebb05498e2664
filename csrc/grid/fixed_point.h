#pragma once

namespace mpm {

// Of node sums over particles that do not depend on the order of their terms, in deterministic mode: terms are rounded
// to whole units, and a sum has 64 bits for these. The units are powers of two, so that nothing else is rounded: those
// of mass follow from the largest mass of a particle and the number of particles, which no sum exceeds, and those of
// momentum from such a sum at kMostCellsPerStep.
struct FixedPoint {
  const int* largest_mass = nullptr;  // the bits of a float; null where sums are floating-point numbers
  int mass_exponent = 0;              // there are 2^mass_exponent units in a power of two above that mass
  int momentum_exponent = 0;          // and so many at a speed of 1
};

constexpr int kUnitBits = 61;  // of the largest sum; the next bit marks what is not a number
constexpr double kMostCellsPerStep = 16;

}  // namespace mpm
