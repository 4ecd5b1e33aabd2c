// memory.h: memory of one forward and backward pass. Chunks are kept for the next call: fresh pages cost more than kernels.
// When the machine has no more, `take` returns null and `failed` says so: ask it before the first write.
#pragma once
#include <cstdint>
#include <cstdlib>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#if defined(__has_feature)
#if __has_feature(address_sanitizer)
#include <cstring>
#include <sanitizer/asan_interface.h>
#define SG_SANITIZED 1
#endif
#endif

namespace sarsplat {
namespace SG_ISA {

// Under AddressSanitizer every array of an arena has red zones of its own, and begins as NaN: nothing is read unwritten.
inline void forbid(char* p, int64_t bytes) {
#ifdef SG_SANITIZED
  __asan_poison_memory_region(p, bytes);
#else
  (void)p, (void)bytes;
#endif
}
inline void allow(char* p, int64_t bytes) {
#ifdef SG_SANITIZED
  __asan_unpoison_memory_region(p, bytes);
  std::memset(p, 0xff, bytes);
#else
  (void)p, (void)bytes;
#endif
}
#ifdef SG_SANITIZED
constexpr int64_t kRedZone = 64;
#else
constexpr int64_t kRedZone = 0;
#endif

// Gaussians in depth order lie anywhere, so with small pages each of them waits for the page table: a fifth of a large pass.
inline void ask_for_large_pages(char* p, int64_t bytes) {
#if defined(__linux__)
  const uintptr_t page = 4096, first = ((uintptr_t)p + page - 1) / page * page, end = ((uintptr_t)p + bytes) / page * page;
  if (first < end) madvise((void*)first, end - first, MADV_HUGEPAGE);  // where it is not heard, nothing changes
#else
  (void)p, (void)bytes;
#endif
}

class Arena {
 public:
  ~Arena() { give_back(); }
  void reset() {
    release({0, 0});
    if (count_ < 2) return;       // outgrown: from now on one chunk, or what lies in which would change, and more and more be touched
    int64_t all = 0;
    for (int i = 0; i < count_; i++) all += chunks_[i].bytes;
    free_chunks();
    grow(all);
  }
  void give_back() {  // everything taken becomes invalid
    release({0, 0});
    free_chunks();
  }
  bool failed() const { return failed_; }
  template <class T> T* take(int64_t n) {
    const int64_t wanted = n * (int64_t)sizeof(T), bytes = ((wanted + 63) & ~int64_t(63)) + kRedZone;
    while (current_ < count_ && used_ + bytes > chunks_[current_].bytes) { current_++; used_ = 0; }
    if (current_ == count_ && !grow(bytes)) { failed_ = true; return nullptr; }
    char* p = chunks_[current_].start + used_;
    used_ += bytes;
    allow(p, wanted);
    return (T*)p;
  }
  struct Mark { int chunk; int64_t used; };
  Mark mark() const { return {current_, used_}; }
  void release(Mark m) {
    failed_ = false;
    current_ = m.chunk;
    used_ = m.used;
    for (int i = current_; i < count_; i++) {
      const int64_t kept = i == current_ ? used_ : 0;
      forbid(chunks_[i].start + kept, chunks_[i].bytes - kept);
    }
  }

 private:
  struct Chunk { void* raw; char* start; int64_t bytes; };
  void free_chunks() {
    for (int i = 0; i < count_; i++) { allow(chunks_[i].start, chunks_[i].bytes); std::free(chunks_[i].raw); }
    count_ = 0;
  }
  bool grow(int64_t bytes) {
    if (count_ == kMaxChunks) return false;  // 64 chunks, each at least twice the one before
    const int64_t twice = count_ ? 2 * chunks_[count_ - 1].bytes : int64_t(1) << 22;
    int64_t size = bytes > twice ? bytes : twice;
    void* raw = std::malloc(size + 64);
    if (!raw) raw = std::malloc((size = bytes) + 64);  // room to grow is a luxury
    if (!raw) return false;
    chunks_[count_] = {raw, (char*)(((uintptr_t)raw + 63) & ~uintptr_t(63)), size};
    ask_for_large_pages(chunks_[count_].start, size);
    forbid(chunks_[count_++].start, size);
    return true;
  }
  static constexpr int kMaxChunks = 64;
  Chunk chunks_[kMaxChunks] = {};
  int count_ = 0, current_ = 0;
  int64_t used_ = 0;
  bool failed_ = false;
};

}  // namespace SG_ISA
}  // namespace sarsplat
