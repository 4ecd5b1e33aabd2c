// engine.cpp: a batch of views, forward and backward. Compiled once per instruction set.
//
// forward:  check -> bodies -> project -> lattice, depth order -> pass A -> cross-sections -> pass B
// backward: pass B (gather per Gaussian) -> pass A (back to front) -> adjoint of the projection, views summed in order
//
// Every stage is a set of independent tasks whose number and order of summation depend on the problem alone, never on
// the number of threads: results are bit-identical for any.
#include "arrange.h"
#include "context.h"
#include "differentiate.h"
#include "inspect.h"
#include "parallel.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

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

  auto out_of_memory = [&] { arena.give_back(); return SG_MEMORY; };
  c.views = arena.take<ViewState>(V);
  if (arena.failed()) return out_of_memory();
  float** const fields[] = {&c.mean[0], &c.mean[1], &c.mean[2], &c.scale[0], &c.scale[1], &c.scale[2],
                            &c.unit[0], &c.unit[1], &c.unit[2], &c.unit[3], &c.norm, &c.kappa};
  for (float** field : fields) *field = arena.take<float>(np);
  for (int k = 0; k < 9; k++) c.rot[k] = arena.take<float>(np);
  for (int k = 0; k < p.coefficients; k++) c.harmonics[k] = arena.take<float>(np);
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
  if (arena.failed()) return out_of_memory();

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
  if (arena.failed()) return out_of_memory();
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

int32_t backward(sg_context* context, const sg_problem* problem, const sg_gradients* gradients) {
  sg_context& c = *context;
  const sg_problem& p = *problem;
  const sg_gradients& g = *gradients;
  Arena& arena = c.arena;
  const int64_t n = p.gaussians, np = padded(n);
  const int V = p.views, bands = c.bands, chunks = blocks((int)n, kChunk);
  const int image_bx = blocks(p.columns, kBlockX), image_by = blocks(p.rows, kBlockY);
  const float cell = p.ray[0] * p.ray[1];
  auto chunk_end = [&](int64_t chunk, int64_t limit) { return (chunk + 1) * kChunk < limit ? (chunk + 1) * kChunk : limit; };

  auto out_of_memory = [&] { arena.release(c.kept); return SG_MEMORY; };
  Backward* scratch = arena.take<Backward>(V);
  const float** from = arena.take<const float*>(V);
  if (arena.failed()) return out_of_memory();
  for (int v = 0; v < V; v++) {
    const ViewState& s = c.views[v];
    const int64_t lanes = (int64_t)s.ray_bx * s.ray_by * kWidth;
    scratch[v] = {arena.take<float>(n), arena.take<float>(n), arena.take<float>(6 * (int64_t)bands * s.touching), arena.take<float>(6 * n),
                  arena.take<float>(lanes), arena.take<float>(lanes), arena.take<float>((int64_t)image_bx * image_by * kWidth)};
  }
  float* shift_sums = arena.take<float>((int64_t)chunks * 2 * V);
  if (arena.failed()) return out_of_memory();
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
  return SG_OK;
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
