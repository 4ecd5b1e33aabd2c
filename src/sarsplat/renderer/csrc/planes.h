// planes.h: what a task of each stage does on the computation plane and on the imaging plane, forward and backward.
#pragma once
#include "arrange.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// ---- computation plane -------------------------------------------------------------------------------------------------
int32_t place_lattices(sg_context& c, const sg_problem& p, int64_t* culprit) {
  for (int v = 0; v < p.views; v++) {
    if (!place_lattice(c.views[v], chunks_of(p.gaussians))) { *culprit = v; return SG_LATTICE; }
    c.views[v].take_per_ray(c.arena, c.parts);
  }
  return c.arena.failed() ? SG_MEMORY : SG_OK;
}

void attenuate_rays(ViewState& s, const sg_problem& p, int b) {
  Part& band = s.ray_bands[b];
  band.first = b * p.gaussians;
  band.end = band.first + list_band(s, b, s.ray_list + band.first);
  attenuate_band(s.on_rays, s.ray_list + band.first, band.count(), band.strips, b, min_log_tau(p), p.min_transmittance,
                 s.T + band.start, s.stop + band.start, s.partial);
}

float sum_of_weights(const ViewState& s, int64_t i) {
  const RayEntry& ray = s.on_rays[i];
  float w = 0.0f;
  for (int slot = ray.slot; slot <= ray.slot + ray.last_band - ray.first_band; slot++) w += s.partial[slot];
  return w;
}

// From the sums of w to cross-sections, and to the amplitudes of the imaging plane.
void illuminate(const ViewState& s, float cell_area, int64_t first, int64_t end, float* lit_area, float* cross_sections) {
  for (int64_t i = first; i < end; i++) {
    PixelEntry& pixel = s.on_pixels[i];
    lit_area[i] = pixel.lit = sum_of_weights(s, i) * cell_area;
    cross_sections[i] = pixel.gamma0 * pixel.lit;
    pixel.g.height = cross_sections[i] * pixel.norm;
  }
}

struct Backward {                 // scratch of one backward pass, per view: rows of kSums
  float* ray_moments;             // by slot
  float* pixel_moments;           // by id; times the amplitude, then dL/dP(u) and the slope of P(u)
  float *T, *B, *dS;
  const float* from;              // dL/dT_end of the view's rays, or null
  void take_on_rays(Arena& arena, const ViewState& s, int64_t n, int parts) {
    ray_moments = arena.take<float>(kSums * n * s.ray_parts);
    T = arena.take<float>(size_in_bands(s.rays, parts));
    B = arena.take<float>(size_in_bands(s.rays, parts));
  }
  void take_on_pixels(Arena& arena, int64_t n, const Strips& image, int channels) {
    pixel_moments = arena.take<float>(kSums * n);
    dS = arena.take<float>(channels * image.size());
  }
};

// The scratch of all views. d_transmittance: of their lattices one after the other, or null.
void take_backward_rays(sg_context& c, const sg_problem& p, const float* d_transmittance, Backward* scratch) {
  int64_t rays = 0;               // of the views before this one
  for (int v = 0; v < p.views; v++) {
    const ViewState& s = c.views[v];
    scratch[v].take_on_rays(c.arena, s, p.gaussians, c.parts);
    scratch[v].from = d_transmittance ? d_transmittance + rays : nullptr;
    rays += (int64_t)s.rays.rows * s.rays.columns;
  }
}

void attenuate_rays_backward(const ViewState& s, const sg_problem& p, int b, const Backward& scratch) {
  const Part& band = s.ray_bands[b];
  const Strips& rays = band.strips;
  float *T = scratch.T + band.start, *B = scratch.B + band.start;
  for (int64_t k = 0; k < rays.size(); k++) { T[k] = s.T[band.start + k]; B[k] = 0.0f; }
  for (int y = rays.y0; scratch.from && y < rays.y0 + rays.rows; y++)
    for (int x = 0; x < rays.columns; x++) {
      const int64_t at = rays.at(rays.x0 + x, y);
      B[at] = T[at] * scratch.from[(int64_t)(y - s.rays.y0) * rays.columns + x];
    }
  attenuate_band_backward(s.on_rays, s.ray_list + band.first, band.count(), rays, b, min_log_tau(p), T, s.stop + band.start, B,
                          scratch.ray_moments);
}

// ---- imaging plane -----------------------------------------------------------------------------------------------------
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

// An image to strips, whose spare rows are zero.
void write_strips(const Strips& s, int first, int end, const float* image, float* strips) {
  for (int i = first; i < end; i++) {
    float* strip = strips + (int64_t)i * s.height() * kBlockX;
    const int x = i * kBlockX, some = smaller(kBlockX, s.columns - x);
    std::memset(strip, 0, sizeof(float) * s.height() * kBlockX);
    for (int y = 0; y < s.rows; y++) std::memcpy(strip + y * kBlockX, image + (int64_t)y * s.columns + x, sizeof(float) * some);
  }
}

// dL/dS to dL/dsigma, by way of it to dL/dw, and to the moments of every Gaussian of a part.
void image_part_backward(const ViewState& s, const sg_problem& p, const Strips& image, int b, const float* d_cross_sections,
                         const Backward& scratch) {
  const Part& part = s.pixel_groups[b];
  for (int k = part.first; k < part.end; k++) {
    const int32_t id = s.pixel_list[k];
    __builtin_prefetch(s.on_pixels + s.pixel_list[smaller(k + kAhead, part.end - 1)]);
    const PixelEntry& e = s.on_pixels[id];
    Eight moments = e.lit == 0.0f ? (Eight)(0.0f) : image_backward(e, image, image_cut(p), scratch.dS);
    const float d_sigma = moments[0] * e.norm + (d_cross_sections ? d_cross_sections[id] : 0.0f);
    s.on_rays[id].h = d_sigma * e.gamma0 * (p.ray[0] * p.ray[1]);
    moments *= e.g.height;
    moments[6] = d_sigma * e.lit;
    moments[7] = e.slope;
    store_eight(scratch.pixel_moments + kSums * (int64_t)id, moments);
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
