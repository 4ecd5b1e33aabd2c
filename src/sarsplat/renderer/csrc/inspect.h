// inspect.h: looking into a finished forward pass: where its rays stand, what they met, how full its vectors were.
#pragma once
#include "parallel.h"
#include "project.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

void lattice(const sg_context* c, int32_t view, sg_lattice* out) {
  const Strips& s = c->views[view].rays;
  *out = {s.x0, s.y0, s.rows, s.columns};
}

constexpr int kTraced = 64;  // rows of rays of a task

// One row of rays in strips to a row of numbers.
void read_row(const Strips& s, int y, const float* strips, float* row) {
  for (int x = 0; x < s.columns; x += kBlockX)
    std::memcpy(row + x, strips + s.at(s.x0 + x, y), sizeof(float) * smaller(kBlockX, s.columns - x));
}

// T_end and, unless null, the range at which the two-way optical depth reaches `depth`, ray by ray; NaN where it never does
int32_t trace(const sg_context* c, const sg_problem* p, int32_t view, float depth, float* transmittance, float* first_return) {
  const ViewState& s = c->views[view];
  const Strips& lattice = s.rays;
  const int64_t rays = (int64_t)lattice.rows * lattice.columns;
  for (int b = 0; b < s.ray_parts; b++) {
    const Part& band = s.ray_bands[b];
    for (int y = band.strips.y0; y < band.strips.y0 + band.strips.rows; y++)
      read_row(band.strips, y, s.T + band.start, transmittance + (int64_t)(y - lattice.y0) * lattice.columns);
  }
  if (!first_return) return SG_OK;
  float* sum_tau = (float*)std::malloc(sizeof(float) * (rays + 1));
  if (!sum_tau) return SG_MEMORY;
  for (int64_t i = 0; i < rays; i++) { sum_tau[i] = 0.0f; first_return[i] = __builtin_nanf(""); }
  const float stop = -__builtin_logf(p->min_transmittance), faintest = min_log_tau(*p);
  parallel((lattice.rows + kTraced - 1) / kTraced, [&](int task) {  // a task's rows are nobody else's
    const int first = lattice.y0 + task * kTraced, last = smaller(first + kTraced, lattice.y0 + lattice.rows) - 1;
    for (int k = 0; k < s.touching; k++) {
      const int32_t id = s.front_to_back[k];
      const RayEntry& e = s.on_rays[id];
      if (e.y1 < first || e.y0 > last) continue;
      const float range = from_ordered(s.depth_keys[id]);
      for (int y = larger(e.y0, first); y <= smaller(e.y1, last); y++)
        for (int x = e.x0; x <= e.x1; x++) {
          const int64_t at = (int64_t)(y - lattice.y0) * lattice.columns + (x - lattice.x0);
          float& d = sum_tau[at];
          if (d > stop) continue;
          const float dx = (float)x - e.g.x, dy = (float)y - e.g.y;
          const float log_tau = log_depth(e.g, offset(e.g, (float)x, (float)y));
          if (!(log_tau >= faintest)) continue;
          const float before = d;
          d += kLn2 * __builtin_exp2f(log_tau);
          if (before < depth && d >= depth) first_return[at] = range + e.slope[0] * dx + e.slope[1] * dy;
        }
    }
  });
  std::free(sum_tau);
  return SG_OK;
}

void statistics(const sg_context* c, const sg_problem* p, sg_statistics* out) {
  *out = {0, 0, 0, 0, kWidth};
  for (int v = 0; v < p->views; v++) {
    const ViewState& s = c->views[v];
    for (int b = 0; b < s.ray_parts; b++) {
      const Part& band = s.ray_bands[b];
      for (int k = 0; k < band.count(); k++) {
        const Entry& e = s.on_rays[s.ray_list[band.first + k]];
        for_blocks(e, band.strips, [&](const Offset<F>& d, int64_t at) {
          out->blocks_attenuation++;
          const I followed = load_anywhere(s.stop + band.start + at) >= k;
          out->live_attenuation += __builtin_popcount(bits((log_depth(e.g, d) >= min_log_tau(*p)) & followed));
        });
      }
    }
    for (int64_t i = 0; i < p->gaussians; i++)
      if (s.on_pixels[i].lit != 0.0f)
        for_blocks(s.on_pixels[i], c->image, [&](const Offset<F>& d, int64_t) {
          out->blocks_imaging++;
          out->live_imaging += __builtin_popcount(bits(distance(d) <= image_cut(*p)));
        });
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
