#include "cpu/isa.h"

#include <cstdlib>
#include <cstring>
#include <stdexcept>

namespace mpm::cpu {
namespace {

Level choose_level() {
  [[maybe_unused]] Level limit = Level::avx512;
#ifdef __x86_64__
  const char* wish = std::getenv("TORCH_MPM_ISA_LEVEL");
  const auto at_most = [&](const char* name) { return wish && std::strcmp(wish, name) == 0; };
  __builtin_cpu_init();
  if (!__builtin_cpu_supports("x86-64-v4") || at_most("avx2")) limit = Level::avx2;
  if (!__builtin_cpu_supports("x86-64-v3") || at_most("baseline")) limit = Level::baseline;
#endif
#ifdef TORCH_MPM_HAS_AVX512
  if (limit >= Level::avx512) return Level::avx512;
#endif
#ifdef TORCH_MPM_HAS_AVX2
  if (limit >= Level::avx2) return Level::avx2;
#endif
#ifdef TORCH_MPM_HAS_BASELINE
  return Level::baseline;
#else
  return Level::none;
#endif
}

const Level level = choose_level();

}  // namespace

Level isa_level() { return level; }

void refuse_machine() {
  throw std::runtime_error(
      "torch_mpm was built for other instructions than those of this processor (or of TORCH_MPM_ISA_LEVEL): build it "
      "on "
      "this machine, or with TORCH_MPM_ISA_LEVELS=all");
}

}  // namespace mpm::cpu
