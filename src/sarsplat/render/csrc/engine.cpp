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
#include "project.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

int64_t chunk_end(int64_t chunk, int64_t limit) { return (chunk + 1) * kChunk < limit ? (chunk + 1) * kChunk : limit; }
int chunks_of(int64_t n) { return most(1, (int)((n + kChunk - 1) / kChunk)); }

int32_t forward_stages(sg_context* context, const sg_problem* problem, const sg_outputs* out, int64_t* culprit) {
  sg_context& c = *context;
  const sg_problem& p = *problem;
  Arena& arena = c.arena;
  arena.reset();
  const int64_t n = p.gaussians, np = padded(n);
  const int V = p.views, chunks = chunks_of(n), parts = c.parts = most(1, least(kMostParts, kTasks / most(V, 1)));
  const float cell = p.ray[0] * p.ray[1];
  const int row_tasks = (p.rows + kRowsPerTask - 1) / kRowsPerTask;

  auto out_of_memory = [&] { arena.give_back(); return SG_MEMORY; };
  c.views = arena.take<ViewState>(V);
  c.image = {0, 0, p.columns, p.rows, nullptr, nullptr};
  float* ruler = arena.take<float>(c.image.ruler());
  if (arena.failed()) return out_of_memory();
  c.image.mark(ruler);
  Fault* faults = arena.take<Fault>(chunks);
  for (int v = 0; v < V; v++) {
    ViewState& s = c.views[v];
    for (int k = 0; k < 9; k++) s.frame.r[k] = p.frames[9 * v + k];
    s.on_rays = arena.take<RayEntry>(n);
    s.on_pixels = arena.take<PixelEntry>(n);
    s.depth_keys = arena.take<int32_t>(np);
    s.bounds = arena.take<Bounds>(chunks);
    s.order = arena.take<uint64_t>(n);
    s.order_spare = arena.take<uint64_t>(n);
    s.reached = arena.take<Reached>(n);
    s.pixel_keys = arena.take<int32_t>(np);
    s.pixel_list = arena.take<int32_t>(n);
    s.ray_list = arena.take<int32_t>(n * parts);
    s.partial = arena.take<float>(n * parts);
  }
  if (arena.failed()) return out_of_memory();

  parallel(chunks, [&](int i) {
    const int64_t first = (int64_t)i * kChunk, end = chunk_end(i, n);
    faults[i] = check(p, first, end);
    if (faults[i].status == SG_OK) project_chunk(c, p, i, first, end);
  });
  Fault fault{SG_OK, -1};
  for (int i = 0; i < chunks; i++)
    if (faults[i].status && (!fault.status || faults[i].status < fault.status)) fault = faults[i];
  if (fault.status) { *culprit = fault.index; return fault.status; }
  for (int v = 0; v < V; v++) {
    ViewState& s = c.views[v];
    if (!place_lattice(s, chunks)) { *culprit = v; return SG_LATTICE; }
    s.rays.mark(arena.take<float>(s.rays.ruler()));
    s.T = arena.take<float>(size_with_spare_rows(s.rays, parts));
    s.stop = arena.take<int32_t>(size_with_spare_rows(s.rays, parts));
    s.rows = arena.take<int64_t>(s.rays.rows + 1);
    s.counts = arena.take<int32_t>((int64_t)p.rows * kShapes * kShapes + 1);
  }
  if (arena.failed()) return out_of_memory();

  parallel(3 * V, [&](int i) {
    ViewState& s = c.views[i % V];
    if (i / V == 0) sort_by_depth(s, (int)n);
    else if (i / V == 1) cut_rays(s, (int)n, parts, s.rows);
    else cut_pixels(s, c.image, (int)n, parts, s.counts);
  });
  c.kept = arena.mark();
  for (int v = 0; v < V; v++) {
    ViewState& s = c.views[v];
    for (int b = 0; b < s.pixel_parts; b++) s.pixel_groups[b].memory = arena.take<float>(s.pixel_groups[b].strips.size());
  }
  if (arena.failed()) return out_of_memory();
  parallel(V * parts, [&](int i) {
    ViewState& s = c.views[i / parts];
    const int b = i % parts;
    if (b >= s.ray_parts) return;
    Part& band = s.ray_bands[b];
    band.first = b * (int)n;
    band.end = band.first + list_band(s, b, s.ray_list + band.first);
    attenuate_band(s.on_rays, s.ray_list + band.first, band.count(), band.strips, b, least_log_tau(p), p.min_transmittance,
                   s.T + band.start, s.stop + band.start, s.partial);
  });
  parallel(V * chunks, [&](int i) {
    const int v = i / chunks;
    ViewState& s = c.views[v];
    for (int64_t k = (int64_t)(i % chunks) * kChunk; k < chunk_end(i % chunks, n); k++) {
      const RayEntry& e = s.on_rays[k];
      PixelEntry& pixel = s.on_pixels[k];
      float w = 0.0f;
      for (int slot = e.slot; slot <= e.slot + e.last_band - e.first_band; slot++) w += s.partial[slot];
      const float lit = w * cell, sigma = pixel.phase * lit;
      out->lit_area[v * n + k] = pixel.lit = lit;
      out->cross_sections[v * n + k] = sigma;
      pixel.g.height = sigma * pixel.norm;
    }
  });
  parallel(V * parts, [&](int i) {
    const ViewState& s = c.views[i / parts];
    if (i % parts >= s.pixel_parts) return;
    const Part& part = s.pixel_groups[i % parts];
    image_part(s.on_pixels, s.pixel_list + part.first, part.count(), part.strips, image_cut(p), part.memory);
  });
  parallel(V * row_tasks, [&](int i) {  // in the order of the parts
    const int v = i / row_tasks, first = i % row_tasks * kRowsPerTask;
    add_parts(c.views[v], first, least(p.rows, first + kRowsPerTask), p.columns, out->images + (int64_t)v * p.rows * p.columns);
  });
  arena.release(c.kept);
  return SG_OK;
}

int32_t backward_stages(sg_context* context, const sg_problem* problem, const sg_gradients* gradients) {
  sg_context& c = *context;
  const sg_problem& p = *problem;
  const sg_gradients& g = *gradients;
  Arena& arena = c.arena;
  const int64_t n = p.gaussians, np = padded(n);
  const int V = p.views, chunks = chunks_of(n), parts = c.parts;
  const float cell = p.ray[0] * p.ray[1];

  auto out_of_memory = [&] { arena.release(c.kept); return SG_MEMORY; };
  Backward* scratch = arena.take<Backward>(V);
  const float** from = arena.take<const float*>(V);
  if (arena.failed()) return out_of_memory();
  const Strips& whole = c.image;
  for (int v = 0; v < V; v++) {
    const ViewState& s = c.views[v];
    const int64_t rays = size_with_spare_rows(s.rays, parts);
    scratch[v] = {arena.take<float>(kSums * n * s.ray_parts), arena.take<float>(kSums * n),
                  arena.take<float>(rays), arena.take<float>(rays), arena.take<float>(whole.size())};
  }
  float* shift_sums = arena.take<float>((int64_t)chunks * 2 * V);
  if (arena.failed()) return out_of_memory();
  for (int64_t i = 0; i < (int64_t)chunks * 2 * V; i++) shift_sums[i] = 0.0f;

  const int groups = (whole.count() + kStripsPerTask - 1) / kStripsPerTask;
  parallel(V * groups, [&](int i) {
    const int first = i % groups * kStripsPerTask, end = least(whole.count(), first + kStripsPerTask);
    write_strips(whole, first, end, g.images + (int64_t)(i / groups) * p.rows * p.columns, scratch[i / groups].dS);
  });
  parallel(V * parts, [&](int i) {
    const int v = i / parts;
    const ViewState& s = c.views[v];
    if (i % parts >= s.pixel_parts) return;
    const Backward& w = scratch[v];
    const Part& part = s.pixel_groups[i % parts];
    for (int k = part.first; k < part.end; k++) {
      const int32_t id = s.pixel_list[k];
      __builtin_prefetch(s.on_pixels + s.pixel_list[least(k + kAhead, part.end - 1)]);
      const PixelEntry& e = s.on_pixels[id];
      Eight moments = e.lit == 0.0f ? (Eight)(0.0f) : image_backward(e, c.image, image_cut(p), w.dS);
      const float d_sigma = moments[0] * e.norm + (g.cross_sections ? g.cross_sections[v * n + id] : 0.0f);
      s.on_rays[id].h = d_sigma * e.phase * cell;
      moments *= e.g.height;
      moments[6] = d_sigma * e.lit;
      moments[7] = e.phase;
      store_eight(w.pixel_moments + kSums * (int64_t)id, moments);
    }
  });
  int64_t at = 0;  // of the view's lattice in dL/dT_end
  for (int v = 0; v < V; v++) {
    from[v] = g.transmittance ? g.transmittance + at : nullptr;
    at += (int64_t)c.views[v].rays.rows * c.views[v].rays.columns;
  }
  parallel(V * parts, [&](int i) {
    const int v = i / parts, b = i % parts;
    const ViewState& s = c.views[v];
    if (b >= s.ray_parts) return;
    const Part& band = s.ray_bands[b];
    const Strips& rays = band.strips;
    float *T = scratch[v].T + band.start, *B = scratch[v].B + band.start;
    for (int64_t k = 0; k < rays.size(); k++) { T[k] = s.T[band.start + k]; B[k] = 0.0f; }
    for (int y = rays.y0; from[v] && y < rays.y0 + rays.rows; y++) {
      const float* row = from[v] + (int64_t)(y - s.rays.y0) * rays.columns;
      for (int x = 0; x < rays.columns; x++) {
        const int64_t at_ray = rays.at(rays.x0 + x, y);
        B[at_ray] = T[at_ray] * row[x];
      }
    }
    attenuate_band_backward(s.on_rays, s.ray_list + band.first, band.count(), rays, b, least_log_tau(p), T,
                            s.stop + band.start, B, scratch[v].ray_moments);
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

int32_t forward(sg_context* context, const sg_problem* problem, const sg_outputs* out, int64_t* culprit) {
  int32_t status = SG_OK;
  together([&] { status = forward_stages(context, problem, out, culprit); });
  return status;
}

int32_t backward(sg_context* context, const sg_problem* problem, const sg_gradients* gradients) {
  int32_t status = SG_OK;
  together([&] { status = backward_stages(context, problem, gradients); });
  return status;
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
