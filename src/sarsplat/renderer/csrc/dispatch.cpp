// dispatch.cpp: which instruction sets the processor *and* the system support, and the engines that were compiled for them.
#include "api.h"
#include "export.h"

// What was compiled with it, as build_engine.py says: SG_SETS is SET(1, base) SET(2, avx2) SET(3, avx512), or some of them.
#define SET(isa, name) extern "C" const sg_engine sg_engine_##name;
SG_SETS
#undef SET
#define SET(isa, name) case isa: return &sg_engine_##name;
static const sg_engine* engine(int isa) {
  switch (isa) { SG_SETS }
  return nullptr;
}

#if defined(__x86_64__)
#include <cpuid.h>

static int find_supported() {  // 1 base, 2 AVX2 + FMA, 3 AVX-512 F/BW/DQ/VL
  unsigned a, b, c, d;
  if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & (1u << 27)) || !(c & (1u << 12))) return 1;  // OSXSAVE, FMA
  unsigned low, high;
  __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  if ((low & 6) != 6 || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return 1;
  if (!(b & (1u << 5)) || !(b & (1u << 8)) || !(b & (1u << 3))) return 1;                    // AVX2, BMI2, BMI1
  const unsigned wanted = (1u << 16) | (1u << 17) | (1u << 28) | (1u << 30) | (1u << 31);
  return (low & 0xE6) == 0xE6 && (b & wanted) == wanted ? 3 : 2;
}
#else
static int find_supported() { return 1; }
#endif

static const int supported = find_supported();  // asked once: in a virtual machine cpuid costs tens of microseconds

// A digest of the api.h that this was compiled with, as build_engine.py says.
SG_EXPORT const char* sg_api() { return SG_TEXT(SG_API); }
SG_EXPORT int32_t sg_supported_isa() { return supported; }
SG_EXPORT const sg_engine* sg_engine_for(int32_t isa) { return engine(isa); }  // null where it was not compiled
