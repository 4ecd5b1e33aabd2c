// engine.cpp: a batch of views, forward and backward, as one composition of stages. Compiled once per instruction set.
//
// forward:  check, projection, scattering -> lattice -> depth order, parts -> attenuation -> cross-sections -> splatting
// backward: splatting (gather per Gaussian) -> attenuation (back to front) -> adjoint of the projection, views summed over a tree

#define SG_KERNELS
#include "api.h"
#include "bounce.h"
#include "export.h"
#include "inspect.h"
#include "steps.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

int32_t forward(sg_context& c, const sg_problem& p, const sg_outputs* out, int64_t* culprit) {
  const int64_t n = p.gaussians, C = p.channels;
  const Channels channels{p.channels, p.amplitudes, nullptr};
  if (const int32_t status = begin(c, p, kRays | kPixels)) return status;
  const int chunks = chunks_of(n);
  parallel(chunks, [&](int i) {
    const int64_t first = (int64_t)i * kChunk, end = chunk_end(i, n);
    c.faults[i] = check(p, first, end);
    if (c.faults[i].status == SG_OK) project_chunk(c, p, first, end);
  });
  int32_t status = worst(c.faults, chunks, culprit);
  if (!status) status = arrange(c, p, kRays | kPixels, culprit);
  if (status) return status;
  attenuate_rays(c, p, {});
  over_chunks(p, [&](int64_t v, int64_t first, int64_t end) {
    const ViewState& s = c.views[v];
    const Amplitudes amplitudes = channels.of(v, n);
    float *lit_area = out->lit_area + v * n, *sections = out->cross_sections + v * n * C;
    for (int64_t i = first; i < end; i++) {
      PixelEntry& e = s.on_pixels[i];
      const float lit = lit_area_of(s, p, i);
      lit_area[i] = e.lit = lit;
      if (C == 1) sections[i] = e.gamma0 * lit;
      else for (int64_t k = 0; k < C; k++) sections[C * i + k] = amplitudes.of(e, i)[k] * lit;
    }
  });
  return splat_images(c, p, channels, out->images);
}

// From the sums of both planes to a view's share of the gradients.
SG_FN Share share_of(const sg_context& c, const sg_problem& p, const Backward& scratch, int v, int64_t i, int real, const Bodies& bodies,
                     const ViewFrame& frame) {
  const PlaneUnits u = units(p);
  F sums[kFields];
  sums_of(c.views[v], scratch, i, real, sums);
  const Moments<F> rays = moments_of(sums), pixels = moments_of(sums + kSums);
  Share share;
  share.proj = project(bodies.body, frame, u);
  share_of_moments(share.proj, u, rays, pixels, p.peak != 0, share.planes, share.gc, share.gi);
  share.m0 = share.kappa = rays.m0;
  share.harmonics = sums[14] * sums[15];  // dL/dP(u), and the slope of P(u)
  return share;
}

int32_t backward(sg_context& c, const sg_problem& p, const sg_gradients* gradients) {
  const int64_t n = p.gaussians, C = p.channels;
  const sg_gradients& g = *gradients;
  const Channels channels{p.channels, p.amplitudes, nullptr};
  Backward* scratch = c.arena.take<Backward>(p.views);
  float* sections = C > group_of(p.channels) ? c.arena.take<float>(p.views * n * C) : nullptr;
  if (c.arena.failed()) return SG_MEMORY;
  for (int v = 0; v < p.views; v++) {
    scratch[v].sections = sections ? sections + v * n * C : nullptr;
    scratch[v].elevation = nullptr;
  }
  // dL/dsigma to dL/dw and to dL/dP(u)
  ViewState* const views = c.views;
  float* const d_amplitudes = g.amplitudes;
  const float* const d_lit_area = g.lit_area;
  const float cell_area = p.ray[0] * p.ray[1];
  auto unlight = [=](int64_t v, int64_t id, const PixelEntry& e, Eight& sum, const float* d_sections) {
    float along = d_sections[0] * e.gamma0;
    if (C > 1) {
      const float* amplitudes = channels.of(v, n).of(e, id);
      along = 0.0f;
      for (int64_t k = 0; k < C; k++) along += d_sections[k] * amplitudes[k];
    }
    if (d_lit_area) along += d_lit_area[v * n + id];
    views[v].on_rays[id].h = along * cell_area;
    sum[6] = d_sections[0] * e.lit;
    sum[7] = e.slope;
    for (int64_t k = 0; d_amplitudes && k < C; k++) d_amplitudes[(v * n + id) * C + k] = d_sections[k] * e.lit;
  };
  int32_t status = splat_images_backward(c, p, channels, g.images, g.cross_sections, scratch, unlight);
  if (!status) status = attenuate_rays_backward(c, p, g.transmittance, scratch, {}, nullptr);
  if (status) return status;
  return differentiate_all(c, p, g.shift, [&](int64_t first, int64_t end, float* shift_sums) {
    differentiate(p, g, first, end, shift_sums, [&](int v, int64_t i, int real, const Bodies& bodies, const ViewFrame& frame) __attribute__((always_inline)) {
      return share_of(c, p, scratch[v], v, i, real, bodies, frame);
    }, per_depth);
  });
}

// A function of the context and the problem as it stands in the table: on the threads of the pool, and backward with its scratch
// given back.
template <auto function, auto worthwhile = worth_waking, class... Rest> int32_t run(sg_context* c, const sg_problem* p, Rest... rest) {
  int32_t status = SG_OK;
  together(worthwhile(*p), [&] { status = function(*c, *p, rest...); });
  return status;
}
template <auto function, class... Rest> int32_t run_back(sg_context* c, const sg_problem* p, Rest... rest) {
  const int32_t status = run<function>(c, p, rest...);
  c->arena.release(c->kept);
  return status;
}

sg_context* create() { return new sg_context(); }
void destroy(sg_context* c) { delete c; }

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat

#define SG_JOIN_(a, b) a##b
#define SG_JOIN(a, b) SG_JOIN_(a, b)
#define SG_ENTRY(name, structure) name,
extern "C" const sg_engine SG_JOIN(sg_engine_, SG_ISA);
const sg_engine SG_JOIN(sg_engine_, SG_ISA) = {
    SG_TEXT(SG_ISA), create, destroy, run<forward>, run_back<backward>,
    run<project_step, worth_waking_to_project>, run<project_step_backward, worth_waking_to_project>,
    run<attenuate_step>, run_back<attenuate_step_backward>, run<splat_step>, run_back<splat_step_backward>,
    run<bounce>, run_back<bounce_backward>,
    lattice, trace, statistics, SG_OPERATIONS(SG_ENTRY)};
