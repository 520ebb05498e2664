#include "cpu/isa.h"

#include <cstdlib>
#include <cstring>

namespace mpm::cpu {
namespace {

Level choose_level() {
#ifdef __x86_64__
  const char* wish = std::getenv("TORCH_MPM_ISA_LEVEL");
  const auto at_most = [&](const char* name) { return wish && std::strcmp(wish, name) == 0; };
  __builtin_cpu_init();
  if (at_most("baseline") || !__builtin_cpu_supports("x86-64-v3")) return Level::baseline;
  if (at_most("avx2") || !__builtin_cpu_supports("x86-64-v4")) return Level::avx2;
  return Level::avx512;
#else
  return Level::baseline;
#endif
}

const Level level = choose_level();

}  // namespace

Level isa_level() { return level; }

}  // namespace mpm::cpu
