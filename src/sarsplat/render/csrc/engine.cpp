// engine.cpp: a batch of views, forward and backward. Compiled once per instruction set.
//
// forward:  check -> bodies, scattering, projection -> lattice -> depth order, bands -> pass A -> cross-sections -> pass B
// backward: pass B (gather per Gaussian) -> pass A (back to front) -> adjoint of the projection, views summed in order
//
// Every stage is a set of independent tasks whose number and order of summation depend on the problem alone, never on
// the number of threads: results are bit-identical for any.

#include "adam.h"
#include "arrange.h"
#include "context.h"
#include "differentiate.h"
#include "inspect.h"
#include "loss.h"
#include "parallel.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

int64_t chunk_end(int64_t chunk, int64_t limit) { return (chunk + 1) * kChunk < limit ? (chunk + 1) * kChunk : limit; }
int chunks_of(int64_t n) { return (int)((n + kChunk - 1) / kChunk); }

int32_t forward(sg_context* context, const sg_problem* problem, const sg_outputs* out, int64_t* culprit) {
  sg_context& c = *context;
  const sg_problem& p = *problem;
  if (const int32_t status = check(p, culprit)) return status;
  Arena& arena = c.arena;
  arena.reset();
  const int64_t n = p.gaussians, np = padded(n);
  const int V = p.views, chunks = chunks_of(n), bands = c.bands = most(1, least(kMostBands, kTasks / most(V, 1)));
  const float cell = p.ray[0] * p.ray[1];

  auto out_of_memory = [&] { arena.give_back(); return SG_MEMORY; };
  c.views = arena.take<ViewState>(V);
  if (arena.failed()) return out_of_memory();
  float** const fields[] = {&c.mean[0], &c.mean[1], &c.mean[2], &c.scale[0], &c.scale[1], &c.scale[2],
                            &c.unit[0], &c.unit[1], &c.unit[2], &c.unit[3], &c.norm, &c.kappa};
  for (float** field : fields) *field = arena.take<float>(np);
  for (int k = 0; k < 9; k++) c.rot[k] = arena.take<float>(np);
  for (int v = 0; v < V; v++) {
    ViewState& s = c.views[v];
    for (int k = 0; k < 9; k++) s.frame.r[k] = p.frames[9 * v + k];
    s.on_rays = arena.take<Entry>(n);
    s.on_pixels = arena.take<Entry>(n);
    s.range = arena.take<float>(np);
    s.phase = arena.take<float>(np);
    s.norm = arena.take<float>(np);
    s.weight = arena.take<float>(n);
    s.bounds = arena.take<Bounds>(chunks);
    s.order = arena.take<uint64_t>(n);
    s.order_spare = arena.take<uint64_t>(n);
    s.ray_lists.ids = arena.take<int32_t>(n * bands);
    s.pixel_lists.ids = arena.take<int32_t>(n * bands);
    s.partial = arena.take<float>(n * bands);
    s.pixels = {0, 0, p.columns, p.rows, bands_of(p.rows, bands), {}};
  }
  float* images = arena.take<float>(V ? V * c.views[0].pixels.size() : 0);
  if (arena.failed()) return out_of_memory();

  parallel(chunks, [&](int i) {
    const int64_t first = (int64_t)i * kChunk, end = chunk_end(i, np);
    prepare(c, p, first, end);
    scatter_chunk(c, p, first, end);
    for (int v = 0; v < V; v++) project_chunk(c, p, v, first, end);
  });
  int most_rows = p.rows;
  for (int v = 0; v < V; v++) {
    ViewState& s = c.views[v];
    if (!place_lattice(s, chunks, bands)) { *culprit = v; return SG_LATTICE; }
    s.T = arena.take<float>(s.rays.size());
    s.stop = arena.take<int32_t>(s.rays.size());
    most_rows = most(most_rows, s.rays.rows);
  }
  int64_t* work = arena.take<int64_t>((int64_t)2 * V * (most_rows + 1));
  if (arena.failed()) return out_of_memory();
  c.kept = arena.mark();

  parallel(2 * V, [&](int i) {
    ViewState& s = c.views[i / 2];
    int64_t* rows = work + (int64_t)i * (most_rows + 1);
    if (i % 2) {
      plan(s.pixels, s.on_pixels, (int)n, nullptr, (int)n, s.pixel_lists, rows);
    } else {
      sort_by_depth(s, (int)n);
      plan(s.rays, s.on_rays, (int)n, s.order, s.touching, s.ray_lists, rows);
    }
  });
  parallel(V * bands, [&](int i) {
    ViewState& s = c.views[i / bands];
    const int b = i % bands;
    if (b >= s.rays.bands) return;
    const int first = s.ray_lists.first[b];
    attenuate_band(s.on_rays, s.ray_lists.ids + first, s.ray_lists.first[b + 1] - first, s.rays, b, p.min_transmittance,
                   s.T + s.rays.start(b), s.stop + s.rays.start(b), s.partial);
  });
  parallel(V * chunks, [&](int i) {
    const int v = i / chunks;
    ViewState& s = c.views[v];
    for (int64_t k = (int64_t)(i % chunks) * kChunk; k < chunk_end(i % chunks, n); k++) {
      const Entry& e = s.on_rays[k];
      float w = 0.0f;
      for (int slot = e.slot; slot <= e.slot + e.last_band - e.first_band; slot++) w += s.partial[slot];
      const float lit = w * cell, sigma = s.phase[k] * lit;
      s.weight[k] = w;
      out->lit_area[v * n + k] = lit;
      out->cross_sections[v * n + k] = sigma;
      s.on_pixels[k].g.depth = sigma * s.norm[k];
    }
  });
  parallel(V * bands, [&](int i) {
    const int v = i / bands, b = i % bands;
    const ViewState& s = c.views[v];
    if (b >= s.pixels.bands) return;
    float* strips = images + v * s.pixels.size();
    const int first = s.pixel_lists.first[b];
    image_band(s.on_pixels, s.pixel_lists.ids + first, s.pixel_lists.first[b + 1] - first, s.pixels, b, strips + s.pixels.start(b));
    copy_rows(s.pixels, b, strips + s.pixels.start(b), out->images + (int64_t)v * p.rows * p.columns);
  });
  return SG_OK;
}

int32_t backward(sg_context* context, const sg_problem* problem, const sg_gradients* gradients) {
  sg_context& c = *context;
  const sg_problem& p = *problem;
  const sg_gradients& g = *gradients;
  Arena& arena = c.arena;
  const int64_t n = p.gaussians, np = padded(n);
  const int V = p.views, chunks = chunks_of(n), bands = c.bands;
  const float cell = p.ray[0] * p.ray[1];

  auto out_of_memory = [&] { arena.release(c.kept); return SG_MEMORY; };
  Backward* scratch = arena.take<Backward>(V);
  const float** from = arena.take<const float*>(V);
  if (arena.failed()) return out_of_memory();
  const Strips whole{0, 0, p.columns, p.rows, 1, {{0, p.rows}}};  // the image as one band
  for (int v = 0; v < V; v++) {
    const ViewState& s = c.views[v];
    scratch[v] = {arena.take<float>(n), arena.take<float>(n), arena.take<float>(6 * n * s.rays.bands), arena.take<float>(6 * n),
                  arena.take<float>(s.rays.size()), arena.take<float>(s.rays.size()), arena.take<float>(whole.size())};
  }
  float* shift_sums = arena.take<float>((int64_t)chunks * 2 * V);
  if (arena.failed()) return out_of_memory();
  for (int64_t i = 0; i < (int64_t)chunks * 2 * V; i++) shift_sums[i] = 0.0f;

  parallel(V, [&](int v) {
    float* dS = scratch[v].dS;
    for (int64_t i = 0; i < whole.size(); i++) dS[i] = 0.0f;
    for (int y = 0; y < p.rows; y++)
      for (int x = 0; x < p.columns; x++) dS[whole.at(0, x, y)] = g.images[((int64_t)v * p.rows + y) * p.columns + x];
  });
  parallel(V * chunks, [&](int i) {
    const int v = i / chunks;
    const ViewState& s = c.views[v];
    const Backward& w = scratch[v];
    const Lanes lanes;
    for (int64_t k = (int64_t)(i % chunks) * kChunk; k < chunk_end(i % chunks, n); k++) {
      float* moments = w.pixel_moments + 6 * k;
      if (s.weight[k] != 0.0f) image_backward(s.on_pixels[k], whole, lanes, w.dS, moments);
      else for (int q = 0; q < 6; q++) moments[q] = 0.0f;
      w.d_sigma[k] = moments[0] * s.norm[k] + (g.cross_sections ? g.cross_sections[v * n + k] : 0.0f);
      w.h[k] = w.d_sigma[k] * s.phase[k] * cell;
    }
  });
  int64_t at = 0;  // of the view's lattice in dL/dT_end
  for (int v = 0; v < V; v++) {
    from[v] = g.transmittance ? g.transmittance + at : nullptr;
    at += (int64_t)c.views[v].rays.rows * c.views[v].rays.columns;
  }
  parallel(V * bands, [&](int i) {
    const int v = i / bands, b = i % bands;
    const ViewState& s = c.views[v];
    const Strips& rays = s.rays;
    if (b >= rays.bands) return;
    const int64_t start = rays.start(b), size = rays.size(b);
    float *T = scratch[v].T + start, *B = scratch[v].B + start;
    for (int64_t k = 0; k < size; k++) { T[k] = s.T[start + k]; B[k] = 0.0f; }
    for (int y = rays.band[b].first; from[v] && y < rays.band[b].end; y++) {
      const float* row = from[v] + (int64_t)(y - rays.y0) * rays.columns;
      for (int x = 0; x < rays.columns; x++) {
        const int64_t at_ray = rays.at(b, rays.x0 + x, y);
        B[at_ray] = T[at_ray] * row[x];
      }
    }
    const int first = s.ray_lists.first[b];
    attenuate_band_backward(s.on_rays, s.ray_lists.ids + first, s.ray_lists.first[b + 1] - first, rays, b, scratch[v].h, T,
                            s.stop + start, B, scratch[v].ray_moments);
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
const sg_engine SG_JOIN(sg_engine_, SG_ISA) = {SG_TEXT(SG_ISA), create, destroy, forward, backward, lattice, trace, amplitude_loss, adam, statistics};
