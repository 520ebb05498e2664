#pragma once

#include "cpu/schedule.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {

// Stable counting sort of at most kChunk particles: nth[i] is the particle that is i-th by cell, end[c] the number of
// particles up to and including cell c. Returns whether they were unsorted.
template <int Cells>
bool sort_by_cell(const uint8_t* cell, int count, uint16_t* nth, uint16_t* end) {
  // Four counts of each cell, so that consecutive particles do not wait for the same one.
  uint16_t counts[4][Cells] = {}, next[Cells];
  bool falls = false;
  for (int i = 1; i < count; i++) falls |= cell[i - 1] > cell[i];
  for (int i = 0; i < count; i++) counts[i % 4][cell[i]]++;
  for (int c = 0, before = 0; c < Cells; c++) {
    next[c] = uint16_t(before);
    end[c] = uint16_t(before += counts[0][c] + counts[1][c] + counts[2][c] + counts[3][c]);
  }
  if (falls)
    for (int i = 0; i < count; i++) nth[next[cell[i]]++] = uint16_t(i);
  else
    for (int i = 0; i < count; i++) nth[i] = uint16_t(i);
  return falls;
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
