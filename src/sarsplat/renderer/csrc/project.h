// project.h: from a problem's arrays to entries on both planes.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// ---- input -------------------------------------------------------------------------------------------------------------
// the first value outside [low, high] (or NaN), as a multiple of `per`
void find_outside(const float* p, int64_t first, int64_t end, int64_t per, float low, float high, int32_t status, Fault& fault) {
  bool bad = false;
  for (int64_t i = per * first; i < per * end; i++) bad |= !(p[i] >= low && p[i] <= high);
  if (!bad || (fault.status && fault.status <= status)) return;
  int64_t i = per * first;
  while (p[i] >= low && p[i] <= high) i++;
  fault = {status, i / per};
}

// what is wrong with the Gaussians [first, end)
Fault check(const sg_problem& p, int64_t first, int64_t end) {
  const int64_t n = p.gaussians;
  Fault fault{SG_OK, -1};
  find_outside(p.means, first, end, 3, -p.farthest, p.farthest, SG_MEANS, fault);
  find_outside(p.quaternions, first, end, 4, -p.strongest, p.strongest, SG_QUATERNIONS, fault);
  find_outside(p.scales, first, end, 3, p.min_scale, p.max_scale, SG_SCALES, fault);
  find_outside(p.kappa, first, end, 1, 0.0f, p.max_depth, SG_KAPPA, fault);
  find_outside(p.harmonics, first, end, p.coefficients, -p.strongest, p.strongest, SG_SCATTERING, fault);
  for (int64_t v = 0; p.amplitudes && v < p.views; v++)
    find_outside(p.amplitudes, v * n + first, v * n + end, p.channels, -p.strongest, p.strongest, SG_AMPLITUDES, fault);
  if (first == 0) find_outside(p.shift, 0, p.views, 2, -p.farthest, p.farthest, SG_SHIFT, fault);
  for (int64_t i = first; i < end; i++) {
    const float* q = p.quaternions + 4 * i;
    const bool rotates = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] >= 1.0f / (p.strongest * p.strongest);
    if (!rotates && (!fault.status || fault.status > SG_QUATERNIONS)) fault = {SG_QUATERNIONS, i};
  }
  return fault;
}

// the first of them, whatever the number of threads
int32_t worst(const Fault* faults, int count, int64_t* culprit) {
  Fault first{SG_OK, -1};
  for (int i = 0; i < count; i++)
    if (faults[i].status && (!first.status || faults[i].status < first.status)) first = faults[i];
  *culprit = first.index;
  return first.status;
}

// ---- projection --------------------------------------------------------------------------------------------------------
SG_FN F words(I x) { return __builtin_bit_cast(F, x); }
SG_FN I whole(F x) { return __builtin_convertvector(smaller(larger(x, splat(-2.0f * kFarthest)), splat(2.0f * kFarthest)), I); }

// Inclusive boxes around footprints; empty if y1 < y0.
struct Boxes { I x0, x1, y0, y1; };
Boxes boxes_around(F x, F y, F reach_x, F reach_y, I touching) {
  const float slack = 1e-3f;
  const I top = whole(up(y - reach_y - slack));
  const I bottom = choose(touching, whole(down(y + reach_y + slack)), top - 1);
  return {whole(up(x - reach_x - slack)), whole(down(x + reach_x + slack)), top, bottom};
}
Boxes clip(const Boxes& b, int columns, int rows) {
  const I x0 = larger(b.x0, (I)(0)), x1 = smaller(b.x1, (I)(columns - 1)), y0 = larger(b.y0, (I)(0));
  return {x0, x1, y0, choose(x0 <= x1, smaller(b.y1, (I)(rows - 1)), y0 - 1)};
}

I shape_of(I blocks) {
  I shape = (I)(0);
  for (int k = 0; k < kShapes - 1; k++) shape -= blocks > kMaxBlocks[k];
  return shape;
}
// The first row, then the shape. What lies outside comes last.
I key_of(const Boxes& box, int rows) {
  const I tall = shape_of((box.y1 - box.y0) / kBlockY + 1), wide = shape_of(box.x1 / kBlockX - box.x0 / kBlockX + 1);
  return choose(box.y1 < box.y0, (I)(rows * kShapes * kShapes), (box.y0 * kShapes + tall) * kShapes + wide);
}

// floats to whole numbers, order kept; -0 equals 0
I ordered(F x) {
  const I bits = __builtin_bit_cast(I, x + 0.0f);
  return bits ^ ((bits >> 31) | (I)(INT32_MIN));
}
float from_ordered(int32_t key) { return __builtin_bit_cast(float, key < 0 ? key ^ INT32_MIN : ~key); }

// own: what a plane has of its own
template <class E>
void write_entries(E* out, int real, F x, F y, const Whitening<F>& w, F height, const Boxes& box, const F (&own)[6]) {
  const F x0 = words(box.x0), x1 = words(box.x1), y0 = words(box.y0), y1 = words(box.y1);
  turn_back({x, y, w.ux, w.uy, w.vy, height, x0, x1, y0, y1, own[0], own[1], own[2], own[3], own[4], own[5]},
            [&](int k, int part, F numbers) { if (k < real) store((float*)(out + k) + part, numbers); });
}

struct Cuts {
  float log_tau;                  // where a footprint on rays ends
  float deviations, lost;         // where an imaging weight ends, and one over what is left of its integral
};

Cuts cuts_of(const sg_problem& p) {
  return {min_log_tau(p), __builtin_sqrtf(p.image_cut), 1.0f / (1.0f - __builtin_expf(-0.5f * p.image_cut))};
}

// at: in cells, and in pixels below; slope: of the range of the densest point, per cell
void place_on_rays(const ViewState& s, const sg_problem& p, const Cuts& cuts, const Placed<F>& at, F kappa, F range, const F* slope,
                   int64_t i, int real, Bounds& bounds) {
  const I touching = kappa >= p.min_ray_depth;  // padding has no depth and touches nothing
  const F height = natural_log(choose(touching, kappa, splat(p.min_ray_depth)) * kLog2e) * kLog2e;
  const F reach = root(larger((height - cuts.log_tau) * (2.0f * kLn2), splat(0.0f)));
  const F reach_x = reach * at.deviation_x, reach_y = reach * at.deviation_y;
  const F x = at.x, y = at.y;                   // ray k of an axis stands at k + 1/2
  const Boxes rays = boxes_around(x - 0.5f, y - 0.5f, reach_x, reach_y, touching);
  const F zero = splat(0.0f), beyond = splat(3e38f);
  const F no_band = words((I)(-1));             // last_band, for the time being
  write_entries(s.on_rays + i, real, x - 0.5f, y - 0.5f, at.w, height, rays, {zero, zero, no_band, zero, slope[0], slope[1]});
  store(s.depth_keys + i, choose(touching, ordered(range), (I)(kNoDepth)));
  bounds.low[0] = smaller(bounds.low[0], choose(touching, x - reach_x, beyond));
  bounds.low[1] = smaller(bounds.low[1], choose(touching, y - reach_y, beyond));
  bounds.high[0] = larger(bounds.high[0], choose(touching, x + reach_x, -beyond));
  bounds.high[1] = larger(bounds.high[1], choose(touching, y + reach_y, -beyond));
}

F pixel_x(const sg_problem& p, F x_m) { return (x_m - p.center[0]) * (1.0f / p.pixel[0]) + 0.5f * (float)(p.columns - 1); }
F pixel_y(const sg_problem& p, F r_m) { return (r_m - p.center[1]) * (1.0f / p.pixel[1]) + 0.5f * (float)(p.rows - 1); }

// norm: of the imaging weight; amplitude, lit, slope: see PixelEntry
void place_on_pixels(const ViewState& s, const sg_problem& p, const Cuts& cuts, const Placed<F>& at, F norm, F amplitude, F lit, F slope,
                     const F (&elevation)[2], int64_t i, int real) {
  const F wide = cuts.deviations * at.deviation_x, tall = cuts.deviations * at.deviation_y, zero = splat(0.0f);
  const Boxes pixels = clip(boxes_around(at.x, at.y, wide, tall, (I)(-1)), p.columns, p.rows);
  write_entries(s.on_pixels + i, real, at.x, at.y, at.w, norm, pixels, {amplitude, lit, slope, elevation[0], elevation[1], zero});
  store(s.pixel_keys + i, key_of(pixels, p.rows));
}

// P(u) of kWidth Gaussians in a view, and its slope over the sum of harmonics; `harmonics`: read if there are any.
SG_FN Softplus<F> scatter(const sg_problem& p, int v, int64_t i, int real, const F* harmonics) {
  const F zero = splat(0.0f);
  if (!p.coefficients) {          // of several channels nobody asks
    const bool one = p.amplitudes && p.channels == 1;
    return {one ? load_some(p.amplitudes + v * (int64_t)p.gaussians + i, real) : zero, zero};
  }
  F sum = zero;
  for (int k = 0; k < p.coefficients; k++) sum += harmonics[k] * p.basis[v * p.coefficients + k];
  Softplus<F> gamma0 = softplus(sum);
  gamma0.value += p.p_min;
  return gamma0;
}

// visit(v, i, real, bodies, projection, P(u)) for kWidth of the Gaussians [first, end) at a time, in every view
template <class Visit> void project_all(const sg_problem& p, int64_t first, int64_t end, Visit visit) {
  const PlaneUnits u = units(p);
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    const Bodies bodies = read_bodies(p, i, real);
    F harmonics[kFields];
    if (p.coefficients) read_rows(p.harmonics + p.coefficients * i, p.coefficients, real, harmonics);
    for (int v = 0; v < p.views; v++)
      visit(v, i, real, bodies, project(bodies.body, frame_of(p, v), u), scatter(p, v, i, real, harmonics));
  }
}

// Bounds of the footprints of a chunk: none yet.
Bounds& unbounded(const ViewState& s, int64_t first) {
  const F beyond = splat(3e38f);
  return s.bounds[first / kChunk] = {{beyond, beyond}, {-beyond, -beyond}};
}

// The Gaussians [first, end) to entries in every view.
void project_chunk(const sg_context& c, const sg_problem& p, int64_t first, int64_t end) {
  const PlaneUnits u = units(p);
  const Cuts cuts = cuts_of(p);
  const F zero = splat(0.0f);
  for (int v = 0; v < p.views; v++) unbounded(c.views[v], first);
  project_all(p, first, end, [&](int v, int64_t i, int real, const Bodies& bodies, const Projection<F>& g, const Softplus<F>& gamma0) {
    const ViewState& s = c.views[v];
    F slope[2];
    densest(g, u, slope);
    const Placed<F> on_rays{g.mean[0] * (1.0f / u.ray[0]), g.mean[1] * (1.0f / u.ray[1]), whitening(g.cov_c, g.det_cw), root(g.cov_c.xx),
                            root(g.cov_c.yy)};
    F depth = bodies.kappa * widening_ratio(g, u);
    if (p.in_sight) depth *= load_some(p.in_sight + v * (int64_t)p.gaussians + i, real);
    place_on_rays(s, p, cuts, on_rays, depth, g.mean[2], slope, i, real, s.bounds[first / kChunk]);

    const float* shift = p.shift + 2 * v;
    const Placed<F> on_pixels{pixel_x(p, g.mean[0] + shift[0]), pixel_y(p, g.mean[2] + shift[1]), whitening(g.cov_i, g.det_iw),
                              root(g.cov_i.xx), root(g.cov_i.yy)};
    const F norm = p.peak ? splat(cuts.lost) : cuts.lost / (6.2831853f * p.pixel[0] * p.pixel[1] * root(g.det_iw));
    place_on_pixels(s, p, cuts, on_pixels, norm, gamma0.value, zero, gamma0.slope, {zero, zero}, i, real);
  });
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
