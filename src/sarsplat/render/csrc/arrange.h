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
void prepare(sg_context& c, const sg_problem& p, int64_t first, int64_t end) {
  const int64_t real = end < p.gaussians ? end : p.gaussians;  // padding lanes hold a harmless Gaussian
  for (int64_t i = first; i < end; i++) {
    const bool pad = i >= real;
    for (int k = 0; k < 3; k++) {
      c.mean[k][i] = pad ? 0.0f : p.means[3 * i + k];
      c.scale[k][i] = pad ? 1.0f : p.scales[3 * i + k];
    }
    for (int k = 0; k < 4; k++) c.unit[k][i] = pad ? (k == 0 ? 1.0f : 0.0f) : p.quaternions[4 * i + k];
    c.kappa[i] = pad ? 0.0f : p.kappa[i];
    for (int k = 0; k < p.coefficients; k++) c.harmonics[k][i] = pad ? 0.0f : p.harmonics[p.coefficients * i + k];
  }
  for (int64_t i = first; i < end; i += kWidth) {
    F unit[4], rot[9], norm;
    rotation(load(c.unit[0] + i), load(c.unit[1] + i), load(c.unit[2] + i), load(c.unit[3] + i), rot, unit, norm);
    for (int k = 0; k < 4; k++) store(c.unit[k] + i, unit[k]);
    for (int k = 0; k < 9; k++) store(c.rot[k] + i, rot[k]);
    store(c.norm + i, norm);
  }
}

// ---- projection --------------------------------------------------------------------------------------------------------
void write_footprint(const Plane& plane, int64_t i, F x, F y, const Sym2<F>& cov, F det, F limit, F depth) {
  const Sym2<F> s = inverse(cov, det);
  store(plane.x + i, x);
  store(plane.y + i, y);
  store(plane.a + i, s.xx * (0.5f * kLog2e));
  store(plane.b + i, s.xy * kLog2e);
  store(plane.c + i, s.yy * (0.5f * kLog2e));
  store(plane.limit + i, limit);
  store(plane.depth + i, depth);
  const F reach = larger(limit, splat(0.0f)) * (2.0f * kLn2);  // Mahalanobis^2
  store(plane.rx + i, root(reach * cov.xx));
  store(plane.ry + i, root(reach * cov.yy));
}

void project_chunk(const sg_context& c, const sg_problem& p, int v, int64_t first, int64_t end) {
  const ViewState& s = c.views[v];
  const PlaneUnits u = units(p);
  const float* shift = p.shift + 2 * v;
  const float image_norm = 1.0f / (1.0f - __builtin_expf(-0.5f * p.image_cut));
  Bounds bound{{3e38f, 3e38f}, {-3e38f, -3e38f}};
  for (int64_t i = first; i < end; i += kWidth) {
    const Projection<F> g = project(body(c, i), s.frame, u);
    const F kappa = load(c.kappa + i) * widening_ratio(g, u);
    const F touches = kappa * (1.0f / p.min_ray_depth);
    const I touching = touches >= 1.0f;
    const F limit = choose(touching, natural_log(choose(touching, touches, splat(1.0f))) * kLog2e, splat(-1.0f));
    const F x = g.mean[0] * (1.0f / u.ray[0]), y = g.mean[1] * (1.0f / u.ray[1]);
    write_footprint(s.rays, i, x, y, g.cov_c, g.det_cw, limit, kappa * kLog2e);
    store(s.range + i, g.mean[2]);
    F phase;
    if (p.scattering) {
      alignas(64) float lanes[kWidth];
      for (int k = 0; k < kWidth; k++) lanes[k] = i + k < p.gaussians ? p.scattering[(int64_t)v * p.gaussians + i + k] : 0.0f;
      phase = load(lanes);
    } else {
      F sum_y = splat(0.0f);
      for (int k = 0; k < p.coefficients; k++) sum_y += load(c.harmonics[k] + i) * p.basis[v * p.coefficients + k];
      phase = softplus(sum_y) + p.p_min;
    }
    store(s.phase + i, phase);
    const F norm = p.peak ? splat(image_norm) : image_norm / (6.2831853f * p.pixel[0] * p.pixel[1] * root(g.det_iw));
    write_footprint(s.pixels, i, (g.mean[0] + shift[0] - p.center[0]) * (1.0f / p.pixel[0]) + 0.5f * (float)(p.columns - 1),
                    (g.mean[2] + shift[1] - p.center[1]) * (1.0f / p.pixel[1]) + 0.5f * (float)(p.rows - 1), g.cov_i, g.det_iw,
                    splat(0.5f * kLog2e * p.image_cut), norm);
    for (int k = 0; k < kWidth; k++) {
      const int64_t j = i + k;
      if (s.rays.limit[j] < 0.0f || j >= p.gaussians) continue;
      const float at[2] = {s.rays.x[j], s.rays.y[j]}, reach[2] = {s.rays.rx[j], s.rays.ry[j]};
      for (int axis = 0; axis < 2; axis++) {
        if (at[axis] - reach[axis] < bound.low[axis]) bound.low[axis] = at[axis] - reach[axis];
        if (at[axis] + reach[axis] > bound.high[axis]) bound.high[axis] = at[axis] + reach[axis];
      }
    }
  }
  s.bounds[first / kChunk] = bound;
}

// ---- lattice and depth order -------------------------------------------------------------------------------------------
bool place_lattice(ViewState& s, int chunks) {
  Bounds all{{3e38f, 3e38f}, {-3e38f, -3e38f}};
  for (int i = 0; i < chunks; i++)
    for (int axis = 0; axis < 2; axis++) {
      if (s.bounds[i].low[axis] < all.low[axis]) all.low[axis] = s.bounds[i].low[axis];
      if (s.bounds[i].high[axis] > all.high[axis]) all.high[axis] = s.bounds[i].high[axis];
    }
  s.k0x = s.k0y = 0;
  s.ray_rows = s.ray_columns = s.ray_bx = s.ray_by = 0;
  if (!(all.low[0] <= all.high[0])) return true;  // nothing touches a ray
  const double x0 = __builtin_floor(all.low[0]), y0 = __builtin_floor(all.low[1]);
  const double nx = __builtin_ceil(all.high[0]) - x0, ny = __builtin_ceil(all.high[1]) - y0;
  if (!(nx <= (double)kMostBlocks * kBlockX && ny <= (double)kMostBlocks * kBlockY && nx * ny <= (double)kMostLanes)) return false;
  s.k0x = (int64_t)x0; s.k0y = (int64_t)y0;
  s.ray_columns = most(1, (int)nx); s.ray_rows = most(1, (int)ny);
  s.ray_bx = blocks(s.ray_columns, kBlockX); s.ray_by = blocks(s.ray_rows, kBlockY);
  return true;
}

// stable radix sort by depth: ties keep the order of their indices
void sort_by_depth(ViewState& s, int n) {
  uint32_t count[3][2048] = {};
  int m = 0;
  for (int i = 0; i < n; i++) {
    s.rank[i] = -1;
    if (s.rays.limit[i] < 0.0f) continue;
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

// inclusive range of blocks that hold a lattice point within `reach` of `at`
void block_range(float at, float reach, int points, int per, int16_t* first, int16_t* last) {
  const float low = at - reach - 1e-3f, high = at + reach + 1e-3f;
  const int i0 = low > 0.0f ? (low < (float)points ? (int)__builtin_ceilf(low) : points) : 0;
  const int i1 = high < (float)(points - 1) ? (high >= 0.0f ? (int)high : -1) : points - 1;
  *first = (int16_t)(i0 / per);
  *last = (int16_t)(i1 < i0 ? i0 / per - 1 : i1 / per);
}

Entry entry(const Plane& plane, int64_t i, float x0, float y0, int columns, int rows) {
  Entry e;
  e.g = {plane.x[i] - x0, plane.y[i] - y0, plane.a[i], plane.b[i], plane.c[i], plane.limit[i], plane.depth[i]};
  e.id = (int32_t)i;
  block_range(e.g.x, plane.rx[i], columns, kBlockX, &e.x0, &e.x1);
  block_range(e.g.y, plane.ry[i], rows, kBlockY, &e.y0, &e.y1);
  if (e.x1 < e.x0) e.y1 = (int16_t)(e.y0 - 1);
  return e;
}

// contiguous bands of block rows with about equal work
void cut_bands(const Entry* entries, int n, int rows, Band* bands, int count, int64_t* work) {
  for (int y = 0; y <= rows; y++) work[y] = 0;
  for (int i = 0; i < n; i++)
    for (int y = entries[i].y0; y <= entries[i].y1; y++) work[y] += entries[i].x1 - entries[i].x0 + 1;
  int64_t total = 0, done = 0;
  for (int y = 0; y < rows; y++) total += work[y] += 1;
  for (int b = 0, y = 0; b < count; b++) {
    bands[b].first = y;
    while (y < rows && (b == count - 1 || done * count < total * (b + 1))) done += work[y++];
    bands[b].end = y;
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
