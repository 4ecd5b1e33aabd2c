// bounce.h: a second pass of the views along another way, from where the rays of the first one end: the echo by way of the
// ground, of which a problem's frames are those of the mirror image. It is projected onto rays by these, and onto images by
// frames of their own; what returns is lit along both ways, over factor * sqrt(lit first * lit now).
//
// The stages are those of a rendering (engine.cpp); there is one channel.
#pragma once
#include "differentiate.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

ViewFrame image_frame_of(const sg_bounce& b, int v) {
  ViewFrame f;
  for (int k = 0; k < 9; k++) f.r[k] = b.image_frames[9 * v + k];
  return f;
}

// As project_chunk.
void project_bounce_chunk(const sg_context& c, const sg_problem& p, const sg_bounce& b, int64_t first, int64_t end) {
  const PlaneUnits u = units(p);
  const Cuts cuts = cuts_of(p);
  const F zero = splat(0.0f);
  const F nothing[2] = {zero, zero};  // nobody asks where first returns are
  for (int v = 0; v < p.views; v++) unbounded(c.views[v], first);
  project_all(p, first, end, [&](int v, int64_t i, int real, const Bodies& bodies, const Projection<F>& g, const Softplus<F>& gamma0) {
    const ViewState& s = c.views[v];
    const float *offset = b.offset + 2 * v, *shift = p.shift + 2 * v;
    const Placed<F> on_rays{(g.mean[0] + offset[0]) * (1.0f / u.ray[0]), (g.mean[1] + offset[1]) * (1.0f / u.ray[1]),
                            whitening(g.cov_c, g.det_cw), root(g.cov_c.xx), root(g.cov_c.yy)};
    place_on_rays(s, p, cuts, on_rays, bodies.kappa * widening_ratio(g, u), g.mean[2], nothing, i, real, s.bounds[first / kChunk]);

    const Projection<F> shown = project(bodies.body, image_frame_of(b, v), u);
    const Placed<F> on_pixels{pixel_x(p, shown.mean[0] + shift[0]), pixel_y(p, shown.mean[2] + shift[1]),
                              whitening(shown.cov_i, shown.det_iw), root(shown.cov_i.xx), root(shown.cov_i.yy)};
    const F norm = cuts.lost / (6.2831853f * p.pixel[0] * p.pixel[1] * root(shown.det_iw));
    place_on_pixels(s, p, cuts, on_pixels, norm, gamma0.value, zero, gamma0.slope, {zero, zero}, i, real);
  });
}

int32_t bounce(sg_context& c, const sg_problem& p, const sg_bounce* b, float* images, int64_t* culprit) {
  const int64_t n = p.gaussians;
  if (const int32_t status = begin(c, p, kRays | kPixels)) return status;
  const int chunks = chunks_of(n);
  parallel(chunks, [&](int i) {
    const int64_t first = (int64_t)i * kChunk, end = chunk_end(i, n);
    c.faults[i] = check(p, first, end);
    if (c.faults[i].status == SG_OK) project_bounce_chunk(c, p, *b, first, end);
  });
  int32_t status = worst(c.faults, chunks, culprit);
  if (!status) status = arrange(c, p, kRays | kPixels, culprit);
  if (status) return status;
  attenuate_rays(c, p, {b->transmittance, b->lattices});
  over_chunks(p, [&](int64_t v, int64_t first, int64_t end) {
    const ViewState& s = c.views[v];
    for (int64_t i = first; i < end; i++)
      s.on_pixels[i].lit = b->factor * __builtin_sqrtf(b->lit_area[v * n + i] * lit_area_of(s, p, i));
  });
  return splat_images(c, p, {1, p.amplitudes, nullptr}, images);
}

struct BounceShare : Share { Projection<F> shown; };

// d_transmittance, d_lit_area: out, of those in b
int32_t bounce_backward(sg_context& c, const sg_problem& p, const sg_bounce* b, const sg_gradients* gradients, float* d_transmittance,
                        float* d_lit_area) {
  const int64_t n = p.gaussians;
  const sg_gradients& g = *gradients;
  Backward* scratch = c.arena.take<Backward>(p.views);
  if (c.arena.failed()) return SG_MEMORY;
  for (int v = 0; v < p.views; v++) scratch[v].sections = scratch[v].elevation = nullptr;
  ViewState* const views = c.views;
  // dL/dsigma to dL/dw, to dL/d(lit first) and to dL/dP(u)
  auto unlight = [=, &p](int64_t v, int64_t id, const PixelEntry& e, Eight& sum, const float* d_section) {
    const int64_t at = v * n + id;
    const float along = d_section[0] * e.gamma0 * e.lit * 0.5f;  // the slope of a root is infinite at nothing, and taken as 0
    views[v].on_rays[id].h = e.lit > 0.0f ? along / lit_area_of(views[v], p, id) * (p.ray[0] * p.ray[1]) : 0.0f;
    d_lit_area[at] = e.lit > 0.0f ? along / b->lit_area[at] : 0.0f;
    sum[6] = d_section[0] * e.lit;
    sum[7] = e.slope;
    if (g.amplitudes) g.amplitudes[at] = d_section[0] * e.lit;
  };
  int32_t status = splat_images_backward(c, p, {1, p.amplitudes, nullptr}, g.images, nullptr, scratch, unlight);
  if (!status) status = attenuate_rays_backward(c, p, nullptr, scratch, {b->transmittance, b->lattices}, d_transmittance);
  if (status) return status;
  const PlaneUnits u = units(p);
  const Sym2<F> none{splat(0.0f), splat(0.0f), splat(0.0f)};
  auto share_of = [&](int v, int64_t i, int real, const Bodies& bodies, const ViewFrame& frame) {
    BounceShare share;
    F sums[kFields], on_image[4];
    Sym2<F> unused;
    sums_of(views[v], scratch[v], i, real, sums);
    const Moments<F> rays = moments_of(sums), pixels = moments_of(sums + kSums);
    share.proj = project(bodies.body, frame, u);
    share.shown = project(bodies.body, image_frame_of(*b, v), u);
    share_of_moments(share.proj, u, rays, pixels, false, share.planes, share.gc, unused);
    share_of_moments(share.shown, u, rays, pixels, false, on_image, unused, share.gi);
    share.planes[2] = on_image[2];
    share.planes[3] = on_image[3];
    share.m0 = share.kappa = rays.m0;
    share.harmonics = sums[14] * sums[15];
    return share;
  };
  auto spread_both = [&](const BounceShare& share, int v, const ViewFrame& frame, BodyGradient<F>& own) {
    const F zero = splat(0.0f), on_rays[4] = {share.planes[0], share.planes[1], zero, zero};
    const F on_image[4] = {zero, zero, share.planes[2], share.planes[3]};
    spread(share.proj, frame, u, on_rays, share.gc, none, share.m0, own);
    spread(share.shown, image_frame_of(*b, v), u, on_image, none, share.gi, zero, own);
  };
  return differentiate_all(c, p, g.shift, [&](int64_t first, int64_t end, float* shift_sums) {
    differentiate(p, g, first, end, shift_sums, share_of, per_depth, spread_both);
  });
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
