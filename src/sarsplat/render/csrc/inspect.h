// inspect.h: looking into a finished forward pass: where its rays stand, what they met, how full its vectors were.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

void lattice(const sg_context* c, int32_t view, sg_lattice* out) {
  const ViewState& s = c->views[view];
  *out = {s.k0x, s.k0y, s.ray_rows, s.ray_columns};
}

// T_end and the range at which the two-way optical depth reaches `depth`, ray by ray; NaN where it never does
int32_t trace(const sg_context* context, const sg_problem* p, int32_t view, float depth, float* transmittance, float* first_return) {
  const sg_context& c = *context;
  const ViewState& s = c.views[view];
  const int64_t rays = (int64_t)s.ray_rows * s.ray_columns;
  from_blocks(s.T, s.ray_bx, s.ray_rows, s.ray_columns, 0, s.ray_rows, transmittance);
  float* sum_tau = (float*)std::malloc(sizeof(float) * (rays + 1));
  if (!sum_tau) return SG_MEMORY;
  for (int64_t i = 0; i < rays; i++) { sum_tau[i] = 0.0f; first_return[i] = __builtin_nanf(""); }
  const PlaneUnits u = units(*p);
  const float stop = -__builtin_logf(p->min_transmittance);
  for (int k = 0; k < s.touching; k++) {
    const Entry& e = s.on_rays[k];
    const int64_t group = e.id / kWidth * kWidth, lane = e.id % kWidth;
    const Projection<F> g = project(body(c, group), s.frame, u);
    const Sym2<F> inv = inverse(g.cov_c, g.det_cw);
    const float xz = g.xz[lane] / u.ray[0], yz = g.yz[lane] / u.ray[1];   // the densest point along the ray is linear in d
    const float slope_x = inv.xx[lane] * xz + inv.xy[lane] * yz, slope_y = inv.xy[lane] * xz + inv.yy[lane] * yz;
    const int y1 = least((e.y1 + 1) * kBlockY, s.ray_rows), x1 = least((e.x1 + 1) * kBlockX, s.ray_columns);
    for (int y = e.y0 * kBlockY; y < y1; y++)
      for (int x = e.x0 * kBlockX; x < x1; x++) {
        const float dx = (float)x - e.g.x, dy = (float)y - e.g.y;
        const float q = (dx * e.g.a + dy * e.g.b) * dx + dy * dy * e.g.c;
        float& d = sum_tau[(int64_t)y * s.ray_columns + x];
        if (!(q <= e.g.limit) || d > stop) continue;
        const float before = d;
        d += e.g.depth * kLn2 * __builtin_expf(-q * kLn2);
        if (before < depth && d >= depth)
          first_return[(int64_t)y * s.ray_columns + x] = g.mean[2][lane] + slope_x * dx + slope_y * dy;
      }
  }
  std::free(sum_tau);
  return SG_OK;
}

void statistics(const sg_context* c, const sg_problem* p, sg_statistics* out) {
  *out = {0, 0, 0, 0, kWidth};
  const Lanes lanes;
  const int image_bx = blocks(p->columns, kBlockX), image_by = blocks(p->rows, kBlockY);
  for (int v = 0; v < p->views; v++) {
    const ViewState& s = c->views[v];
    for (int k = 0; k < s.touching; k++)
      for_blocks(s.on_rays[k], {0, s.ray_by}, s.ray_bx, lanes, [&](const Offset<F>& d, int64_t at) {
        out->blocks_attenuation++;
        out->live_attenuation += __builtin_popcount(bits((d.q <= s.on_rays[k].g.limit) & (load(s.last + at) >= k)));
      });
    for (int64_t k = 0; k < p->gaussians; k++)
      for_blocks(s.on_pixels[k], {0, image_by}, image_bx, lanes, [&](const Offset<F>& d, int64_t) {
        out->blocks_imaging++;
        out->live_imaging += __builtin_popcount(bits(d.q <= s.on_pixels[k].g.limit));
      });
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
