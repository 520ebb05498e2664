#pragma once

#include "common/fields.h"
#include "grid/slot_sums.h"

// Sums over many steps, and the blend of FLIP.
namespace mpm {

constexpr int kMostAddends = 8;

// sum_i += term_i for several arrays. Two terms may have the same sum.
template <class T, int D>
struct AccumulateArguments {
  struct Addend {
    T* sum;
    const T* term;
    int64_t size;
  };
  Addend addend[kMostAddends];
  int addends = 0;
  int64_t longest = 0;  // size of an addend

  void add(T* sum, const T* term, int64_t size) {
    addend[addends++] = {sum, term, size};
    longest = longest > size ? longest : size;
  }
};

// Advances the clocks of scenes by dt * scene_dt, in double precision for particles of every type.
template <class T, int D>
struct AdvanceClocksArguments {
  double* time = nullptr;       // [scenes]
  const T* scene_dt = nullptr;  // [scenes]
  double dt = 0;
  int64_t scenes = 0;
};

// to = first + share * second, [count, D]; `to` may be one of them. An absent first is zero.
template <class T, int D>
struct AddScaledArguments {
  int64_t count = 0;
  Field<T> to;
  Field<const T> first, second;
  double share = 1;
};

// Adds values of slots [max_blocks, D] to the sums [block_count, D] of their blocks.
template <class T, int D>
struct AccumulateSlotsArguments {
  int max_blocks = 0, block_count = 0;
  const int* block = nullptr;  // [max_blocks] block of a slot, -1 where unused
  const T* value = nullptr;
  T* sum = nullptr;
};

// Sums over slots, as arguments of the backend.
template <class T, int D>
struct SumSlotsArguments {
  SlotSums<T> sums;
};

}  // namespace mpm
