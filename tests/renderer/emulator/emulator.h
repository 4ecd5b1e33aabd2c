// emulator.h: the part of CUDA C++ that the engine's kernels use, on one CPU thread. The threads of a block are fibers
// that run until they must wait for each other, in an order of the caller's choosing: a missing barrier gives different
// results in different orders. Shared memory holds NaN before every block; a collective call that not all threads of a
// warp or block reach is reported.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

#define __device__
#define __global__
#define __forceinline__ inline __attribute__((always_inline))
#define __launch_bounds__(...)
#define __shared__ static __attribute__((section("shared_memory")))

namespace emulator {

struct Index { unsigned x; };
extern Index thread, block;

enum Collective { BLOCK, WARP_ANY, WARP_EXCHANGE, WARP_BALLOT, WARP };
constexpr int kMaxThreads = 1024;
struct Met { uint32_t any, values[kMaxThreads]; };  // the bits that any thread's value has; every thread's, by its number there
// Waits for the warp or block.
const Met& meet(Collective what, uint32_t mine);
// Waits for the block, but not where Python has it left out.
void barrier(const char* file, int line);

}  // namespace emulator

#define threadIdx emulator::thread
#define blockIdx emulator::block

inline float __int_as_float(int x) { return __builtin_bit_cast(float, x); }
inline unsigned __float_as_uint(float x) { return __builtin_bit_cast(unsigned, x); }

#define __syncthreads() emulator::barrier(__FILE__, __LINE__)
inline int __syncthreads_or(int mine) { return (int)emulator::meet(emulator::BLOCK, mine != 0).any; }
inline int __any_sync(unsigned, int mine) { return (int)emulator::meet(emulator::WARP_ANY, mine != 0).any; }
inline float __shfl_xor_sync(unsigned, float mine, int other) {
  const emulator::Met& met = emulator::meet(emulator::WARP_EXCHANGE, __float_as_uint(mine));
  return __int_as_float((int)met.values[(threadIdx.x % 32) ^ other]);
}
inline unsigned __ballot_sync(unsigned, int mine) {
  const emulator::Met& met = emulator::meet(emulator::WARP_BALLOT, mine != 0);
  unsigned bits = 0;
  for (int k = 0; k < 32; k++) bits |= (unsigned)met.values[k] << k;
  return bits;
}
inline void __syncwarp() { emulator::meet(emulator::WARP, 0); }
inline int __ffs(unsigned x) { return __builtin_ffs((int)x); }
inline int __clz(unsigned x) { return x ? __builtin_clz(x) : 32; }
inline unsigned atomicAdd(unsigned* at, unsigned value) { return (*at += value) - value; }
inline unsigned long long atomicAdd(unsigned long long* at, unsigned long long value) { return (*at += value) - value; }
inline unsigned atomicMax(unsigned* at, unsigned value) {
  const unsigned before = *at;
  if (value > before) *at = value;
  return before;
}
inline unsigned atomicSub(unsigned* at, unsigned value) { return (*at -= value) + value; }
inline unsigned long long atomicMin(unsigned long long* at, unsigned long long value) {
  const unsigned long long before = *at;
  if (value < before) *at = value;
  return before;
}
