// arrange.h: from a problem's arrays to footprints in depth order: everything before the pair loops.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// ---- input -------------------------------------------------------------------------------------------------------------
// index of the first value outside [low, high] (or NaN), or -1
int64_t outside(const float* p, int64_t n, float low, float high) {
  bool bad = false;
  for (int64_t i = 0; i < n; i++) bad |= !(p[i] >= low && p[i] <= high);
  if (!bad) return -1;
  for (int64_t i = 0; i < n; i++)
    if (!(p[i] >= low && p[i] <= high)) return i;
  return -1;
}

int32_t check(const sg_problem& p, int64_t* culprit) {
  const int64_t n = p.gaussians;
  const float far = 1e9f, strong = 1e15f;  // beyond these, float32 overflows on the way
  struct { const float* data; int64_t count, per; float low, high; int32_t status; } const rules[] = {
      {p.means, 3 * n, 3, -far, far, SG_MEANS},
      {p.quaternions, 4 * n, 4, -1e15f, 1e15f, SG_QUATERNIONS},
      {p.scales, 3 * n, 3, p.min_scale, 1e6f, SG_SCALES},
      {p.kappa, n, 1, 0.0f, p.max_depth, SG_KAPPA},
      {p.harmonics, p.coefficients * n, p.coefficients, -strong, strong, SG_HARMONICS},
      {p.scattering, p.scattering ? p.views * n : 0, 1, -strong, strong, SG_SCATTERING},
      {p.shift, 2 * (int64_t)p.views, 2, -far, far, SG_SHIFT},
  };
  for (const auto& r : rules) {
    const int64_t i = outside(r.data, r.count, r.low, r.high);
    if (i >= 0) { *culprit = i / r.per; return r.status; }
  }
  for (int64_t i = 0; i < n; i++) {
    const float* q = p.quaternions + 4 * i;
    if (!(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] >= 1e-30f)) { *culprit = i; return SG_QUATERNIONS; }
  }
  return SG_OK;
}

// ---- bodies: arrays of structures to structures of arrays, quaternion to rotation -------------------------------------
template <int K> SG_FN void split(const float* rows, int64_t first, int64_t end, float* const* columns) {
  for (int64_t i = first; i < end; i++)
    for (int k = 0; k < K; k++) columns[k][i] = rows[K * i + k];
}

void prepare(sg_context& c, const sg_problem& p, int64_t first, int64_t end) {
  const int64_t real = end < p.gaussians ? end : p.gaussians;
  split<3>(p.means, first, real, c.mean);
  split<3>(p.scales, first, real, c.scale);
  split<4>(p.quaternions, first, real, c.unit);
  split<1>(p.kappa, first, real, &c.kappa);
  for (int64_t i = real; i < end; i++) {  // padding lanes hold a harmless Gaussian
    for (int k = 0; k < 3; k++) { c.mean[k][i] = 0.0f; c.scale[k][i] = 1.0f; }
    for (int k = 0; k < 4; k++) c.unit[k][i] = k == 0 ? 1.0f : 0.0f;
    c.kappa[i] = 0.0f;
  }
  for (int64_t i = first; i < end; i += kWidth) {
    F unit[4], rot[9], norm;
    rotation(load(c.unit[0] + i), load(c.unit[1] + i), load(c.unit[2] + i), load(c.unit[3] + i), rot, unit, norm);
    for (int k = 0; k < 4; k++) store(c.unit[k] + i, unit[k]);
    for (int k = 0; k < 9; k++) store(c.rot[k] + i, rot[k]);
    store(c.norm + i, norm);
  }
}

// ---- scattering --------------------------------------------------------------------------------------------------------
// rows of K floats of the Gaussians [i, i + kWidth) as K vectors; those past n are zero
template <class Visit> SG_FN void for_columns(const float* rows, int K, int64_t i, int64_t n, Visit visit) {
  const int64_t here = n - i < kWidth ? n - i : kWidth;
  for (int k0 = 0; k0 < K; k0 += kWidth) {
    F m[kWidth];
    if (here == kWidth && k0 + kWidth <= K) {
      for (int r = 0; r < kWidth; r++) m[r] = load_anywhere(rows + (i + r) * K + k0);
      transpose(m);
    } else {
      for (int k = 0; k < kWidth; k++)
        for (int r = 0; r < kWidth; r++) m[k][r] = r < here && k0 + k < K ? rows[(i + r) * K + k0 + k] : 0.0f;
    }
    for (int k = 0; k < kWidth && k0 + k < K; k++) visit(k0 + k, m[k]);
  }
}

// the reverse: K vectors to rows of K floats
SG_FN void write_columns(const F* columns, int K, int64_t i, int64_t n, float* rows) {
  const int64_t here = n - i < kWidth ? n - i : kWidth;
  for (int k0 = 0; k0 < K; k0 += kWidth) {
    if (here == kWidth && k0 + kWidth <= K) {
      F m[kWidth];
      for (int k = 0; k < kWidth; k++) m[k] = columns[k0 + k];
      transpose(m);
      for (int r = 0; r < kWidth; r++) store_anywhere(rows + (i + r) * K + k0, m[r]);
    } else {
      for (int k = k0; k < K && k < k0 + kWidth; k++)
        for (int r = 0; r < here; r++) rows[(i + r) * K + k] = columns[k][r];
    }
  }
}

// P(u) in every view
void scatter_chunk(const sg_context& c, const sg_problem& p, int64_t first, int64_t end) {
  for (int64_t i = first; i < end; i += kWidth) {
    if (p.scattering) {
      for (int v = 0; v < p.views; v++)
        for_columns(p.scattering + (int64_t)v * p.gaussians, 1, i, p.gaussians, [&](int, F x) { store(c.views[v].phase + i, x); });
      continue;
    }
    F h[16];
    for_columns(p.harmonics, p.coefficients, i, p.gaussians, [&](int k, F x) { h[k] = x; });
    for (int v = 0; v < p.views; v++) {
      F sum_y = splat(0.0f);
      for (int k = 0; k < p.coefficients; k++) sum_y += h[k] * p.basis[v * p.coefficients + k];
      store(c.views[v].phase + i, softplus(sum_y) + p.p_min);
    }
  }
}

// ---- projection --------------------------------------------------------------------------------------------------------
SG_FN F words(I x) { return __builtin_bit_cast(F, x); }
SG_FN I whole(F x) { return __builtin_convertvector(smaller(larger(x, splat(-2.0f * kFarthest)), splat(2.0f * kFarthest)), I); }

// Inclusive boxes around footprints; empty if y1 < y0.
struct Boxes { I x0, x1, y0, y1; };
Boxes boxes_around(F x, F y, F reach_x, F reach_y, I touching) {
  const float slack = 1e-3f;
  const I top = whole(up(y - reach_y - slack));
  return {whole(up(x - reach_x - slack)), whole(down(x + reach_x + slack)), top, choose(touching, whole(down(y + reach_y + slack)), top - 1)};
}

template <class E> void write_entries(E* out, int64_t count, F x, F y, const Sym2<F>& cov, F det, F height, const Boxes& box, F a, F b, F c) {
  const Whitening<F> w = whitening(cov, det);
  const F none = splat(0.0f);
  F fields[16] = {x, y, w.ux, w.uy, w.vy, height, words(box.x0), words(box.x1), words(box.y0), words(box.y1), a, b, c, none, none, none};
  for (int part = 0; part < 16; part += kWidth) {
    F m[kWidth];
    for (int k = 0; k < kWidth; k++) m[k] = fields[part + k];
    transpose(m);
    for (int k = 0; k < kWidth && k < count; k++) store((float*)(out + k) + part, m[k]);
  }
}

// The first row, then the shape in blocks: large ones are all alike. What lies outside comes last.
I key_of(const Boxes& box, int rows) {
  const I tall = least((box.y1 - box.y0) / kBlockY, (I)(kShapes - 1)), wide = least(box.x1 / kBlockX - box.x0 / kBlockX, (I)(kShapes - 1));
  return choose(box.y1 < box.y0, (I)(rows * kShapes * kShapes), (box.y0 * kShapes + tall) * kShapes + wide);
}

float least_of(F x) { float m = x[0]; for (int k = 1; k < kWidth; k++) m = x[k] < m ? x[k] : m; return m; }

void project_chunk(const sg_context& c, const sg_problem& p, int v, int64_t first, int64_t end) {
  const ViewState& s = c.views[v];
  const PlaneUnits u = units(p);
  const float* shift = p.shift + 2 * v;
  const float image_norm = 1.0f / (1.0f - __builtin_expf(-0.5f * p.image_cut));
  const float huge = 3e38f, min_log_tau = least_log_tau(p);
  F low[2] = {splat(huge), splat(huge)}, high[2] = {splat(huge), splat(huge)};  // high: negated
  for (int64_t i = first; i < end; i += kWidth) {
    const int64_t count = p.gaussians - i;
    const Projection<F> g = project(body(c, i), s.frame, u);
    const F kappa = load(c.kappa + i) * widening_ratio(g, u);
    const I touching = kappa >= p.min_ray_depth;      // padding has no depth and touches nothing
    const F height = natural_log(choose(touching, kappa, splat(p.min_ray_depth)) * kLog2e) * kLog2e;
    const F x = g.mean[0] * (1.0f / u.ray[0]), y = g.mean[1] * (1.0f / u.ray[1]);
    const F reach = root(choose(touching, (height - min_log_tau) * (2.0f * kLn2), splat(0.0f)));
    const F reach_x = reach * root(g.cov_c.xx), reach_y = reach * root(g.cov_c.yy);
    // ray k of an axis stands at k + 1/2
    write_entries(s.on_rays + i, count, x - 0.5f, y - 0.5f, g.cov_c, g.det_cw, height, boxes_around(x - 0.5f, y - 0.5f, reach_x, reach_y, touching),
                  splat(0.0f), splat(0.0f), words((I)(-1)));  // in no band yet
    store(s.range + i, choose(touching, g.mean[2], splat(__builtin_inff())));
    low[0] = smaller(low[0], choose(touching, x - reach_x, splat(huge)));
    low[1] = smaller(low[1], choose(touching, y - reach_y, splat(huge)));
    high[0] = smaller(high[0], choose(touching, -(x + reach_x), splat(huge)));
    high[1] = smaller(high[1], choose(touching, -(y + reach_y), splat(huge)));
    const F column = (g.mean[0] + shift[0] - p.center[0]) * (1.0f / p.pixel[0]) + 0.5f * (float)(p.columns - 1);
    const F row = (g.mean[2] + shift[1] - p.center[1]) * (1.0f / p.pixel[1]) + 0.5f * (float)(p.rows - 1);
    const float cut = __builtin_sqrtf(p.image_cut);
    Boxes box = boxes_around(column, row, cut * root(g.cov_i.xx), cut * root(g.cov_i.yy), (I)(-1));
    box.x0 = most(box.x0, (I)(0)); box.x1 = least(box.x1, (I)(p.columns - 1));
    box.y0 = most(box.y0, (I)(0)); box.y1 = choose(box.x0 <= box.x1, least(box.y1, (I)(p.rows - 1)), box.y0 - 1);
    store(s.pixel_keys + i, key_of(box, p.rows));
    const F norm = p.peak ? splat(image_norm) : image_norm / (6.2831853f * p.pixel[0] * p.pixel[1] * root(g.det_iw));
    write_entries(s.on_pixels + i, count, column, row, g.cov_i, g.det_iw, splat(0.0f), box, load(s.phase + i), norm, splat(0.0f));
  }
  s.bounds[first / kChunk] = {{least_of(low[0]), least_of(low[1])}, {-least_of(high[0]), -least_of(high[1])}};
}

// ---- lattice and depth order -------------------------------------------------------------------------------------------
bool place_lattice(ViewState& s, int chunks) {
  Bounds all{{3e38f, 3e38f}, {-3e38f, -3e38f}};
  for (int i = 0; i < chunks; i++)
    for (int axis = 0; axis < 2; axis++) {
      if (s.bounds[i].low[axis] < all.low[axis]) all.low[axis] = s.bounds[i].low[axis];
      if (s.bounds[i].high[axis] > all.high[axis]) all.high[axis] = s.bounds[i].high[axis];
    }
  s.rays = {0, 0, 0, 0, nullptr, nullptr};
  if (!(all.low[0] <= all.high[0])) return true;  // nothing touches a ray
  for (int axis = 0; axis < 2; axis++)
    if (!(all.low[axis] > -kFarthest && all.high[axis] < kFarthest)) return false;
  const double x0 = __builtin_floor(all.low[0]), y0 = __builtin_floor(all.low[1]);
  const double nx = __builtin_ceil(all.high[0]) - x0, ny = __builtin_ceil(all.high[1]) - y0;
  if (!(nx * ny <= (double)kMostRays)) return false;
  s.rays = {(int)x0, (int)y0, most(1, (int)nx), most(1, (int)ny), nullptr, nullptr};
  return true;
}

// stable radix sort by depth: ties keep the order of their indices
void sort_by_depth(ViewState& s, int n) {
  uint32_t count[3][2048] = {};
  int m = 0;
  for (int i = 0; i < n; i++) {
    if (s.range[i] == __builtin_inff()) continue;
    uint32_t key = __builtin_bit_cast(uint32_t, s.range[i] + 0.0f);
    key ^= (uint32_t)((int32_t)key >> 31) | 0x80000000u;  // floats to unsigned, order kept
    s.order[m++] = (uint64_t)key << 32 | (uint32_t)i;
    count[0][key & 2047]++; count[1][key >> 11 & 2047]++; count[2][key >> 22]++;
  }
  s.touching = m;
  for (int pass = 0; pass < 3; pass++) {
    uint32_t start = 0;
    for (int k = 0; k < 2048; k++) { const uint32_t c = count[pass][k]; count[pass][k] = start; start += c; }
    const int shift = 32 + 11 * pass;
    for (int i = 0; i < m; i++) s.order_spare[count[pass][s.order[i] >> shift & 2047]++] = s.order[i];
    uint64_t* swap = s.order; s.order = s.order_spare; s.order_spare = swap;
  }
}

// ---- the tasks of the pair loops -----------------------------------------------------------------------------------------
// Cuts the lattice into bands of rows with about equal work, gives every entry its bands and slots, and lists for each
// band who reaches it, front to back. work: one number a row, and one more.
void cut_rays(ViewState& s, int n, int parts, int64_t* work) {
  const Strips& all = s.rays;
  s.ray_parts = most(1, least(parts, all.rows / kRowsPerBand));
  for (int y = 0; y <= all.rows; y++) work[y] = 0;
  for (int i = 0; i < n; i++) {
    RayEntry& e = s.on_rays[i];
    if (e.y1 < e.y0) continue;
    e.x0 = most(e.x0, all.x0); e.x1 = least(e.x1, all.x0 + all.columns - 1);
    e.y0 = most(e.y0, all.y0); e.y1 = least(e.y1, all.y0 + all.rows - 1);
    if (e.x1 < e.x0) e.y1 = e.y0 - 1;
    if (e.y1 < e.y0) continue;
    const int wide = (e.x1 - all.x0) / kBlockX - (e.x0 - all.x0) / kBlockX + 1;
    work[e.y0 - all.y0] += wide;
    work[e.y1 - all.y0 + 1] -= wide;
  }
  int64_t total = all.rows, running = 0, done = 0, start = 0;
  for (int y = 0; y < all.rows; y++) total += running += work[y];
  running = 0;
  for (int b = 0, y = 0; b < s.ray_parts; b++) {
    const int first = y;
    while (y < all.rows && (b == s.ray_parts - 1 || done * s.ray_parts < total * (b + 1))) {
      done += 1 + (running += work[y]);
      work[y++] = b;
    }
    s.ray_bands[b] = {0, 0, all.part(all.y0 + first, all.y0 + y), start, nullptr};
    start += s.ray_bands[b].strips.size();
  }
  for (int i = 0, slot = 0; i < n; i++) {
    RayEntry& e = s.on_rays[i];
    s.reached[i] = {0, 0};
    if (e.y1 < e.y0) continue;
    e.slot = slot;
    e.first_band = (int)work[e.y0 - all.y0];
    e.last_band = (int)work[e.y1 - all.y0];
    s.reached[i] = {(uint8_t)e.first_band, (uint8_t)(e.last_band + 1)};
    slot += e.last_band - e.first_band + 1;
    for (int b = e.first_band; b <= e.last_band; b++) s.ray_bands[b].end++;
  }
  for (int b = 0, at = 0; b < s.ray_parts; b++) {
    const int count = s.ray_bands[b].end;
    s.ray_bands[b].first = s.ray_bands[b].end = at;
    at += count;
  }
  for (int k = 0; k < s.touching; k++) {
    const int32_t id = (int32_t)(uint32_t)s.order[k];
    const Reached r = s.reached[id];
    for (int b = r.first; b < r.end; b++) s.ray_list[s.ray_bands[b].end++] = id;
  }
}

// Sorts Gaussians by the image row they begin in and by their shape in blocks, so that a part's rows are few and its
// loops alike, and cuts them into parts of about equal work. counts: of each key.
void cut_pixels(ViewState& s, const Strips& image, int n, int parts, int32_t* counts) {
  const int keys = image.rows * kShapes * kShapes + 1;
  for (int k = 0; k < keys; k++) counts[k] = 0;
  for (int i = 0; i < n; i++) counts[s.pixel_keys[i]]++;
  auto work = [&](int key) { return 2 + (key / kShapes % kShapes + 1) * (key % kShapes + 1); };
  int64_t total = 0, done = 0;
  for (int k = 0; k < keys; k++) total += counts[k] * (int64_t)work(k);
  s.pixel_parts = 0;
  Part* part = nullptr;
  int at = 0;
  for (int k = 0; k < keys; k++) {
    const int64_t each = work(k);
    const int tall = k / kShapes % kShapes, first_row = least(k / kShapes / kShapes, image.rows - 1);
    const int last_row = tall == kShapes - 1 ? image.rows - 1 : least(image.rows - 1, first_row + (tall + 1) * kBlockY - 1);
    for (int left = counts[k]; left > 0;) {
      if (!part || done * parts >= total * s.pixel_parts) {  // never after the last part: there done < total
        part = s.pixel_groups + s.pixel_parts++;
        *part = {at, at, image.part(first_row, first_row), 0, nullptr};
      }
      const int64_t room = (total * s.pixel_parts / parts - done) / each + 1;
      const int here = left < room ? left : (int)room;
      part->end = at += here;
      part->strips.rows = most(part->strips.rows, last_row - part->strips.y0 + 1);
      done += here * each;
      left -= here;
    }
  }
  for (int k = 0, start = 0; k < keys; k++) { const int c = counts[k]; counts[k] = start; start += c; }
  for (int i = 0; i < n; i++) s.pixel_list[counts[s.pixel_keys[i]]++] = i;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
