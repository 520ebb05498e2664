#include "cpu/lazy_table.h"

#include <sys/mman.h>
#ifdef __linux__
#include <sys/stat.h>
#include <unistd.h>
#endif

#include <algorithm>
#include <cstring>

namespace mpm::cpu {
namespace {

#ifdef __linux__
// Size of the file: a mapping of each piece costs some microseconds, and a process may have 65530 of them.
constexpr int64_t kPiece = 16 << 20;

// The file, which is not written again. A process may close unknown descriptors, and another file then gets the
// number.
class LazyTableFile {
 public:
  LazyTableFile() : descriptor_(memfd_create("torch_mpm", MFD_CLOEXEC)) {
    if (descriptor_ < 0) return;
    void* const p = ftruncate(descriptor_, kPiece) == 0
                        ? mmap(nullptr, kPiece, PROT_READ | PROT_WRITE, MAP_SHARED, descriptor_, 0)
                        : MAP_FAILED;
    if (p != MAP_FAILED) {
      std::memset(p, 0xff, kPiece);
      munmap(p, kPiece);
      made_ = fstat(descriptor_, &identity_) == 0;
    }
    if (!made_) close(descriptor_);
  }

  // Descriptor of the file; -1 if there is none, or if it was closed.
  int descriptor() const {
    struct stat now;
    if (!made_ || fstat(descriptor_, &now) != 0) return -1;
    return now.st_dev == identity_.st_dev && now.st_ino == identity_.st_ino ? descriptor_ : -1;
  }

 private:
  int descriptor_;
  bool made_ = false;
  struct stat identity_{};
};
#endif

}  // namespace

void* allocate_lazy_table([[maybe_unused]] int64_t bytes) {
#ifdef __linux__
  static const LazyTableFile table;
  const int file = table.descriptor();
  if (file < 0) return nullptr;
  constexpr int protection = PROT_READ | PROT_WRITE, flags = MAP_PRIVATE | MAP_NORESERVE;
  void* const all = mmap(nullptr, size_t(bytes), protection, flags | MAP_ANONYMOUS, -1, 0);
  if (all == MAP_FAILED) return nullptr;
  for (int64_t begin = 0; begin < bytes; begin += kPiece) {
    char* const piece = static_cast<char*>(all) + begin;
    if (mmap(piece, size_t(std::min(kPiece, bytes - begin)), protection, flags | MAP_FIXED, file, 0) == MAP_FAILED) {
      free_lazy_table(all, bytes);
      return nullptr;
    }
  }
  return all;
#else
  return nullptr;
#endif
}

void free_lazy_table(void* data, int64_t bytes) { munmap(data, size_t(bytes)); }

}  // namespace mpm::cpu
