#include "rollout/accumulate.h"

#include <algorithm>

#include "common/instantiate.h"
#include "cpu/parallel.h"
#include "cpu/slot_sums.h"

namespace mpm::cpu {
inline namespace TORCH_MPM_ISA {
namespace {

constexpr int64_t kGrain = 1 << 14;  // elements below which a range is not split

}  // namespace

template <class T, int D>
void accumulate(const AccumulateArguments<T, D>& a) {
  parallel_ranges(a.longest, kGrain, [&](int64_t begin, int64_t end) {
    for (int k = 0; k < a.addends; k++) {
      const auto [sum, term, size] = a.addend[k];
      const int64_t last = std::min(end, size);
#pragma GCC ivdep
      for (int64_t i = begin; i < last; i++) sum[i] += term[i];
    }
  });
}

template <class T, int D>
void advance_clocks(const AdvanceClocksArguments<T, D>& a) {
  for (int64_t b = 0; b < a.scenes; b++) a.time[b] += a.dt * double(a.scene_dt[b]);
}

template <class T, int D>
void add_scaled(const AddScaledArguments<T, D>& a) {
  const T share = T(a.share), zero = T(0);
  const int64_t to_stride = a.to.stride[0], first_stride = a.first.stride[0], second_stride = a.second.stride[0];
  parallel_ranges(a.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int i = 0; i < D; i++) {
      T* const to = a.to.pointer + i * a.to.stride[1];
      const T* const first = a.first.pointer ? a.first.pointer + i * a.first.stride[1] : &zero;
      const T* const second = a.second.pointer + i * a.second.stride[1];
#pragma GCC ivdep
      for (int64_t p = begin; p < end; p++)
        to[p * to_stride] = first[p * first_stride] + share * second[p * second_stride];
    }
  });
}

template <class T, int D>
void accumulate_slots(const AccumulateSlotsArguments<T, D>& a) {
  for (int64_t slot = 0; slot < a.max_blocks; slot++) {
    const int64_t block = a.block[slot];
    if (block < 0 || block >= a.block_count) continue;
    for (int i = 0; i < D; i++) a.sum[block * D + i] += a.value[slot * D + i];
  }
}

template <class T, int D>
void sum_slots(const SumSlotsArguments<T, D>& a) {
  add_up(a.sums);
}

MPM_INSTANTIATE(accumulate, AccumulateArguments)
MPM_INSTANTIATE(advance_clocks, AdvanceClocksArguments)
MPM_INSTANTIATE(add_scaled, AddScaledArguments)
MPM_INSTANTIATE(accumulate_slots, AccumulateSlotsArguments)
MPM_INSTANTIATE(sum_slots, SumSlotsArguments)

}  // namespace TORCH_MPM_ISA
}  // namespace mpm::cpu
