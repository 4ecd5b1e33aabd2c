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

// One row of rays in strips to a row of numbers.
void read_row(const Strips& s, int y, const float* strips, float* row) {
  for (int x = 0; x < s.columns; x += kBlockX)
    std::memcpy(row + x, strips + s.at(s.x0 + x, y), sizeof(float) * smaller(kBlockX, s.columns - x));
}

// The ranges at which the rays of a band reach the two-way optical depth `depth`, in strips; NaN where they never do.
// sum_tau: as large.
void first_returns(const ViewState& s, const Part& band, const sg_problem& p, float depth, float* sum_tau, float* first) {
  const float stop = -__builtin_logf(p.min_transmittance), faintest = min_log_tau(p);
  for (int64_t i = 0; i < band.strips.size(); i++) { sum_tau[i] = 0.0f; first[i] = __builtin_nanf(""); }
  for (int k = band.first; k < band.end; k++) {
    const int32_t id = s.ray_list[k];
    __builtin_prefetch(s.on_rays + s.ray_list[smaller(k + kAhead, band.end - 1)]);
    const RayEntry& e = s.on_rays[id];
    const float range = from_ordered(s.depth_keys[id]);
    const float along_u = e.slope[0] / e.g.ux, along_v = (e.slope[1] - along_u * e.g.uy) / e.g.vy;
    for_blocks(e, band.strips, [&](const Offset<F>& d, int64_t at) {
      const F log_tau = log_depth(e.g, d), before = load_anywhere(sum_tau + at);
      const I live = (log_tau >= faintest) & (before <= stop);
      const F after = before + choose(live, kLn2 * power2(log_tau), splat(0.0f));
      store_anywhere(sum_tau + at, after);
      const I reached = (before < depth) & (after >= depth);
      if (any(reached)) store_anywhere(first + at, choose(reached, along_u * d.u + along_v * d.v + range, load_anywhere(first + at)));
    });
  }
}

// T_end and, unless null, the range at which the two-way optical depth reaches `depth`, ray by ray; NaN where it never does
int32_t trace(const sg_context* c, const sg_problem* p, int32_t view, float depth, float* transmittance, float* first_return) {
  const ViewState& s = c->views[view];
  bool failed = false;
  parallel(s.ray_parts, [&](int b) {
    const Part& band = s.ray_bands[b];
    const int64_t size = band.strips.size();
    float* found = first_return ? (float*)std::malloc(sizeof(float) * 2 * (size + 1)) : nullptr;
    if (found) first_returns(s, band, *p, depth, found + size, found);
    else if (first_return) __atomic_store_n(&failed, true, __ATOMIC_RELAXED);
    for (int y = band.strips.y0; y < band.strips.y0 + band.strips.rows; y++) {
      const int64_t row = (int64_t)(y - s.rays.y0) * s.rays.columns;
      read_row(band.strips, y, s.T + band.start, transmittance + row);
      if (found) read_row(band.strips, y, found, first_return + row);
    }
    std::free(found);
  });
  return failed ? SG_MEMORY : SG_OK;
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
