// tail.h: the end of an array whose length is no multiple of the vector.
#pragma once
#include "simd.h"

namespace sarsplat {
namespace SG_ISA {

// as many of the vector's numbers as there are; the others are read as zero
SG_FN F load_some(const float* p, int64_t count) {
  if (count >= kWidth) return load_anywhere(p);
  F x = splat(0.0f);
  if (count > 0) __builtin_memcpy(&x, p, sizeof(float) * count);
  return x;
}
SG_FN void store_some(float* p, F x, int64_t count) {
  if (count >= kWidth) return store_anywhere(p, x);
  if (count > 0) __builtin_memcpy(p, &x, sizeof(float) * count);
}

}  // namespace SG_ISA
}  // namespace sarsplat
