// steps.h: the steps of a pass one by one, with arrays of footprints in metres between them: project, attenuate, splat.
// They read and write these arrays around the stages that a whole pass is made of.
#pragma once
#include "differentiate.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// ---- project ------------------------------------------------------------------------------------------------------------
void write_pair(F x, F y, int real, float* rows) {
  const F columns[2] = {x, y};
  write_few<2>(columns, real, rows);
}
void write_roots(const Whitening<F>& w, const float* spacing, int real, float* rows) {
  F columns[3];
  roots_in_metres(w, spacing, columns);
  write_few<3>(columns, real, rows);
}

int32_t project_step(sg_context& c, const sg_problem& p, const sg_projection* projection, int64_t* culprit) {
  const sg_projection& out = *projection;
  const PlaneUnits u = units(p);
  if (const int32_t status = begin(c, p, kNone)) return status;
  const int chunks = chunks_of(p.gaussians);
  parallel(chunks, [&](int k) {
    const int64_t first = (int64_t)k * kChunk, end = chunk_end(k, p.gaussians);
    c.faults[k] = check(p, first, end);
    if (c.faults[k].status != SG_OK) return;
    project_all(p, first, end, [&](int v, int64_t i, int real, const Bodies& bodies, const Projection<F>& g, const Softplus<F>& gamma0) {
      const int64_t at = v * (int64_t)p.gaussians + i;
      const float* shift = p.shift + 2 * v;
      F slope[2];
      densest(g, u, slope);
      write_pair(g.mean[0], g.mean[1], real, out.ray_centers + 2 * at);
      write_roots(whitening(g.cov_c, g.det_cw), u.ray, real, out.ray_roots + 3 * at);
      store_some(out.optical_depth + at, bodies.kappa * widening_ratio(g, u), real);
      store_some(out.range + at, g.mean[2], real);
      write_pair(slope[0] * (1.0f / u.ray[0]), slope[1] * (1.0f / u.ray[1]), real, out.tilt + 2 * at);
      write_pair(g.mean[0] + shift[0], g.mean[2] + shift[1], real, out.pixel_centers + 2 * at);
      write_roots(whitening(g.cov_i, g.det_iw), u.pixel, real, out.pixel_roots + 3 * at);
      if (p.coefficients) store_some(out.gamma0 + at, gamma0.value, real);
    });
  });
  return worst(c.faults, chunks, culprit);
}

Sym2<F> read_root_gradient(const Whitening<F>& w, const float* spacing, const float* d_roots, int real, F m0) {
  F columns[3];
  read_few<3>(d_roots, real, columns);
  return from_root_gradient(w, spacing, columns, m0);
}

int32_t project_step_backward(sg_context& c, const sg_problem& p, const sg_projection* d_projection, const sg_gradients* gradients) {
  const sg_projection& seeds = *d_projection;
  const sg_gradients& g = *gradients;
  const PlaneUnits u = units(p);
  c.arena.reset();
  return differentiate_all(c, p, g.shift, [&](int64_t first, int64_t end, float* shift_sums) {
    differentiate(p, g, first, end, shift_sums, [&](int v, int64_t i, int real, const Bodies& bodies, const ViewFrame& frame) {
      const int64_t at = v * (int64_t)p.gaussians + i;
      const Projection<F> proj = project(bodies.body, frame, u);
      const F ratio = widening_ratio(proj, u), d_depth = load_some(seeds.optical_depth + at, real);
      Share share;
      share.proj = proj;
      share.m0 = bodies.kappa * ratio * d_depth;
      share.kappa = ratio * d_depth;
      read_few<2>(seeds.ray_centers + 2 * at, real, share.planes);
      read_few<2>(seeds.pixel_centers + 2 * at, real, share.planes + 2);
      share.gc = read_root_gradient(whitening(proj.cov_c, proj.det_cw), u.ray, seeds.ray_roots + 3 * at, real, share.m0);
      share.gi = read_root_gradient(whitening(proj.cov_i, proj.det_iw), u.pixel, seeds.pixel_roots + 3 * at, real, splat(0.0f));
      F harmonics[kFields];
      if (p.coefficients) read_rows(p.harmonics + p.coefficients * i, p.coefficients, real, harmonics);
      share.harmonics = p.coefficients ? load_some(seeds.gamma0 + at, real) * scatter(p, v, i, real, harmonics).slope : splat(0.0f);
      return share;
    }, [](F, F sum) { return sum; });
  });
}

// ---- what attenuate and splat have in common ---------------------------------------------------------------------------
// What is wrong with the rows [first, end) of footprints. Two of the three roots must be positive.
void check_footprints(const sg_problem& p, const float* centers, const float* roots, int64_t first, int64_t end, Fault& fault) {
  find_outside(centers, first, end, 2, -2.0f * p.farthest, 2.0f * p.farthest, SG_CENTERS, fault);
  find_outside(roots, first, end, 3, -p.steepest, p.steepest, SG_ROOTS, fault);
  auto flat = [&](int64_t i) { return !(roots[3 * i] >= p.flattest) | !(roots[3 * i + 2] >= p.flattest); };
  bool any_flat = false;
  for (int64_t i = first; i < end; i++) any_flat |= flat(i);
  if (!any_flat || (fault.status && fault.status <= SG_ROOTS)) return;
  for (int64_t i = first; fault.status != SG_ROOTS; i++)
    if (flat(i)) fault = {SG_ROOTS, i};
}

Placed<F> read_footprints(const float* centers, const float* roots, int64_t at, int real, const float* spacing) {
  F center[2], columns[3];
  read_few<2>(centers + 2 * at, real, center);
  read_few<3>(roots + 3 * at, real, columns);
  for (int k = real; k < kWidth; k++) columns[0][k] = columns[2][k] = 1.0f;  // the rest are harmless
  return placed_from(center, columns, spacing);
}

// place(view, first, end): to entries, unless something is wrong
template <class Place> int32_t place_all(const sg_context& c, const sg_problem& p, int64_t* culprit, Place place) {
  const int chunks = chunks_of(p.gaussians);
  over_chunks(p, [&](int v, int64_t first, int64_t end) { c.faults[v * chunks + first / kChunk] = place(v, first, end); });
  return worst(c.faults, p.views * chunks, culprit);
}

// The footprints of kWidth entries; those beyond the last are harmless.
struct Shapes { Whitening<F> w; F height; };
template <class E> SG_FN Shapes read_shapes(const E* entries, int real) {
  F fields[kRow];
  turn([&](int k, int part) { return k < real ? load((const float*)(entries + k) + part) : splat(1.0f); }, fields);
  return {{fields[2], fields[3], fields[4]}, fields[5]};  // as in Footprint
}

// Moments of kWidth Gaussians as gradients of their footprints.
void write_footprint_gradients(const Whitening<F>& w, const float* spacing, const Moments<F>& m, int real, int64_t at, float* d_centers,
                               float* d_roots) {
  F center[2], columns[3];
  footprint_gradient(w, spacing, m, center, columns);
  write_few<2>(center, real, d_centers + 2 * at);
  write_few<3>(columns, real, d_roots + 3 * at);
}

// ---- attenuate ----------------------------------------------------------------------------------------------------------
Fault place_rays(const sg_context& c, const sg_problem& p, const sg_projection& in, int v, int64_t first, int64_t end) {
  const int64_t base = v * (int64_t)p.gaussians;
  Fault fault{SG_OK, -1};
  check_footprints(p, in.ray_centers, in.ray_roots, base + first, base + end, fault);
  find_outside(in.optical_depth, base + first, base + end, 1, 0.0f, p.max_depth, SG_DEPTH, fault);
  find_outside(in.range, base + first, base + end, 1, -2.0f * p.farthest, 2.0f * p.farthest, SG_RANGE, fault);
  find_outside(in.tilt, base + first, base + end, 2, -p.strongest, p.strongest, SG_TILT, fault);
  if (fault.status) return fault;
  const Cuts cuts = cuts_of(p);
  Bounds& bounds = unbounded(c.views[v], first);
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    Placed<F> at = read_footprints(in.ray_centers, in.ray_roots, base + i, real, p.ray);
    at.x *= 1.0f / p.ray[0];
    at.y *= 1.0f / p.ray[1];
    F slope[2];
    read_few<2>(in.tilt + 2 * (base + i), real, slope);
    slope[0] *= p.ray[0];
    slope[1] *= p.ray[1];
    place_on_rays(c.views[v], p, cuts, at, load_some(in.optical_depth + base + i, real), load_some(in.range + base + i, real), slope, i, real,
                  bounds);
  }
  return fault;
}

int32_t attenuate_step(sg_context& c, const sg_problem& p, const sg_projection* in, float* lit_area, int64_t* culprit) {
  int32_t status = begin(c, p, kRays);
  if (!status) status = place_all(c, p, culprit, [&](int v, int64_t first, int64_t end) { return place_rays(c, p, *in, v, first, end); });
  if (!status) status = arrange(c, p, kRays, culprit);
  if (status) return status;
  attenuate_rays(c, p, {});
  over_chunks(p, [&](int64_t v, int64_t first, int64_t end) {
    for (int64_t i = first; i < end; i++) lit_area[v * p.gaussians + i] = lit_area_of(c.views[v], p, i);
  });
  return SG_OK;
}

int32_t attenuate_step_backward(sg_context& c, const sg_problem& p, const float* d_lit_area, const float* d_transmittance,
                                const sg_projection* out) {
  Backward* scratch = c.arena.take<Backward>(p.views);
  if (c.arena.failed()) return SG_MEMORY;
  over_chunks(p, [&](int64_t v, int64_t first, int64_t end) {
    for (int64_t i = first; i < end; i++) c.views[v].on_rays[i].h = d_lit_area ? d_lit_area[v * p.gaussians + i] * (p.ray[0] * p.ray[1]) : 0.0f;
  });
  if (const int32_t status = attenuate_rays_backward(c, p, d_transmittance, scratch, {}, nullptr)) return status;
  over_chunks(p, [&](int v, int64_t first, int64_t end) {
    const ViewState& s = c.views[v];
    for (int64_t i = first; i < end; i += kWidth) {
      const int real = smaller(kWidth, (int)(end - i));
      const int64_t at = v * (int64_t)p.gaussians + i;
      F sums[kRow];
      gather(real, [&](int k) { return ray_row(s, scratch[v], i + k); }, [](int) { return (Eight)(0.0f); }, sums);
      for (int k = 0; k < 6; k++) sums[k] *= kLn2;  // tau is in units of log2(e)
      const Shapes shapes = read_shapes(s.on_rays + i, real);
      store_some(out->optical_depth + at, sums[0] / (power2(shapes.height) * kLn2), real);
      write_footprint_gradients(shapes.w, p.ray, moments_of(sums), real, at, out->ray_centers, out->ray_roots);
    }
  });
  return SG_OK;
}

// ---- splat --------------------------------------------------------------------------------------------------------------
Fault place_pixels(const sg_context& c, const sg_problem& p, const sg_projection& in, const Channels& a, const float* slopes, int v,
                   int64_t first, int64_t end) {
  const int64_t base = v * (int64_t)p.gaussians;
  Fault fault{SG_OK, -1};
  check_footprints(p, in.pixel_centers, in.pixel_roots, base + first, base + end, fault);
  find_outside(a.amplitudes, base + first, base + end, a.count, -p.strongest, p.strongest, SG_CROSS_SECTIONS, fault);
  if (a.wavenumbers) find_outside(slopes, base + first, base + end, 2, -p.strongest, p.strongest, SG_SLOPES, fault);
  if (fault.status) return fault;
  const Cuts cuts = cuts_of(p);
  const F zero = splat(0.0f), one = splat(1.0f);
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    Placed<F> at = read_footprints(in.pixel_centers, in.pixel_roots, base + i, real, p.pixel);
    at.x = pixel_x(p, at.x);
    at.y = pixel_y(p, at.y);
    // sqrt(det Sigma') = 1 / (a c), m^2
    const float share = cuts.lost / (6.2831853f * (p.pixel[0] * kRootUnit) * (p.pixel[1] * kRootUnit));
    const F norm = p.peak ? splat(cuts.lost) : at.w.ux * at.w.vy * share;
    const F section = a.count == 1 ? load_some(a.amplitudes + base + i, real) : zero;
    F elevation[2] = {zero, zero};
    if (a.wavenumbers) {
      F slope[2];
      read_few<2>(slopes + 2 * (base + i), real, slope);
      elevation[0] = slope[0] * p.pixel[0] / at.w.ux;  // dx = (u - uy / vy v) / ux, dy = v / vy
      elevation[1] = (slope[1] * p.pixel[1] - elevation[0] * at.w.uy) / at.w.vy;
    }
    place_on_pixels(c.views[v], p, cuts, at, norm, section, one, zero, elevation, i, real);
  }
  return fault;
}

int32_t splat_step(sg_context& c, const sg_problem& p, const sg_projection* in, const sg_channels* channels, float* images, int64_t* culprit) {
  const Channels a{channels->count, channels->cross_sections, channels->wavenumbers};
  int32_t status = begin(c, p, kPixels);
  if (!status)
    status = place_all(c, p, culprit, [&](int v, int64_t first, int64_t end) { return place_pixels(c, p, *in, a, channels->slopes, v, first, end); });
  if (!status) status = arrange(c, p, kPixels, culprit);
  return status ? status : splat_images(c, p, a, images);
}

int32_t splat_step_backward(sg_context& c, const sg_problem& p, const sg_channels* channels, const float* d_images, const sg_projection* out,
                            float* d_cross_sections, float* d_elevation) {
  const Channels a{channels->count, channels->cross_sections, channels->wavenumbers};
  Backward* scratch = c.arena.take<Backward>(p.views);
  if (c.arena.failed()) return SG_MEMORY;
  for (int v = 0; v < p.views; v++) {
    scratch[v].sections = d_cross_sections + (int64_t)v * p.gaussians * a.count;
    scratch[v].elevation = a.wavenumbers ? d_elevation + (int64_t)v * p.gaussians * 3 : nullptr;
  }
  const int32_t status = splat_images_backward(c, p, a, d_images, nullptr, scratch, [](int64_t, int64_t, const PixelEntry&, Eight&, const float*) {});
  if (status) return status;
  over_chunks(p, [&](int v, int64_t first, int64_t end) {
    for (int64_t i = first; i < end; i += kWidth) {
      const int real = smaller(kWidth, (int)(end - i));
      F sums[kRow];
      gather(real, [&](int k) { return pixel_row(scratch[v], i + k); }, [](int) { return (Eight)(0.0f); }, sums);
      Moments<F> m = moments_of(sums);
      if (!p.peak) {                    // d ln norm = da / a + dc / c
        m.muu -= m.m0 * (0.5f / kLn2);
        m.mvv -= m.m0 * (0.5f / kLn2);
      }
      const int64_t at = v * (int64_t)p.gaussians + i;
      const Whitening<F> w = read_shapes(c.views[v].on_pixels + i, real).w;
      write_footprint_gradients(w, p.pixel, m, real, at, out->pixel_centers, out->pixel_roots);
      if (!a.wavenumbers) continue;
      F columns[3];                     // times 1, u, v become times 1, x, y
      read_few<3>(d_elevation + 3 * at, real, columns);
      columns[2] = columns[2] / w.vy;
      columns[1] = (columns[1] - columns[2] * w.uy) / w.ux * p.pixel[0];
      columns[2] *= p.pixel[1];
      write_few<3>(columns, real, d_elevation + 3 * at);
    }
  });
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
