// memory.h: memory of one forward and backward pass. Chunks are kept for the next call: fresh pages cost more than kernels.
#pragma once
#include <cstdint>
#include <cstdlib>

namespace sarsplat {
namespace SG_ISA {

class Arena {
 public:
  ~Arena() { for (int i = 0; i < count_; i++) std::free(chunks_[i].raw); }
  void reset() { current_ = 0; used_ = 0; }
  template <class T> T* take(int64_t n) {
    const int64_t bytes = (n * (int64_t)sizeof(T) + 63) & ~int64_t(63);
    while (current_ < count_ && used_ + bytes > chunks_[current_].bytes) { current_++; used_ = 0; }
    if (current_ == count_) grow(bytes);
    T* p = (T*)(chunks_[current_].start + used_);
    used_ += bytes;
    return p;
  }
  struct Mark { int chunk; int64_t used; };
  Mark mark() const { return {current_, used_}; }
  void release(Mark m) { current_ = m.chunk; used_ = m.used; }

 private:
  struct Chunk { void* raw; char* start; int64_t bytes; };
  void grow(int64_t bytes) {
    if (count_ == kMost) std::abort();  // 64 chunks, each at least twice the one before
    const int64_t twice = count_ ? 2 * chunks_[count_ - 1].bytes : int64_t(1) << 22;
    const int64_t size = bytes > twice ? bytes : twice;
    void* raw = std::malloc(size + 64);
    if (!raw) std::abort();
    chunks_[count_++] = {raw, (char*)(((uintptr_t)raw + 63) & ~uintptr_t(63)), size};
  }
  static constexpr int kMost = 64;
  Chunk chunks_[kMost] = {};
  int count_ = 0, current_ = 0;
  int64_t used_ = 0;
};

}  // namespace SG_ISA
}  // namespace sarsplat
