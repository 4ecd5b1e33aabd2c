// inspect.h: looking into a finished forward pass: where its rays stand, what they met, how full its vectors were.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

void lattice(const sg_context* c, int32_t view, sg_lattice* out) {
  const Strips& s = c->views[view].rays;
  *out = {s.x0, s.y0, s.rows, s.columns};
}

// T_end and the range at which the two-way optical depth reaches `depth`, ray by ray; NaN where it never does
int32_t trace(const sg_context* context, const sg_problem* p, int32_t view, float depth, float* transmittance, float* first_return) {
  const sg_context& c = *context;
  const ViewState& s = c.views[view];
  const Strips& lattice = s.rays;
  const int64_t rays = (int64_t)lattice.rows * lattice.columns;
  for (int b = 0; b < lattice.bands; b++) copy_rows(lattice, b, s.T + lattice.start(b), transmittance);
  float* sum_tau = (float*)std::malloc(sizeof(float) * (rays + 1));
  if (!sum_tau) return SG_MEMORY;
  for (int64_t i = 0; i < rays; i++) { sum_tau[i] = 0.0f; first_return[i] = __builtin_nanf(""); }
  const PlaneUnits u = units(*p);
  const float stop = -__builtin_logf(p->min_transmittance);
  for (int k = 0; k < s.touching; k++) {
    const int32_t id = (int32_t)(uint32_t)s.order[k];
    const Entry& e = s.on_rays[id];
    const int64_t group = id / kWidth * kWidth, lane = id % kWidth;
    const Projection<F> g = project(body(c, group), s.frame, u);
    const Sym2<F> inv = inverse(g.cov_c, g.det_cw);
    const float xz = g.xz[lane] / u.ray[0], yz = g.yz[lane] / u.ray[1];   // the densest point along the ray is linear in d
    const float slope_x = inv.xx[lane] * xz + inv.xy[lane] * yz, slope_y = inv.xy[lane] * xz + inv.yy[lane] * yz;
    for (int y = e.y0; y <= e.y1; y++)
      for (int x = e.x0; x <= e.x1; x++) {
        const float dx = (float)x - e.g.x, dy = (float)y - e.g.y;
        const float q = (dx * e.g.a + dy * e.g.b) * dx + dy * dy * e.g.c;
        const int64_t at = (int64_t)(y - lattice.y0) * lattice.columns + (x - lattice.x0);
        float& d = sum_tau[at];
        if (!(q <= e.g.limit) || d > stop) continue;
        const float before = d;
        d += e.g.depth * kLn2 * __builtin_expf(-q * kLn2);
        if (before < depth && d >= depth) first_return[at] = g.mean[2][lane] + slope_x * dx + slope_y * dy;
      }
  }
  std::free(sum_tau);
  return SG_OK;
}

void statistics(const sg_context* c, const sg_problem* p, sg_statistics* out) {
  *out = {0, 0, 0, 0, kWidth};
  const Lanes lanes;
  for (int v = 0; v < p->views; v++) {
    const ViewState& s = c->views[v];
    for (int b = 0; b < s.rays.bands; b++) {
      const int32_t* ids = s.ray_lists.ids + s.ray_lists.first[b];
      for (int k = 0; k < s.ray_lists.first[b + 1] - s.ray_lists.first[b]; k++)
        for_blocks(s.on_rays[ids[k]], s.rays, b, lanes, [&](const Offset<F>& d, F limit, int64_t at) {
          out->blocks_attenuation++;
          out->live_attenuation += __builtin_popcount(bits((d.q <= limit) & (load_anywhere(s.stop + s.rays.start(b) + at) >= k)));
        });
    }
    for (int b = 0; b < s.pixels.bands; b++)
      for (int k = s.pixel_lists.first[b]; k < s.pixel_lists.first[b + 1]; k++)
        if (s.weight[s.pixel_lists.ids[k]] != 0.0f)
          for_blocks(s.on_pixels[s.pixel_lists.ids[k]], s.pixels, b, lanes, [&](const Offset<F>& d, F limit, int64_t) {
            out->blocks_imaging++;
            out->live_imaging += __builtin_popcount(bits(d.q <= limit));
          });
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
