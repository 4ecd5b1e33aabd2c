// simd.h: the vector type of one instruction set. Clang's vector extension carries the arithmetic, so that this is the
// same source for SSE2, AVX2, AVX-512 and NEON; SG_WIDTH lanes are one block of 4 x SG_WIDTH/4 rays or pixels.
#pragma once
#include <cstdint>

#define SG_FN inline __attribute__((always_inline))

namespace sarsplat {
namespace SG_ISA {

constexpr int kWidth = SG_WIDTH;
typedef float F __attribute__((ext_vector_type(SG_WIDTH)));
typedef int32_t I __attribute__((ext_vector_type(SG_WIDTH)));
typedef bool Bits __attribute__((ext_vector_type(SG_WIDTH)));

SG_FN F splat(float x) { return (F)(x); }
SG_FN F load(const float* p) { return *(const F*)p; }
SG_FN void store(float* p, F x) { *(F*)p = x; }
SG_FN I load(const int32_t* p) { return *(const I*)p; }
SG_FN void store(int32_t* p, I x) { *(I*)p = x; }
SG_FN F choose(I mask, F a, F b) { return mask ? a : b; }
SG_FN I choose(I mask, I a, I b) { return mask ? a : b; }
SG_FN float root(float x) { return __builtin_sqrtf(x); }
SG_FN F root(F x) { return __builtin_elementwise_sqrt(x); }
SG_FN F absolute(F x) { return __builtin_elementwise_abs(x); }
SG_FN F larger(F a, F b) { return __builtin_elementwise_max(a, b); }
SG_FN F smaller(F a, F b) { return __builtin_elementwise_min(a, b); }
SG_FN I larger(I a, I b) { return __builtin_elementwise_max(a, b); }
SG_FN I smaller(I a, I b) { return __builtin_elementwise_min(a, b); }
SG_FN int larger(int a, int b) { return a > b ? a : b; }
SG_FN int smaller(int a, int b) { return a < b ? a : b; }
SG_FN F up(F x) { return __builtin_elementwise_ceil(x); }
SG_FN F down(F x) { return __builtin_elementwise_floor(x); }
SG_FN F nearest(F x) { return (x + 12582912.0f) - 12582912.0f; }  // whole number; |x| < 2^22

// at any address, not only at multiples of the vector
SG_FN F load_anywhere(const float* p) { F x; __builtin_memcpy(&x, p, sizeof(x)); return x; }
SG_FN I load_anywhere(const int32_t* p) { I x; __builtin_memcpy(&x, p, sizeof(x)); return x; }
SG_FN void store_anywhere(float* p, F x) { __builtin_memcpy(p, &x, sizeof(x)); }
SG_FN void store_anywhere(int32_t* p, I x) { __builtin_memcpy(p, &x, sizeof(x)); }

// rows become columns: a perfect shuffle, as often as it takes
SG_FN void transpose(F (&m)[kWidth]) {
  for (int step = 1; step < kWidth; step *= 2) {
    F next[kWidth];
    for (int i = 0; i < kWidth / 2; i++) {
      const F a = m[i], b = m[i + kWidth / 2];
#if SG_WIDTH == 16
      next[2 * i] = __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
      next[2 * i + 1] = __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
#elif SG_WIDTH == 8
      next[2 * i] = __builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11);
      next[2 * i + 1] = __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15);
#else
      next[2 * i] = __builtin_shufflevector(a, b, 0, 4, 1, 5);
      next[2 * i + 1] = __builtin_shufflevector(a, b, 2, 6, 3, 7);
#endif
    }
    for (int i = 0; i < kWidth; i++) m[i] = next[i];
  }
}

#if SG_WIDTH == 16
typedef uint16_t BitWord;
#else
typedef uint8_t BitWord;
#endif
SG_FN unsigned bits(I mask) {
#if SG_WIDTH >= 8
  return __builtin_bit_cast(BitWord, __builtin_convertvector(mask, Bits));
#else
  return (mask[0] & 1) | (mask[1] & 2) | (mask[2] & 4) | (mask[3] & 8);
#endif
}
SG_FN bool any(I mask) { return bits(mask) != 0; }

typedef float Eight __attribute__((ext_vector_type(8)));
SG_FN Eight load_eight(const float* p) { Eight x; __builtin_memcpy(&x, p, sizeof(x)); return x; }
SG_FN void store_eight(float* p, Eight x) { __builtin_memcpy(p, &x, sizeof(x)); }
#if SG_WIDTH == 16
SG_FN Eight fold(F x) { return x.lo + x.hi; }
#elif SG_WIDTH == 8
SG_FN Eight fold(F x) { return x; }
#endif

// sums over the lanes of six vectors at once, in a fixed order; the last two numbers mean nothing
SG_FN Eight sum6(F a, F b, F c, F d, F e, F f) {
#if SG_WIDTH >= 8
  const Eight A = fold(a), B = fold(b), C = fold(c), D = fold(d), E = fold(e), G = fold(f);
#define SG_LOW(x, y) __builtin_shufflevector(x, y, 0, 8, 1, 9, 4, 12, 5, 13)
#define SG_HIGH(x, y) __builtin_shufflevector(x, y, 2, 10, 3, 11, 6, 14, 7, 15)
  const Eight ab = SG_LOW(A, B) + SG_HIGH(A, B), cd = SG_LOW(C, D) + SG_HIGH(C, D), ef = SG_LOW(E, G) + SG_HIGH(E, G);
#undef SG_LOW
#undef SG_HIGH
  const Eight abcd = __builtin_shufflevector(ab, cd, 0, 1, 8, 9, 4, 5, 12, 13) + __builtin_shufflevector(ab, cd, 2, 3, 10, 11, 6, 7, 14, 15);
  const Eight efef = ef + __builtin_shufflevector(ef, ef, 2, 3, 0, 1, 6, 7, 4, 5);
  const auto four = abcd.lo + abcd.hi, two = efef.lo + efef.hi;
  return __builtin_shufflevector(four, two, 0, 1, 2, 3, 4, 5, 6, 7);
#else
  Eight sums = (Eight)(0.0f);
  const F all[6] = {a, b, c, d, e, f};
  for (int k = 0; k < 6; k++) sums[k] = (all[k].x + all[k].z) + (all[k].y + all[k].w);
  return sums;
#endif
}
SG_FN float sum(F x) {
#if SG_WIDTH == 16
  const Eight h = fold(x);
  const auto q = h.lo + h.hi;
#elif SG_WIDTH == 8
  const auto q = x.lo + x.hi;
#else
  const F q = x;
#endif
  return (q.x + q.z) + (q.y + q.w);
}

// 2^x = scale * (1 + fraction): one polynomial serves 2^x and 2^x - 1 without cancellation. |x| < 126; relative errors of
// 2^x below 2e-7, of 2^x - 1 below 1e-6: the pair loops spend half their operations here, so there is no term more.
struct Power2 { F scale, fraction; };
SG_FN Power2 power2_parts(F x) {
  const float magic = 12582912.0f + 127.0f;  // 1.5 * 2^23: the nearest integer, and the bias of exponents, now sit in the low bits
  const F shifted = x + magic, f = x - (shifted - magic);
  F p = f * 1.3264727e-3f + 9.6715130e-3f;
  p = p * f + 5.5507336e-2f;
  p = p * f + 2.4022242e-1f;
  p = p * f + 6.9314700e-1f;
  return {__builtin_bit_cast(F, __builtin_bit_cast(I, shifted) << 23), p * f};
}
SG_FN F power2(F x) { const Power2 e = power2_parts(x); return e.scale * e.fraction + e.scale; }
SG_FN F power2(Power2 e) { return e.scale * e.fraction + e.scale; }
SG_FN F power2_minus_one(Power2 e) { return e.scale * e.fraction + (e.scale - 1.0f); }

// natural logarithm of normal positive numbers, relative error about 1e-7
SG_FN F natural_log(F x) {
  const I raw = __builtin_bit_cast(I, x);
  const I exponent = (raw - 0x3f3504f3) >> 23;  // mantissa in [sqrt 1/2, sqrt 2)
  const F m = __builtin_bit_cast(F, raw - (exponent << 23)) - 1.0f;
  const F s = m / (m + 2.0f), s2 = s * s;
  const F series = s * s2 * (0.66666667f + s2 * (0.4f + s2 * (0.28571429f + s2 * 0.22222222f)));
  return __builtin_convertvector(exponent, F) * 0.69314718f + (2.0f * s + series);
}

}  // namespace SG_ISA
}  // namespace sarsplat
