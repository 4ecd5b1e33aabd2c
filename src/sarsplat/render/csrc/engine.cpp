// engine.cpp: a batch of views, forward and backward. Compiled once per instruction set.
//
// forward:  check -> bodies -> project -> lattice, depth order -> pass A -> cross-sections -> pass B
// backward: pass B (gather per Gaussian) -> pass A (back to front) -> adjoint of the projection, views summed in order
//
// Every stage is a set of independent tasks whose number and order of summation depend on the problem alone, never on
// the number of threads: results are bit-identical for any.
#include "simd.h"  // first: the mathematics below is written for its F

#include "api.h"
#include "gaussian_math.h"
#include "memory.h"
#include "parallel.h"
#include "passes.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kChunk = 1024;      // Gaussians per task; a multiple of every kWidth
constexpr int kTasks = 16;        // pair-loop tasks wanted over all views
constexpr int kMostBands = 8;     // of them at most this many per view: a Gaussian on a border is visited twice
constexpr int kMostBlocks = 32767;
constexpr int64_t kMostLanes = int64_t(1) << 28;

int least(int a, int b) { return a < b ? a : b; }
int most(int a, int b) { return a > b ? a : b; }
int64_t padded(int64_t n) { return (n + kWidth - 1) / kWidth * kWidth; }
int blocks(int n, int per) { return (n + per - 1) / per; }

// ---- what a view keeps -----------------------------------------------------------------------------------------------
struct Plane { float *x, *y, *a, *b, *c, *limit, *depth, *rx, *ry; };  // footprints, one array a field

struct Bounds { float low[2], high[2]; };

struct ViewState {
  ViewFrame frame;
  Plane rays, pixels;             // depth: kappa' on rays, the norm on pixels
  float *range, *phase;           // z_r, P(u)
  Bounds* bounds;                 // per chunk, of the footprints on the computation plane
  uint64_t *order, *order_spare;  // radix sort: depth key << 32 | id
  int64_t k0x, k0y;
  int ray_rows, ray_columns, ray_bx, ray_by;
  int touching;                   // Gaussians that can touch a ray, front to back:
  Entry* on_rays;
  int32_t* rank;                  // id -> position in on_rays, or -1
  Entry* on_pixels;               // by id
  Band ray_bands[kMostBands], pixel_bands[kMostBands];
  float* T;
  int32_t* last;
  float* weight;                  // sum of w over rays, by id
  float* partial;                 // [bands, touching]
};

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat

using namespace sarsplat::SG_ISA;

struct sg_context {
  Arena arena;
  Arena::Mark kept;
  float *mean[3], *unit[4], *norm, *rot[9], *scale[3], *kappa, *harmonics[16];
  ViewState* views;
  int bands;
};

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
  const float huge = 3e38f;
  struct { const float* data; int64_t count, per; float low, high; int32_t status; } const rules[] = {
      {p.means, 3 * n, 3, -huge, huge, SG_MEANS},
      {p.quaternions, 4 * n, 4, -1e15f, 1e15f, SG_QUATERNIONS},
      {p.scales, 3 * n, 3, p.min_scale, 1e6f, SG_SCALES},
      {p.kappa, n, 1, 0.0f, p.max_depth, SG_KAPPA},
      {p.harmonics, p.coefficients * n, p.coefficients, -huge, huge, SG_HARMONICS},
      {p.scattering, p.scattering ? p.views * n : 0, 1, -huge, huge, SG_SCATTERING},
      {p.shift, 2 * (int64_t)p.views, 2, -huge, huge, SG_SHIFT},
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

Body<F> body(const sg_context& c, int64_t i) {
  Body<F> b;
  for (int k = 0; k < 3; k++) { b.mean[k] = load(c.mean[k] + i); b.scale[k] = load(c.scale[k] + i); }
  for (int k = 0; k < 9; k++) b.rot[k] = load(c.rot[k] + i);
  return b;
}

PlaneUnits units(const sg_problem& p) {
  return {{p.ray[0], p.ray[1]}, {p.pixel[0], p.pixel[1]}, p.cell_widening, {p.response_var[0], p.response_var[1]}};
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

// ---- blocked images ------------------------------------------------------------------------------------------------------
void from_blocks(const float* in, int blocks_x, int rows, int columns, int first, int end, float* out) {
  for (int y = first; y < end && y < rows; y++)
    for (int x = 0; x < columns; x++)
      out[(int64_t)y * columns + x] = in[((int64_t)(y / kBlockY) * blocks_x + x / kBlockX) * kWidth + y % kBlockY * kBlockX + x % kBlockX];
}
void to_blocks(const float* in, int blocks_x, int rows, int columns, int first, int end, float* out) {
  for (int y = first; y < end; y++)
    for (int x = 0; x < blocks_x * kBlockX; x++)
      out[((int64_t)(y / kBlockY) * blocks_x + x / kBlockX) * kWidth + y % kBlockY * kBlockX + x % kBlockX] =
          y < rows && x < columns ? in[(int64_t)y * columns + x] : 0.0f;
}

// ---- forward ---------------------------------------------------------------------------------------------------------------
Plane take_plane(Arena& arena, int64_t n) {
  Plane p;
  float** const fields[] = {&p.x, &p.y, &p.a, &p.b, &p.c, &p.limit, &p.depth, &p.rx, &p.ry};
  for (float** field : fields) *field = arena.take<float>(n);
  return p;
}

int32_t forward(sg_context* context, const sg_problem* problem, const sg_outputs* out, int64_t* culprit) {
  sg_context& c = *context;
  const sg_problem& p = *problem;
  if (const int32_t status = check(p, culprit)) return status;
  Arena& arena = c.arena;
  arena.reset();
  const int64_t n = p.gaussians, np = padded(n);
  const int V = p.views, chunks = blocks((int)n, kChunk);
  const int image_bx = blocks(p.columns, kBlockX), image_by = blocks(p.rows, kBlockY);
  const int bands = c.bands = most(1, least(kMostBands, kTasks / most(V, 1)));
  const float cell = p.ray[0] * p.ray[1];
  auto chunk_end = [&](int64_t chunk, int64_t limit) { return (chunk + 1) * kChunk < limit ? (chunk + 1) * kChunk : limit; };

  float** const fields[] = {&c.mean[0], &c.mean[1], &c.mean[2], &c.scale[0], &c.scale[1], &c.scale[2],
                            &c.unit[0], &c.unit[1], &c.unit[2], &c.unit[3], &c.norm, &c.kappa};
  for (float** field : fields) *field = arena.take<float>(np);
  for (int k = 0; k < 9; k++) c.rot[k] = arena.take<float>(np);
  for (int k = 0; k < p.coefficients; k++) c.harmonics[k] = arena.take<float>(np);
  c.views = arena.take<ViewState>(V);
  for (int v = 0; v < V; v++) {
    ViewState& s = c.views[v];
    for (int k = 0; k < 9; k++) s.frame.r[k] = p.frames[9 * v + k];
    s.rays = take_plane(arena, np);
    s.pixels = take_plane(arena, np);
    s.range = arena.take<float>(np);
    s.phase = arena.take<float>(np);
    s.bounds = arena.take<Bounds>(chunks);
    s.order = arena.take<uint64_t>(n);
    s.order_spare = arena.take<uint64_t>(n);
    s.rank = arena.take<int32_t>(n);
    s.on_rays = arena.take<Entry>(n);
    s.on_pixels = arena.take<Entry>(n);
    s.weight = arena.take<float>(n);
    s.partial = arena.take<float>(n * bands);
  }
  float* image = arena.take<float>((int64_t)V * image_bx * image_by * kWidth);

  parallel(chunks, [&](int i) { prepare(c, p, (int64_t)i * kChunk, chunk_end(i, np)); });
  parallel(V * chunks, [&](int i) { project_chunk(c, p, i / chunks, (int64_t)(i % chunks) * kChunk, chunk_end(i % chunks, np)); });
  for (int v = 0; v < V; v++) {
    ViewState& s = c.views[v];
    if (!place_lattice(s, chunks)) { *culprit = v; return SG_LATTICE; }
    s.T = arena.take<float>((int64_t)s.ray_bx * s.ray_by * kWidth);
    s.last = arena.take<int32_t>((int64_t)s.ray_bx * s.ray_by * kWidth);
  }
  int most_rows = image_by;
  for (int v = 0; v < V; v++) most_rows = most(most_rows, c.views[v].ray_by);
  int64_t* work = arena.take<int64_t>((int64_t)V * (most_rows + 1));
  c.kept = arena.mark();

  parallel(V, [&](int v) { sort_by_depth(c.views[v], (int)n); });
  parallel(V * chunks, [&](int i) {
    ViewState& s = c.views[i / chunks];
    const int first = i % chunks * kChunk, end = (int)chunk_end(i % chunks, n);
    for (int k = first; k < end && k < s.touching; k++) {
      const int32_t id = (int32_t)(uint32_t)s.order[k];
      s.on_rays[k] = entry(s.rays, id, 0.5f + (float)s.k0x, 0.5f + (float)s.k0y, s.ray_columns, s.ray_rows);
      s.rank[id] = k;
    }
    for (int k = first; k < end; k++) s.on_pixels[k] = entry(s.pixels, k, 0.0f, 0.0f, p.columns, p.rows);
  });
  parallel(V, [&](int v) {
    ViewState& s = c.views[v];
    cut_bands(s.on_rays, s.touching, s.ray_by, s.ray_bands, bands, work + (int64_t)v * (most_rows + 1));
    cut_bands(s.on_pixels, (int)n, image_by, s.pixel_bands, bands, work + (int64_t)v * (most_rows + 1));
  });

  parallel(V * bands, [&](int i) {
    ViewState& s = c.views[i / bands];
    const int b = i % bands;
    attenuate_band(s.on_rays, s.touching, s.ray_bands[b], s.ray_bx, p.min_transmittance, s.T, s.last, s.partial + (int64_t)b * s.touching);
  });
  parallel(V * chunks, [&](int i) {
    const int v = i / chunks;
    ViewState& s = c.views[v];
    for (int64_t k = (int64_t)(i % chunks) * kChunk; k < chunk_end(i % chunks, n); k++) {
      const int rank = s.rank[k];
      float w = 0.0f;
      for (int b = 0; rank >= 0 && b < bands; b++)
        if (overlaps(s.on_rays[rank], s.ray_bands[b])) w += s.partial[(int64_t)b * s.touching + rank];
      s.weight[k] = w;
      const float lit = w * cell, sigma = s.phase[k] * lit;
      out->lit_area[v * n + k] = lit;
      out->cross_sections[v * n + k] = sigma;
      Entry& e = s.on_pixels[k];
      e.g.depth *= sigma;                                // the amplitude
      if (w == 0.0f) e.y1 = (int16_t)(e.y0 - 1);         // unlit: contributes nothing, forward or backward
    }
  });
  parallel(V * bands, [&](int i) {
    const int v = i / bands;
    const ViewState& s = c.views[v];
    const Band band = s.pixel_bands[i % bands];
    float* S = image + (int64_t)v * image_bx * image_by * kWidth;
    image_band(s.on_pixels, (int)n, band, image_bx, S);
    from_blocks(S, image_bx, p.rows, p.columns, band.first * kBlockY, band.end * kBlockY, out->images + (int64_t)v * p.rows * p.columns);
  });
  return SG_OK;
}

// ---- backward --------------------------------------------------------------------------------------------------------------
// six sums of up to kWidth Gaussians, transposed to vectors
Moments<F> gather(float lanes[6][kWidth]) {
  return {load(lanes[0]), load(lanes[1]), load(lanes[2]), load(lanes[3]), load(lanes[4]), load(lanes[5])};
}

struct Backward {                 // scratch of one backward pass, per view; h = dL/dsigma P A_c = dL/d(sum of w)
  float *d_sigma, *h, *ray_moments, *pixel_moments, *T, *B, *dS;
};

void differentiate(const sg_context& c, const sg_problem& p, const sg_gradients& g, const Backward* scratch, int64_t first,
                   int64_t end, float* shift_sums) {
  const PlaneUnits u = units(p);
  const float cell = p.ray[0] * p.ray[1];
  const int64_t n = p.gaussians;
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = (int)(n - i < kWidth ? n - i : kWidth);
    const Body<F> b = body(c, i);
    const F zero = splat(0.0f), kappa = load(c.kappa + i);
    BodyGradient<F> total;
    for (F& x : total.mean) x = zero;
    for (F& x : total.g) x = zero;
    for (F& x : total.scale) x = zero;
    for (F& x : total.rot) x = zero;
    total.kappa = zero;
    F d_harmonics[16];
    for (int k = 0; k < p.coefficients; k++) d_harmonics[k] = zero;
    for (int v = 0; v < p.views; v++) {
      const ViewState& s = c.views[v];
      alignas(64) float ray[6][kWidth] = {}, pixel[6][kWidth] = {}, d_sigma[kWidth] = {}, weight[kWidth] = {}, norm[kWidth] = {};
      for (int k = 0; k < real; k++) {
        const int64_t j = i + k;
        const int rank = s.rank[j];
        if (rank < 0 || s.weight[j] == 0.0f) continue;
        for (int band = 0; band < c.bands; band++) {
          if (!overlaps(s.on_rays[rank], s.ray_bands[band])) continue;
          const float* m = scratch[v].ray_moments + 6 * ((int64_t)band * s.touching + rank);
          for (int q = 0; q < 6; q++) ray[q][k] += m[q] * kLn2;   // tau is kept in units of log2(e)
        }
        for (int q = 0; q < 6; q++) pixel[q][k] = scratch[v].pixel_moments[6 * j + q];
        weight[k] = s.weight[j];
        norm[k] = s.pixels.depth[j];
        d_sigma[k] = scratch[v].d_sigma[j];
      }
      const Projection<F> proj = project(b, s.frame, u);
      const F lit = load(weight) * cell, phase = load(s.phase + i), amplitude = phase * lit * load(norm);
      Moments<F> mr = gather(ray), mp = gather(pixel);
      mp = {mp.m0 * amplitude, mp.mx * amplitude, mp.my * amplitude, mp.mxx * amplitude, mp.mxy * amplitude, mp.myy * amplitude};
      F planes[4];
      accumulate(proj, s.frame, u, mr, mp, p.peak != 0, total, planes);
      total.kappa += mr.m0;
      shift_sums[2 * v] += sum(planes[2]);
      shift_sums[2 * v + 1] += sum(planes[3]);
      if (g.planes)
        for (int k = 0; k < real; k++)
          for (int q = 0; q < 4; q++) g.planes[((int64_t)v * n + i + k) * 4 + q] = planes[q][k];
      const F d_phase = load(d_sigma) * lit;
      if (g.scattering)
        for (int k = 0; k < real; k++) g.scattering[(int64_t)v * n + i + k] = d_phase[k];
      if (p.coefficients) {
        const F soft = phase - p.p_min;                                       // d softplus = 1 - e^-softplus
        const F d_sum = d_phase * -power2_minus_one(power2_parts(larger(soft * -kLog2e, splat(-120.0f))));
        for (int k = 0; k < p.coefficients; k++) d_harmonics[k] += d_sum * p.basis[v * p.coefficients + k];
      }
    }
    F q[4], d_scale[3], d_quaternion[4];
    for (int k = 0; k < 4; k++) q[k] = load(c.unit[k] + i);
    finish(b, q, load(c.norm + i), total, d_scale, d_quaternion);
    const F d_kappa = choose(kappa > 0.0f, total.kappa / choose(kappa > 0.0f, kappa, splat(1.0f)), zero);
    for (int k = 0; k < real; k++) {
      for (int a = 0; a < 3; a++) { g.means[3 * (i + k) + a] = total.mean[a][k]; g.scales[3 * (i + k) + a] = d_scale[a][k]; }
      for (int a = 0; a < 4; a++) g.quaternions[4 * (i + k) + a] = d_quaternion[a][k];
      g.kappa[i + k] = d_kappa[k];
      for (int a = 0; a < p.coefficients; a++) g.harmonics[p.coefficients * (i + k) + a] = d_harmonics[a][k];
    }
  }
}

void backward(sg_context* context, const sg_problem* problem, const sg_gradients* gradients) {
  sg_context& c = *context;
  const sg_problem& p = *problem;
  const sg_gradients& g = *gradients;
  Arena& arena = c.arena;
  const int64_t n = p.gaussians, np = padded(n);
  const int V = p.views, bands = c.bands, chunks = blocks((int)n, kChunk);
  const int image_bx = blocks(p.columns, kBlockX), image_by = blocks(p.rows, kBlockY);
  const float cell = p.ray[0] * p.ray[1];
  auto chunk_end = [&](int64_t chunk, int64_t limit) { return (chunk + 1) * kChunk < limit ? (chunk + 1) * kChunk : limit; };

  Backward* scratch = arena.take<Backward>(V);
  for (int v = 0; v < V; v++) {
    const ViewState& s = c.views[v];
    const int64_t lanes = (int64_t)s.ray_bx * s.ray_by * kWidth;
    scratch[v] = {arena.take<float>(n), arena.take<float>(n), arena.take<float>(6 * (int64_t)bands * s.touching), arena.take<float>(6 * n),
                  arena.take<float>(lanes), arena.take<float>(lanes), arena.take<float>((int64_t)image_bx * image_by * kWidth)};
  }
  float* shift_sums = arena.take<float>((int64_t)chunks * 2 * V);
  for (int64_t i = 0; i < (int64_t)chunks * 2 * V; i++) shift_sums[i] = 0.0f;

  parallel(V * bands, [&](int i) {
    const int v = i / bands, first = image_by * (i % bands) / bands, end = image_by * (i % bands + 1) / bands;
    to_blocks(g.images + (int64_t)v * p.rows * p.columns, image_bx, p.rows, p.columns, first * kBlockY, end * kBlockY, scratch[v].dS);
  });
  parallel(V * chunks, [&](int i) {
    const int v = i / chunks, first = i % chunks * kChunk, end = (int)chunk_end(i % chunks, n);
    const ViewState& s = c.views[v];
    const Backward& w = scratch[v];
    image_backward(s.on_pixels, first, end, {0, image_by}, image_bx, w.dS, w.pixel_moments);
    for (int k = first; k < end; k++) {
      w.d_sigma[k] = w.pixel_moments[6 * (int64_t)k] * s.pixels.depth[k] + (g.cross_sections ? g.cross_sections[v * n + k] : 0.0f);
      w.h[k] = w.d_sigma[k] * s.phase[k] * cell;
    }
  });
  int64_t at = 0;  // of the view's lattice in dL/dT_end
  const float** from = arena.take<const float*>(V);
  for (int v = 0; v < V; v++) {
    from[v] = g.transmittance ? g.transmittance + at : nullptr;
    at += (int64_t)c.views[v].ray_rows * c.views[v].ray_columns;
  }
  parallel(V * bands, [&](int i) {
    const int v = i / bands, b = i % bands;
    const ViewState& s = c.views[v];
    const Backward& w = scratch[v];
    const Band band = s.ray_bands[b];
    const int64_t lane0 = (int64_t)band.first * s.ray_bx * kWidth, lane1 = (int64_t)band.end * s.ray_bx * kWidth;
    if (from[v]) to_blocks(from[v], s.ray_bx, s.ray_rows, s.ray_columns, band.first * kBlockY, band.end * kBlockY, w.B);
    for (int64_t k = lane0; k < lane1; k += kWidth) {
      const F t = load(s.T + k);
      store(w.T + k, t);
      store(w.B + k, from[v] ? t * load(w.B + k) : splat(0.0f));
    }
    attenuate_band_backward(s.on_rays, s.touching, band, s.ray_bx, w.h, w.T, s.last, w.B,
                            w.ray_moments + 6 * (int64_t)b * s.touching);
  });
  parallel(chunks, [&](int i) {
    differentiate(c, p, g, scratch, (int64_t)i * kChunk, chunk_end(i, np), shift_sums + (int64_t)i * 2 * V);
  });
  for (int k = 0; k < 2 * V; k++) {
    float total = 0.0f;
    for (int i = 0; i < chunks; i++) total += shift_sums[(int64_t)i * 2 * V + k];
    g.shift[k] = total;
  }
  arena.release(c.kept);
}

// ---- looking into a forward pass -------------------------------------------------------------------------------------------
void lattice(const sg_context* c, int32_t view, sg_lattice* out) {
  const ViewState& s = c->views[view];
  *out = {s.k0x, s.k0y, s.ray_rows, s.ray_columns};
}

// T_end and the range at which the two-way optical depth reaches `depth`, ray by ray; NaN where it never does
void trace(const sg_context* context, const sg_problem* p, int32_t view, float depth, float* transmittance, float* first_return) {
  const sg_context& c = *context;
  const ViewState& s = c.views[view];
  const int64_t rays = (int64_t)s.ray_rows * s.ray_columns;
  from_blocks(s.T, s.ray_bx, s.ray_rows, s.ray_columns, 0, s.ray_rows, transmittance);
  float* sum_tau = (float*)std::malloc(sizeof(float) * (rays + 1));
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

sg_context* create() { return new sg_context(); }
void destroy(sg_context* c) { delete c; }

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat

#define SG_JOIN_(a, b) a##b
#define SG_JOIN(a, b) SG_JOIN_(a, b)
#define SG_TEXT_(a) #a
#define SG_TEXT(a) SG_TEXT_(a)
extern "C" const sg_engine SG_JOIN(sg_engine_, SG_ISA);
const sg_engine SG_JOIN(sg_engine_, SG_ISA) = {SG_TEXT(SG_ISA), create, destroy, forward, backward, lattice, trace, statistics};
