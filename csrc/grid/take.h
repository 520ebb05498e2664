#pragma once

#include <cstdint>

#include "common/host_device.h"

// Fields of selected particles, all in one pass: a scene that is sorted has a dozen of them.
namespace mpm {

constexpr int kMostColumns = 64;

// A value of each particle, moved as bytes.
struct TakenColumn {
  const char* from;
  char* to;        // without gaps
  int64_t stride;  // of `from` [bytes]
  int size;        // of a value: 1, 2, 4 or 8 [bytes]

  MPM_HD uint64_t read(int64_t row) const {
    const char* const at = from + row * stride;
    switch (size) {
      case 1:
        return *reinterpret_cast<const uint8_t*>(at);
      case 2:
        return *reinterpret_cast<const uint16_t*>(at);
      case 4:
        return *reinterpret_cast<const uint32_t*>(at);
      default:
        return *reinterpret_cast<const uint64_t*>(at);
    }
  }
  MPM_HD void write(int64_t row, uint64_t value) const {
    char* const at = to + row * size;
    switch (size) {
      case 1:
        *reinterpret_cast<uint8_t*>(at) = uint8_t(value);
        break;
      case 2:
        *reinterpret_cast<uint16_t*>(at) = uint16_t(value);
        break;
      case 4:
        *reinterpret_cast<uint32_t*>(at) = uint32_t(value);
        break;
      default:
        *reinterpret_cast<uint64_t*>(at) = value;
    }
  }
};

struct TakeArguments {
  TakenColumn column[kMostColumns];
  int columns = 0;
  const void* particles = nullptr;  // [count]; the values of those out of range are zero
  bool is_wide = false;             // of 64 bits, else 32
  int64_t rows = 0, count = 0;

  MPM_HD int64_t particle(int64_t i) const {
    return is_wide ? static_cast<const int64_t*>(particles)[i] : static_cast<const int*>(particles)[i];
  }
  MPM_HD bool has(int64_t particle) const { return uint64_t(particle) < uint64_t(rows); }
};

}  // namespace mpm
