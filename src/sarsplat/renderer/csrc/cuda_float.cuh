// cuda_float.cuh: what the shared mathematics asks of its number type, for one float a thread, and sums over a warp.
#pragma once
#include <cstdint>

#define SG_FN __device__ __forceinline__
#define SG_ISA cuda

namespace sarsplat {
namespace SG_ISA {

SG_FN float splat(float x) { return x; }
SG_FN float choose(bool condition, float a, float b) { return condition ? a : b; }
SG_FN float root(float x) { return sqrtf(x); }
SG_FN float absolute(float x) { return fabsf(x); }
SG_FN float larger(float a, float b) { return fmaxf(a, b); }
SG_FN float smaller(float a, float b) { return fminf(a, b); }
SG_FN float nearest(float x) { return rintf(x); }
SG_FN float natural_log(float x) { return logf(x); }

// 2^x = scale * (1 + fraction): one polynomial serves 2^x and 2^x - 1 without cancellation. |x| < 126.
struct Power2 { float scale, fraction; };
SG_FN Power2 power2_parts(float x) {
  const float n = rintf(x), f = x - n;
  float p = f * 1.5403530e-4f + 1.3333558e-3f;
  p = p * f + 9.6181291e-3f;
  p = p * f + 5.5504109e-2f;
  p = p * f + 2.4022651e-1f;
  p = p * f + 6.9314718e-1f;
  return {__int_as_float(((int)n + 127) << 23), p * f};
}
SG_FN float power2(float x) { return exp2f(x); }
SG_FN float power2(Power2 e) { return e.scale * e.fraction + e.scale; }
SG_FN float power2_minus_one(Power2 e) { return e.scale * e.fraction + (e.scale - 1.0f); }

constexpr unsigned kWholeWarp = 0xffffffffu;
constexpr int kWarp = 32;

SG_FN float warp_sum(float x) {
  for (int step = kWarp / 2; step > 0; step /= 2) x += __shfl_xor_sync(kWholeWarp, x, step);
  return x;
}
SG_FN float warp_min(float x) {
  for (int step = kWarp / 2; step > 0; step /= 2) x = fminf(x, __shfl_xor_sync(kWholeWarp, x, step));
  return x;
}

// Six sums over a warp with 8 exchanges instead of 30: lanes give away what others add up. Lane 0 holds a, 4 b, 8 c,
// 16 d, 20 e, 24 f; sixth_of tells a lane which sum it holds, -1 for none.
SG_FN float sum6(float a, float b, float c, float d, float e, float f, int lane) {
  const bool upper = lane & 16, middle = lane & 8, lower = lane & 4;
  const float k0 = (upper ? d : a) + __shfl_xor_sync(kWholeWarp, upper ? a : d, 16);
  const float k1 = (upper ? e : b) + __shfl_xor_sync(kWholeWarp, upper ? b : e, 16);
  const float k2 = (upper ? f : c) + __shfl_xor_sync(kWholeWarp, upper ? c : f, 16);
  const float even = (middle ? k2 : k0) + __shfl_xor_sync(kWholeWarp, middle ? k0 : k2, 8);
  const float odd = k1 + __shfl_xor_sync(kWholeWarp, k1, 8);
  float sum = (lower ? odd : even) + __shfl_xor_sync(kWholeWarp, lower ? even : odd, 4);
  sum += __shfl_xor_sync(kWholeWarp, sum, 2);
  return sum + __shfl_xor_sync(kWholeWarp, sum, 1);
}
SG_FN int sixth_of(int lane) {
  if (lane % 4 || lane % 16 == 12) return -1;
  return lane / 16 * 3 + lane % 16 / 4;
}

}  // namespace SG_ISA
}  // namespace sarsplat
