#include "cpu/memory_cache.h"

#include <sys/mman.h>

#include <mutex>
#include <vector>

namespace mpm::cpu {
namespace {

constexpr int64_t kPage = 4096, kLargePage = 1 << 21;

// Buffers start at different offsets in a page: cache sets, and the comparison of loads with earlier stores, use only
// the low bits of addresses.
constexpr int64_t kStagger = 9 * 64;

int64_t rounded_up(int64_t n, int64_t to) { return (n + to - 1) / to * to; }

Buffer* map(int64_t bytes, int64_t offset) {
  const int64_t mapped = rounded_up(offset + bytes, kPage), wanted = mapped + kLargePage;
  void* p = mmap(nullptr, size_t(wanted), PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (p == MAP_FAILED) return nullptr;
  char* start = static_cast<char*>(p);
  const int64_t before = (kLargePage - int64_t(reinterpret_cast<uintptr_t>(start) % kLargePage)) % kLargePage;
  if (before) munmap(start, size_t(before));
  munmap(start + before + mapped, size_t(kLargePage - before));
  start += before;
#ifdef MADV_HUGEPAGE
  madvise(start, size_t(mapped), MADV_HUGEPAGE);
#endif
  return new Buffer{start + offset, mapped - offset, start, mapped};
}

void unmap(Buffer* b) {
  munmap(b->mapping, size_t(b->mapped));
  delete b;
}

struct MemoryCache {
  std::mutex mutex;
  std::vector<Buffer*> kept;  // the most recently released buffer is last: it may still be in a cache
  int64_t kept_bytes = 0, living_bytes = 0, count = 0;

  // Smallest stored buffer that is large enough and not much larger.
  Buffer* find(int64_t bytes) {
    size_t best = kept.size();
    for (size_t i = kept.size(); i-- > 0;) {
      const int64_t size = kept[i]->size;
      if (size >= bytes && size <= bytes + bytes / 4 && (best == kept.size() || size < kept[best]->size)) best = i;
    }
    if (best == kept.size()) return nullptr;
    Buffer* b = kept[best];
    kept.erase(kept.begin() + ptrdiff_t(best));
    kept_bytes -= b->size;
    return b;
  }
};

// Never destroyed: tensors may outlive it at the end of the process.
MemoryCache& memory_cache() {
  static MemoryCache* cache = new MemoryCache;
  return *cache;
}

}  // namespace

Buffer* take(int64_t bytes) {
  MemoryCache& cache = memory_cache();
  std::unique_lock lock(cache.mutex);
  Buffer* b = cache.find(bytes);
  const int64_t offset = cache.count++ * kStagger % kPage;
  if (!b) {
    lock.unlock();
    b = map(bytes, offset);
    if (!b) return nullptr;
    lock.lock();
  }
  cache.living_bytes += b->size;
  return b;
}

void give_back(Buffer* buffer) {
  MemoryCache& cache = memory_cache();
  std::vector<Buffer*> surplus;
  {
    const std::lock_guard lock(cache.mutex);
    cache.living_bytes -= buffer->size;
    cache.kept_bytes += buffer->size;
    cache.kept.push_back(buffer);
    const int64_t most = kKept * cache.living_bytes > kKeptAnyway ? kKept * cache.living_bytes : kKeptAnyway;
    size_t oldest = 0;
    for (; cache.kept_bytes > most; oldest++) cache.kept_bytes -= cache.kept[oldest]->size;
    surplus.assign(cache.kept.begin(), cache.kept.begin() + ptrdiff_t(oldest));
    cache.kept.erase(cache.kept.begin(), cache.kept.begin() + ptrdiff_t(oldest));
  }
  for (Buffer* b : surplus) unmap(b);
}

}  // namespace mpm::cpu
