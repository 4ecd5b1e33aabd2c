// dispatch.cpp: which instruction sets the processor *and* the system support and which were compiled; calls go to the one that
// was asked for.
#include <cstring>

#include "api.h"
#include "export.h"

// What was compiled with it, as build_engine.py says: SG_SETS is SET(1, base) SET(2, avx2) SET(3, avx512), or some of them.
#define SET(isa, name) extern "C" const sg_engine sg_engine_##name;
SG_SETS
#undef SET
#define SET(isa, name) case isa: return &sg_engine_##name;
static const sg_engine* engine(int isa) {  // null where it was not compiled
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

struct sg_handle { const sg_engine* engine; sg_context* context; };

// Who asks for one, below, has asked these: it has a name, and is at most what is supported.
SG_EXPORT int32_t sg_supported_isa() { return supported; }
SG_EXPORT const char* sg_isa_name(int32_t isa) { return engine(isa) ? engine(isa)->name : nullptr; }
SG_EXPORT sg_handle* sg_create(int32_t isa) {
  const sg_engine* e = engine(isa);
  return new sg_handle{e, e->create()};
}
SG_EXPORT void sg_destroy(sg_handle* h) {
  h->engine->destroy(h->context);
  delete h;
}
SG_EXPORT int32_t sg_render(sg_handle* h, const sg_problem* p, const sg_outputs* out, int64_t* culprit) {
  return h->engine->forward(h->context, p, out, culprit);
}
SG_EXPORT int32_t sg_render_backward(sg_handle* h, const sg_problem* p, const sg_gradients* g) {
  return h->engine->backward(h->context, p, g);
}
SG_EXPORT void sg_get_lattice(const sg_handle* h, int32_t view, sg_lattice* out) { h->engine->lattice(h->context, view, out); }
SG_EXPORT int32_t sg_trace(const sg_handle* h, const sg_problem* p, int32_t view, float depth, float* transmittance, float* first_return) {
  return h->engine->trace(h->context, p, view, depth, transmittance, first_return);
}
SG_EXPORT int32_t sg_amplitude_loss(sg_handle* h, const sg_loss* loss) { return h->engine->amplitude_loss(h->context, loss); }
SG_EXPORT int32_t sg_stack_likelihood(sg_handle* h, const sg_likelihood* l) { return h->engine->stack_likelihood(h->context, l); }
SG_EXPORT void sg_pair_sections(const sg_handle* h, const sg_sections* s) { h->engine->pair_sections(s); }
SG_EXPORT void sg_pair_sections_backward(const sg_handle* h, const sg_sections* s) { h->engine->pair_sections_backward(s); }
SG_EXPORT void sg_normal_lobes(const sg_handle* h, const sg_lobes* l) { h->engine->normal_lobes(l); }
SG_EXPORT void sg_normal_lobes_backward(const sg_handle* h, const sg_lobes* l) { h->engine->normal_lobes_backward(l); }
SG_EXPORT int32_t sg_lit_ground(sg_handle* h, const sg_ground* ground) { return h->engine->lit_ground(h->context, ground); }
SG_EXPORT int32_t sg_lit_terrain(sg_handle* h, const sg_terrain* terrain) { return h->engine->lit_terrain(h->context, terrain); }
SG_EXPORT void sg_adam(int32_t isa, const sg_adam_step* step) { engine(isa)->adam(step); }
SG_EXPORT int32_t sg_project(sg_handle* h, const sg_problem* p, const sg_projection* out, int64_t* culprit) {
  return h->engine->project(h->context, p, out, culprit);
}
SG_EXPORT int32_t sg_project_backward(sg_handle* h, const sg_problem* p, const sg_projection* seeds, const sg_gradients* g) {
  return h->engine->project_backward(h->context, p, seeds, g);
}
SG_EXPORT int32_t sg_attenuate(sg_handle* h, const sg_problem* p, const sg_projection* in, float* lit_area, int64_t* culprit) {
  return h->engine->attenuate(h->context, p, in, lit_area, culprit);
}
SG_EXPORT int32_t sg_attenuate_backward(sg_handle* h, const sg_problem* p, const float* d_lit_area, const float* d_transmittance, const sg_projection* out) {
  return h->engine->attenuate_backward(h->context, p, d_lit_area, d_transmittance, out);
}
SG_EXPORT int32_t sg_splat(sg_handle* h, const sg_problem* p, const sg_projection* in, const sg_channels* a, float* images, int64_t* culprit) {
  return h->engine->splat(h->context, p, in, a, images, culprit);
}
SG_EXPORT int32_t sg_splat_backward(sg_handle* h, const sg_problem* p, const sg_channels* a, const float* d_images, const sg_projection* out, float* d_cross_sections, float* d_elevation) {
  return h->engine->splat_backward(h->context, p, a, d_images, out, d_cross_sections, d_elevation);
}
SG_EXPORT void sg_get_statistics(const sg_handle* h, const sg_problem* p, sg_statistics* out) { h->engine->statistics(h->context, p, out); }
