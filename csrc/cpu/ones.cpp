#include "cpu/ones.h"

#include <sys/mman.h>
#ifdef __linux__
#include <unistd.h>
#endif

#include <algorithm>
#include <cstring>

namespace mpm::cpu {
namespace {

#ifdef __linux__
// Of the file: a mapping of each piece costs some microseconds, and a process may have 65530 of them.
constexpr int64_t kPiece = 16 << 20;

// The file, which nobody writes any more; -1 where there is none.
int make_file() {
  const int file = memfd_create("torch_mpm", MFD_CLOEXEC);
  if (file < 0) return -1;
  if (ftruncate(file, kPiece) == 0) {
    void* const p = mmap(nullptr, kPiece, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (p != MAP_FAILED) {
      std::memset(p, 0xff, kPiece);
      munmap(p, kPiece);
      return file;
    }
  }
  close(file);
  return -1;
}
#endif

}  // namespace

void* take_ones([[maybe_unused]] int64_t bytes) {
#ifdef __linux__
  static const int file = make_file();
  if (file < 0) return nullptr;
  constexpr int protection = PROT_READ | PROT_WRITE, flags = MAP_PRIVATE | MAP_NORESERVE;
  void* const all = mmap(nullptr, size_t(bytes), protection, flags | MAP_ANONYMOUS, -1, 0);
  if (all == MAP_FAILED) return nullptr;
  for (int64_t begin = 0; begin < bytes; begin += kPiece) {
    char* const piece = static_cast<char*>(all) + begin;
    if (mmap(piece, size_t(std::min(kPiece, bytes - begin)), protection, flags | MAP_FIXED, file, 0) == MAP_FAILED) {
      give_back_ones(all, bytes);
      return nullptr;
    }
  }
  return all;
#else
  return nullptr;
#endif
}

void give_back_ones(void* data, int64_t bytes) { munmap(data, size_t(bytes)); }

}  // namespace mpm::cpu
