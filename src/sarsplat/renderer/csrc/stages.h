// stages.h: what a pass is made of, forward and backward, over all views: a whole pass and the steps alone are composed of
// the same stages (engine.cpp, steps.h).
//
// Every stage is a set of independent tasks whose number and order of summation depend on the problem alone, never on
// the number of threads: results are bit-identical for any.
#pragma once
#include "arrange.h"
#include "batches.h"
#include "parallel.h"
#include "project.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// task(view, first, end) for the chunks of all views; task(view, part) for the parts that a plane is cut into
template <class Task> void over_chunks(const sg_problem& p, Task task) {
  const int chunks = chunks_of(p.gaussians);
  parallel(p.views * chunks, [&](int i) { task(i / chunks, (int64_t)(i % chunks) * kChunk, chunk_end(i % chunks, p.gaussians)); });
}
template <class Task> void over_parts(const sg_context& c, const sg_problem& p, int ViewState::*parts, Task task) {
  parallel(p.views * c.parts, [&](int i) { if (i % c.parts < c.views[i / c.parts].*parts) task(i / c.parts, i % c.parts); });
}

int32_t out_of_memory(sg_context& c) {
  c.arena.give_back();
  return SG_MEMORY;
}

// ---- before the pair loops ---------------------------------------------------------------------------------------------
enum Planes { kNone = 0, kRays = 1, kPixels = 2 };

// Room for the footprints of all views on these planes.
int32_t begin(sg_context& c, const sg_problem& p, int planes) {
  Arena& arena = c.arena;
  arena.reset();
  const int n = p.gaussians, chunks = chunks_of(n);
  c.parts = parts_of(p);
  c.image = {0, 0, p.columns, p.rows, nullptr, nullptr};
  c.views = arena.take<ViewState>(p.views);
  c.faults = arena.take<Fault>(p.views * chunks);
  float* ruler = arena.take<float>(c.image.ruler());
  if (arena.failed()) return out_of_memory(c);
  c.image.mark(ruler);
  for (int v = 0; v < p.views; v++) {
    if (planes & kRays) c.views[v].take_on_rays(arena, n, chunks, c.parts);
    if (planes & kPixels) c.views[v].take_on_pixels(arena, n, p.rows);
  }
  return arena.failed() ? out_of_memory(c) : SG_OK;
}

// From footprints to tasks: lattices, depth order, parts. Here ends what is kept for the backward pass.
int32_t arrange(sg_context& c, const sg_problem& p, int planes, int64_t* culprit) {
  const int V = p.views, n = p.gaussians;
  for (int v = 0; v < V && planes & kRays; v++) {
    if (!place_lattice(c.views[v], chunks_of(n))) { *culprit = v; return SG_LATTICE; }
    c.views[v].take_per_ray(c.arena, c.parts);
  }
  if (c.arena.failed()) return out_of_memory(c);
  parallel(3 * V, [&](int i) {
    ViewState& s = c.views[i % V];
    if (i >= 2 * V) { if (planes & kPixels) cut_pixels(s, c.image, n, c.parts); }
    else if (!(planes & kRays)) return;
    else if (i < V) sort_by_depth(s, n);
    else cut_rays(s, n, c.parts);
  });
  c.kept = c.arena.mark();
  return SG_OK;
}

// ---- computation plane -------------------------------------------------------------------------------------------------
// T with which rays begin, of other lattices one after the other; beyond these, and without any, it is 1.
struct Beginnings {
  const float* transmittance;
  const sg_lattice* lattices;     // [V]

  // visit(index in a band of a view, index among the others' rays) where there are both
  template <class Visit> void each(int v, const Strips& band, Visit visit) const {
    if (!transmittance) return;
    int64_t before = 0;           // rays of the views before this one
    for (int u = 0; u < v; u++) before += (int64_t)lattices[u].rows * lattices[u].columns;
    const sg_lattice& l = lattices[v];
    const int left = larger(band.x0, (int)l.k0x), right = smaller(band.x0 + band.columns, (int)l.k0x + l.columns);
    const int top = larger(band.y0, (int)l.k0y), bottom = smaller(band.y0 + band.rows, (int)l.k0y + l.rows);
    for (int y = top; y < bottom; y++)
      for (int x = left; x < right; x++) visit(band.at(x, y), before + (y - l.k0y) * l.columns + (x - l.k0x));
  }
};

void attenuate_rays(const sg_context& c, const sg_problem& p, const Beginnings& from) {
  over_parts(c, p, &ViewState::ray_parts, [&](int v, int b) {
    const ViewState& s = c.views[v];
    Part& band = c.views[v].ray_bands[b];
    band.first = b * p.gaussians;
    band.end = band.first + list_band(s, b, s.ray_list + band.first);
    float* T = s.T + band.start;
    int32_t* stop = s.stop + band.start;
    begin_rays(band.strips, T, stop);
    from.each(v, band.strips, [&](int64_t at, int64_t other) {
      T[at] = from.transmittance[other];
      if (T[at] < p.min_transmittance) stop[at] = -1;
    });
    const auto loops = s.in_batches() ? attenuate_in_batches : attenuate_band;
    loops(s.on_rays, s.ray_list + band.first, band.count(), band.strips, b, min_log_tau(p), p.min_transmittance, T, stop, s.partial);
  });
}

// From the sums of w to the lit area.
SG_FN float lit_area_of(const ViewState& s, const sg_problem& p, int64_t i) {
  const RayEntry& ray = s.on_rays[i];
  float w = 0.0f;
  for (int slot = ray.slot; slot <= ray.slot + ray.last_band - ray.first_band; slot++) w += s.partial[slot];
  return w * (p.ray[0] * p.ray[1]);
}

struct Backward {                 // scratch of one backward pass, per view: rows of kSums
  float* ray_moments;             // by slot
  float* pixel_moments;           // by id; times the amplitude, then dL/dP(u) and the slope of P(u)
  float *T, *B, *dS;
  float* sections;                // dL/dsigma [N, C]; null if one group of channels needs no more than it has at hand
  float* elevation;               // [N, 3] sums of dL/d(elevation) times 1, u and v; null where no phase changes
};

// dL/dw is in the entries; d_transmittance: of the views' lattices one after the other, or null. d_from: out, of where rays began,
// zero where none did.
int32_t attenuate_rays_backward(sg_context& c, const sg_problem& p, const float* d_transmittance, Backward* scratch, const Beginnings& from,
                                float* d_from) {
  for (int v = 0; v < p.views; v++) {
    const ViewState& s = c.views[v];
    scratch[v].ray_moments = c.arena.take<float>(kSums * (int64_t)p.gaussians * s.ray_parts);
    scratch[v].T = c.arena.take<float>(size_in_bands(s.rays, c.parts));
    scratch[v].B = c.arena.take<float>(size_in_bands(s.rays, c.parts));
  }
  if (c.arena.failed()) return SG_MEMORY;
  over_parts(c, p, &ViewState::ray_parts, [&](int v, int b) {
    const ViewState& s = c.views[v];
    const Part& band = s.ray_bands[b];
    const Strips& rays = band.strips;
    int64_t before = 0;           // rays of the views before this one
    for (int u = 0; u < v; u++) before += (int64_t)c.views[u].rays.rows * c.views[u].rays.columns;
    float *T = scratch[v].T + band.start, *B = scratch[v].B + band.start;
    for (int64_t k = 0; k < rays.size(); k++) { T[k] = s.T[band.start + k]; B[k] = 0.0f; }
    for (int y = rays.y0; d_transmittance && y < rays.y0 + rays.rows; y++)
      for (int x = 0; x < rays.columns; x++) {
        const int64_t at = rays.at(rays.x0 + x, y);
        B[at] = T[at] * d_transmittance[before + (int64_t)(y - s.rays.y0) * rays.columns + x];
      }
    const auto loops = s.in_batches() ? attenuate_in_batches_backward : attenuate_band_backward;
    loops(s.on_rays, s.ray_list + band.first, band.count(), rays, b, min_log_tau(p), T, s.stop + band.start, B, scratch[v].ray_moments);
    from.each(v, rays, [&](int64_t at, int64_t other) {
      const float begun = from.transmittance[other];
      d_from[other] = begun >= p.min_transmittance ? B[at] / begun : 0.0f;
    });
  });
  return SG_OK;
}

// ---- imaging plane -----------------------------------------------------------------------------------------------------
// C channels [V, N, C] of all views
struct Channels {
  int count;
  const float *amplitudes, *wavenumbers;  // [V, C / 2], or null
  Amplitudes of(int64_t v, int64_t n) const {
    return {count == 1 ? nullptr : amplitudes + v * n * count, count, wavenumbers ? wavenumbers + v * (count / 2) : nullptr};
  }
};

// Rows of an image, the `channel`th of a view: what its parts hold, in their order.
void add_parts(const ViewState& s, int channel, int first, int end, int columns, float* image) {
  std::memset(image + (int64_t)first * columns, 0, sizeof(float) * (end - first) * columns);
  for (int b = 0; b < s.pixel_parts; b++) {
    const Part& part = s.pixel_groups[b];
    const Strips& r = part.strips;
    const int top = larger(first, r.y0), bottom = smaller(end, r.y0 + r.rows);
    for (int x = 0; x < columns && top < bottom; x += kBlockX) {
      const float* from = part.memory + channel * r.size() + r.at(x, top);
      float* to = image + (int64_t)top * columns + x;
      const int some = smaller(kBlockX, columns - x);
      for (int y = top; y < bottom; y++, from += kBlockX, to += columns)
        for (int k = 0; k < some; k++) to[k] += from[k];
    }
  }
}

int32_t splat_images(sg_context& c, const sg_problem& p, const Channels& channels, float* images) {
  const int C = channels.count, n = p.gaussians;
  for (int v = 0; v < p.views; v++) c.views[v].take_images(c.arena, C);
  if (c.arena.failed()) return out_of_memory(c);
  over_parts(c, p, &ViewState::pixel_parts, [&](int v, int b) {
    const ViewState& s = c.views[v];
    const Part& part = s.pixel_groups[b];
    for_channels(C, [&](int first, auto count) {
      auto to_images = [&](auto image) {
        image(s.on_pixels, s.pixel_list + part.first, part.count(), part.strips, channels.of(v, n).from(first), image_cut(p),
              part.memory + first * part.strips.size());
      };
      if constexpr (count % 2 == 0) {
        if (channels.wavenumbers) return to_images(wave_part<count>);
      }
      to_images(image_part<count>);
    });
  });
  const int groups = tasks_of(p.rows, kRowsPerTask);
  parallel(p.views * C * groups, [&](int i) {
    const int64_t image = i / groups;
    const int first = i % groups * kRowsPerTask;
    add_parts(c.views[image / C], (int)(image % C), first, smaller(p.rows, first + kRowsPerTask), p.columns, images + image * p.rows * p.columns);
  });
  c.arena.release(c.kept);
  return SG_OK;
}

// An image to strips, whose spare rows are zero.
void write_strips(const Strips& s, int first, int end, const float* image, float* strips) {
  for (int i = first; i < end; i++) {
    float* strip = strips + (int64_t)i * s.height() * kBlockX;
    const int x = i * kBlockX, some = smaller(kBlockX, s.columns - x);
    std::memset(strip, 0, sizeof(float) * s.height() * kBlockX);
    for (int y = 0; y < s.rows; y++) std::memcpy(strip + y * kBlockX, image + (int64_t)y * s.columns + x, sizeof(float) * some);
  }
}

// dL/dS of C channels from one on to dL/dsigma (to which `seeds` is added) and moments of the Gaussians of a part; what follows
// from those of all channels is left to finish(id, entry, moments, dL/dsigma), once.
template <int C, class Finish>
void image_part_backward(const ViewState& s, const Part& part, const Strips& image, const Amplitudes& a, float cut, const float* dS,
                         const float* seeds, int first, bool last, float* sections, float* elevation, float* moments, Finish finish) {
  for (int k = part.first; k < part.end; k++) {
    const int32_t ahead = s.pixel_list[smaller(k + kAhead, part.end - 1)], id = s.pixel_list[k];
    __builtin_prefetch(s.on_pixels + ahead);
    __builtin_prefetch(s.on_rays + ahead, 1);
    __builtin_prefetch(moments + kSums * (int64_t)ahead, 1);
    if (C > 1) __builtin_prefetch(a.first + a.stride * ahead);
    const PixelEntry& e = s.on_pixels[id];
    float* row = moments + kSums * (int64_t)id;
    float sums[C] = {};           // what is not lit has no gradient
    Eight sum = (Eight)(0.0f);
    if constexpr (C % 2 == 0) {
      if (a.turns) {
        for (int k = 0; k < 3 && !first; k++) elevation[3 * id + k] = 0.0f;
        if (e.lit != 0.0f) sum = wave_backward<C>(e, image, cut, dS, a, id, sums, elevation + 3 * (int64_t)id);
      }
    }
    if (e.lit != 0.0f && !a.turns) sum = image_backward<C>(e, image, cut, dS, a.of(e, id), sums);
    for (int c = 0; c < C; c++) sums[c] = sums[c] * e.g.height + (seeds ? seeds[a.stride * id + first + c] : 0.0f);
    float* all = sections ? sections + a.stride * id : sums;
    for (int c = 0; sections && c < C; c++) all[first + c] = sums[c];
    if (first) sum += load_eight(row);
    if (last) finish(id, e, sum, all);
    store_eight(row, sum);
  }
}

// seeds: dL/dsigma [V, N, C], or null; finish(view, id, entry, moments, dL/dsigma)
template <class Finish>
int32_t splat_images_backward(sg_context& c, const sg_problem& p, const Channels& channels, const float* d_images, const float* seeds,
                       Backward* scratch, Finish finish) {
  const int C = channels.count, n = p.gaussians, groups = tasks_of(c.image.count(), kStripsPerTask);
  const int64_t size = c.image.size();
  for (int v = 0; v < p.views; v++) {
    scratch[v].pixel_moments = c.arena.take<float>(kSums * (int64_t)n);
    scratch[v].dS = c.arena.take<float>(C * size);
  }
  if (c.arena.failed()) return SG_MEMORY;
  parallel(p.views * C * groups, [&](int i) {
    const int64_t image = i / groups, first = i % groups * kStripsPerTask;
    write_strips(c.image, first, smaller(c.image.count(), first + kStripsPerTask), d_images + image * p.rows * p.columns,
                 scratch[image / C].dS + image % C * size);
  });
  over_parts(c, p, &ViewState::pixel_parts, [&](int64_t v, int b) {
    const ViewState& s = c.views[v];
    for_channels(C, [&](int first, auto count) {
      image_part_backward<count>(s, s.pixel_groups[b], c.image, channels.of(v, n).from(first), image_cut(p), scratch[v].dS + first * size,
                                 seeds ? seeds + v * n * C : nullptr, first, first + count == C, scratch[v].sections, scratch[v].elevation,
                                 scratch[v].pixel_moments,
                                 [&](int64_t id, const PixelEntry& e, Eight& sum, const float* all) { finish(v, id, e, sum, all); });
    });
  });
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
