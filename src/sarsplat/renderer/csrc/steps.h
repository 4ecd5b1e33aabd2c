// steps.h: the steps of a pass one by one, with arrays in between: project, attenuate, splat. They are made of the same
// stages as the fused pass in engine.cpp; what it hands on in entries, they write out in metres.
#pragma once
#include "channels.h"
#include "differentiate.h"
#include "inspect.h"
#include "parallel.h"
#include "project.h"

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

void write_projections(const sg_problem& p, const sg_projection& out, int64_t first, int64_t end) {
  const PlaneUnits u = units(p);
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    const Bodies bodies = read_bodies(p, i, real);
    F harmonics[kFields];
    if (p.coefficients) read_rows(p.harmonics + p.coefficients * i, p.coefficients, real, harmonics);
    for (int v = 0; v < p.views; v++) {
      const int64_t at = v * (int64_t)p.gaussians + i;
      const Projection<F> g = project(bodies.body, frame_of(p, v), u);
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
      if (p.coefficients) store_some(out.gamma0 + at, scatter(p, v, i, real, harmonics).value, real);
    }
  }
}

Sym2<F> read_root_gradient(const Whitening<F>& w, const float* spacing, const float* d_roots, int real, F m0) {
  F columns[3];
  read_few<3>(d_roots, real, columns);
  return from_root_gradient(w, spacing, columns, m0);
}

void differentiate_projections(const sg_problem& p, const sg_projection& seeds, const sg_gradients& g, int64_t first, int64_t end,
                               float* shift_sums) {
  const PlaneUnits u = units(p);
  const F zero = splat(0.0f);
  for (int k = 0; k < 2 * p.views; k++) shift_sums[k] = 0.0f;
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    const Bodies bodies = read_bodies(p, i, real);
    BodyGradient<F> total = no_gradient();
    F harmonics[kFields], d_harmonics[kFields];
    if (p.coefficients) read_rows(p.harmonics + p.coefficients * i, p.coefficients, real, harmonics);
    for (F& x : d_harmonics) x = zero;
    for (int v = 0; v < p.views; v++) {
      const int64_t at = v * (int64_t)p.gaussians + i;
      const ViewFrame f = frame_of(p, v);
      const Projection<F> proj = project(bodies.body, f, u);
      const F ratio = widening_ratio(proj, u), d_depth = load_some(seeds.optical_depth + at, real);
      const F m0 = bodies.kappa * ratio * d_depth;
      F planes[4];
      read_few<2>(seeds.ray_centers + 2 * at, real, planes);
      read_few<2>(seeds.pixel_centers + 2 * at, real, planes + 2);
      const Sym2<F> gc = read_root_gradient(whitening(proj.cov_c, proj.det_cw), u.ray, seeds.ray_roots + 3 * at, real, m0);
      const Sym2<F> gi = read_root_gradient(whitening(proj.cov_i, proj.det_iw), u.pixel, seeds.pixel_roots + 3 * at, real, zero);
      spread(proj, f, u, planes, gc, gi, m0, total);
      total.kappa += ratio * d_depth;
      shift_sums[2 * v] += sum(planes[2]);
      shift_sums[2 * v + 1] += sum(planes[3]);
      if (p.coefficients) {
        const F d_sum = load_some(seeds.gamma0 + at, real) * scatter(p, v, i, real, harmonics).slope;
        for (int k = 0; k < p.coefficients; k++) d_harmonics[k] += d_sum * p.basis[v * p.coefficients + k];
      }
    }
    write_gradients(bodies, total, total.kappa, g, i, real);
    if (p.coefficients) write_rows(d_harmonics, p.coefficients, real, g.harmonics + p.coefficients * i);
  }
}

int32_t project_step(const sg_problem* problem, const sg_projection* out, int64_t* culprit) {
  const sg_problem& p = *problem;
  const int n = p.gaussians, chunks = chunks_of(n);
  int32_t status = SG_OK;
  together(worth_waking(p), [&] {
    Fault* faults = (Fault*)std::malloc(sizeof(Fault) * chunks);
    if (!faults) { status = SG_MEMORY; return; }
    parallel(chunks, [&](int i) {
      const int64_t first = (int64_t)i * kChunk, end = chunk_end(i, n);
      faults[i] = check(p, first, end);
      if (faults[i].status == SG_OK) write_projections(p, *out, first, end);
    });
    const Fault fault = worst(faults, chunks);
    std::free(faults);
    *culprit = fault.index;
    status = fault.status;
  });
  return status;
}

int32_t project_step_backward(sg_context* context, const sg_problem* problem, const sg_projection* seeds, const sg_gradients* gradients) {
  const sg_problem& p = *problem;
  Arena& arena = context->arena;
  const int n = p.gaussians, chunks = chunks_of(n);
  arena.reset();
  float* shift_sums = arena.take<float>((int64_t)chunks * 2 * p.views);
  if (arena.failed()) return SG_MEMORY;
  together(worth_waking(p), [&] {
    parallel(chunks, [&](int i) {
      differentiate_projections(p, *seeds, *gradients, (int64_t)i * kChunk, chunk_end(i, n), shift_sums + (int64_t)i * 2 * p.views);
    });
    add_shifts(p.views, chunks, shift_sums, gradients->shift);
  });
  return SG_OK;
}

// ---- what attenuate and splat have in common ---------------------------------------------------------------------------
// What is wrong with the rows [first, end) of footprints. Two of the three roots must be positive.
void check_footprints(const sg_problem& p, const float* centers, const float* roots, int64_t first, int64_t end, Fault& fault) {
  find_outside(centers, first, end, 2, -2.0f * p.farthest, 2.0f * p.farthest, SG_CENTERS, fault);
  find_outside(roots, first, end, 3, -p.steepest, p.steepest, SG_ROOTS, fault);
  for (int64_t i = first; i < end; i++)
    if (!(roots[3 * i] >= p.flattest && roots[3 * i + 2] >= p.flattest) && (!fault.status || fault.status > SG_ROOTS)) fault = {SG_ROOTS, i};
}

Placed<F> read_footprints(const float* centers, const float* roots, int64_t at, int real, const float* spacing) {
  F center[2], columns[3];
  read_few<2>(centers + 2 * at, real, center);
  read_few<3>(roots + 3 * at, real, columns);
  for (int k = real; k < kWidth; k++) columns[0][k] = columns[2][k] = 1.0f;  // the rest are harmless
  return placed_from(center, columns, spacing);
}

// The moments hold the norm's share already.
void write_footprint_gradients(const Whitening<F>& w, const float* spacing, const Moments<F>& m, int real, int64_t at, float* d_centers,
                               float* d_roots) {
  F center[2], columns[3];
  footprint_gradient(w, spacing, m, center, columns);
  write_few<2>(center, real, d_centers + 2 * at);
  write_few<3>(columns, real, d_roots + 3 * at);
}

// The factors of kWidth entries; those beyond the last are harmless.
template <class E> Whitening<F> read_whitening(const E* entries, int real) {
  Whitening<F> w{splat(1.0f), splat(1.0f), splat(1.0f)};
  for (int k = 0; k < real; k++) { w.ux[k] = entries[k].g.ux; w.uy[k] = entries[k].g.uy; w.vy[k] = entries[k].g.vy; }
  return w;
}

// task(view, first, end) for the chunks of all views
template <class Task> void over_chunks(const sg_problem& p, Task task) {
  const int chunks = chunks_of(p.gaussians);
  parallel(p.views * chunks, [&](int i) { task(i / chunks, (int64_t)(i % chunks) * kChunk, chunk_end(i % chunks, p.gaussians)); });
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
  const F beyond = splat(3e38f);
  Bounds& bounds = c.views[v].bounds[first / kChunk] = {{beyond, beyond}, {-beyond, -beyond}};
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    Placed<F> at = read_footprints(in.ray_centers, in.ray_roots, base + i, real, p.ray);
    at.x *= 1.0f / p.ray[0];
    at.y *= 1.0f / p.ray[1];
    place_on_rays(c.views[v], p, cuts, at, load_some(in.optical_depth + base + i, real), load_some(in.range + base + i, real), i, real, bounds);
  }
  return fault;
}

int32_t attenuate_stages(sg_context& c, const sg_problem& p, const sg_projection& in, float* lit_area, int64_t* culprit) {
  Arena& arena = c.arena;
  arena.reset();
  auto out_of_memory = [&] { arena.give_back(); return SG_MEMORY; };
  const int V = p.views, n = p.gaussians, chunks = chunks_of(n), parts = c.parts = parts_of(p);
  c.views = arena.take<ViewState>(V);
  Fault* faults = arena.take<Fault>(V * chunks);
  if (arena.failed()) return out_of_memory();
  for (int v = 0; v < V; v++) c.views[v].take_on_rays(arena, n, chunks, parts);
  if (arena.failed()) return out_of_memory();
  over_chunks(p, [&](int v, int64_t first, int64_t end) { faults[v * chunks + first / kChunk] = place_rays(c, p, in, v, first, end); });
  if (const Fault fault = worst(faults, V * chunks); fault.status) { *culprit = fault.index; return fault.status; }
  if (const int32_t status = place_lattices(c, p, culprit)) return status == SG_MEMORY ? out_of_memory() : status;
  parallel(2 * V, [&](int i) {
    if (i < V) sort_by_depth(c.views[i], n);
    else cut_rays(c.views[i - V], n, parts);
  });
  c.kept = arena.mark();
  parallel(V * parts, [&](int i) {
    ViewState& s = c.views[i / parts];
    if (i % parts < s.ray_parts) attenuate_rays(s, p, i % parts);
  });
  over_chunks(p, [&](int v, int64_t first, int64_t end) {
    for (int64_t i = first; i < end; i++) lit_area[v * (int64_t)n + i] = sum_of_weights(c.views[v], i) * (p.ray[0] * p.ray[1]);
  });
  return SG_OK;
}

int32_t attenuate_backward_stages(sg_context& c, const sg_problem& p, const float* d_lit_area, const float* d_transmittance,
                                  const sg_projection& out) {
  Arena& arena = c.arena;
  const int V = p.views, n = p.gaussians, parts = c.parts;
  Backward* scratch = arena.take<Backward>(V);
  if (!arena.failed()) take_backward_rays(c, p, d_transmittance, scratch);
  if (arena.failed()) { arena.release(c.kept); return SG_MEMORY; }
  over_chunks(p, [&](int v, int64_t first, int64_t end) {
    for (int64_t i = first; i < end; i++) c.views[v].on_rays[i].h = d_lit_area ? d_lit_area[v * (int64_t)n + i] * (p.ray[0] * p.ray[1]) : 0.0f;
  });
  parallel(V * parts, [&](int i) {
    const ViewState& s = c.views[i / parts];
    if (i % parts < s.ray_parts) attenuate_rays_backward(s, p, i % parts, scratch[i / parts]);
  });
  over_chunks(p, [&](int v, int64_t first, int64_t end) {
    const ViewState& s = c.views[v];
    for (int64_t i = first; i < end; i += kWidth) {
      const int real = smaller(kWidth, (int)(end - i));
      const int64_t at = v * (int64_t)n + i;
      F sums[kFields], depth = splat(1.0f);
      gather(real, [&](int k) { return ray_row(s, scratch[v], i + k); }, [](int) { return (Eight)(0.0f); }, sums);
      for (int k = 0; k < 6; k++) sums[k] *= kLn2;  // tau is in units of log2(e)
      for (int k = 0; k < real; k++) depth[k] = s.on_rays[i + k].g.height;
      store_some(out.optical_depth + at, sums[0] / (power2(depth) * kLn2), real);
      write_footprint_gradients(read_whitening(s.on_rays + i, real), p.ray, moments_of(sums), real, at, out.ray_centers, out.ray_roots);
    }
  });
  arena.release(c.kept);
  return SG_OK;
}

int32_t attenuate_step(sg_context* c, const sg_problem* p, const sg_projection* in, float* lit_area, int64_t* culprit) {
  int32_t status = SG_OK;
  together(worth_waking(*p), [&] { status = attenuate_stages(*c, *p, *in, lit_area, culprit); });
  return status;
}
int32_t attenuate_step_backward(sg_context* c, const sg_problem* p, const float* d_lit_area, const float* d_transmittance,
                                const sg_projection* out) {
  int32_t status = SG_OK;
  together(worth_waking(*p), [&] { status = attenuate_backward_stages(*c, *p, d_lit_area, d_transmittance, *out); });
  return status;
}
int32_t trace_step(const sg_context* c, const sg_problem* p, const sg_projection* in, int32_t view, float depth, float* transmittance,
                   float* first_return) {
  const int64_t base = view * (int64_t)p->gaussians;
  return trace_rays(c->views[view], p, depth, transmittance, first_return, [&](int32_t id) {
    const float* tilt = in->tilt + 2 * (base + id);
    return Surface{splat(in->range[base + id]), {splat(tilt[0] * p->ray[0]), splat(tilt[1] * p->ray[1])}, 0};
  });
}

// ---- splat --------------------------------------------------------------------------------------------------------------
Fault place_pixels(const sg_context& c, const sg_problem& p, const sg_projection& in, const sg_channels& a, int v, int64_t first, int64_t end) {
  const int64_t base = v * (int64_t)p.gaussians;
  Fault fault{SG_OK, -1};
  check_footprints(p, in.pixel_centers, in.pixel_roots, base + first, base + end, fault);
  find_outside(a.cross_sections, base + first, base + end, a.count, -p.strongest, p.strongest, SG_CROSS_SECTIONS, fault);
  if (fault.status) return fault;
  const Cuts cuts = cuts_of(p);
  const F zero = splat(0.0f);
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = smaller(kWidth, (int)(end - i));
    Placed<F> at = read_footprints(in.pixel_centers, in.pixel_roots, base + i, real, p.pixel);
    at.x = pixel_x(p, at.x);
    at.y = pixel_y(p, at.y);
    // sqrt(det Sigma') = 1 / (a c), m^2
    const float share = cuts.lost / (6.2831853f * (p.pixel[0] * kRootUnit) * (p.pixel[1] * kRootUnit));
    const F norm = p.peak ? splat(cuts.lost) : at.w.ux * at.w.vy * share;
    place_on_pixels(c.views[v], p, cuts, at, norm, zero, zero, zero, zero, i, real);
  }
  return fault;
}

int32_t splat_stages(sg_context& c, const sg_problem& p, const sg_projection& in, const sg_channels& a, float* images, int64_t* culprit) {
  Arena& arena = c.arena;
  arena.reset();
  auto out_of_memory = [&] { arena.give_back(); return SG_MEMORY; };
  const int V = p.views, n = p.gaussians, chunks = chunks_of(n), parts = c.parts = parts_of(p);
  c.image = {0, 0, p.columns, p.rows, nullptr, nullptr};
  c.views = arena.take<ViewState>(V);
  float* ruler = arena.take<float>(c.image.ruler());
  Fault* faults = arena.take<Fault>(V * chunks);
  if (arena.failed()) return out_of_memory();
  c.image.mark(ruler);
  for (int v = 0; v < V; v++) c.views[v].take_on_pixels(arena, n, p.rows);
  if (arena.failed()) return out_of_memory();
  over_chunks(p, [&](int v, int64_t first, int64_t end) { faults[v * chunks + first / kChunk] = place_pixels(c, p, in, a, v, first, end); });
  if (const Fault fault = worst(faults, V * chunks); fault.status) { *culprit = fault.index; return fault.status; }
  parallel(V, [&](int v) { cut_pixels(c.views[v], c.image, n, parts); });
  c.kept = arena.mark();
  for (int v = 0; v < V; v++) c.views[v].take_images(arena, a.count);
  if (arena.failed()) return out_of_memory();
  parallel(V * parts, [&](int i) {
    const int64_t v = i / parts;
    const ViewState& s = c.views[v];
    if (i % parts >= s.pixel_parts) return;
    const Part& part = s.pixel_groups[i % parts];
    for_channels(a.count, [&](int first, auto count) {
      image_channels<count>(s, part, {a.cross_sections + v * n * a.count + first, a.count}, image_cut(p), part.memory + first * part.strips.size());
    });
  });
  const int groups = tasks_of(p.rows, kRowsPerTask);
  parallel(V * a.count * groups, [&](int i) {
    const int64_t image = i / groups;
    const int first = i % groups * kRowsPerTask;
    add_parts(c.views[image / a.count], (int)(image % a.count), first, smaller(p.rows, first + kRowsPerTask), p.columns,
              images + image * p.rows * p.columns);
  });
  arena.release(c.kept);
  return SG_OK;
}

int32_t splat_backward_stages(sg_context& c, const sg_problem& p, const sg_channels& a, const float* d_images, const sg_projection& out,
                              float* d_amplitudes) {
  Arena& arena = c.arena;
  const int V = p.views, n = p.gaussians, parts = c.parts;
  const int64_t size = c.image.size();
  Backward* scratch = arena.take<Backward>(V);
  for (int v = 0; v < V && !arena.failed(); v++) scratch[v].take_on_pixels(arena, n, c.image, a.count);
  if (arena.failed()) { arena.release(c.kept); return SG_MEMORY; }
  const int groups = tasks_of(c.image.count(), kStripsPerTask);
  parallel(V * a.count * groups, [&](int i) {
    const int64_t image = i / groups, first = i % groups * kStripsPerTask;
    write_strips(c.image, first, smaller(c.image.count(), first + kStripsPerTask), d_images + image * p.rows * p.columns,
                 scratch[image / a.count].dS + image % a.count * size);
  });
  parallel(V * parts, [&](int i) {
    const int64_t v = i / parts;
    const ViewState& s = c.views[v];
    if (i % parts >= s.pixel_parts) return;
    for_channels(a.count, [&](int first, auto count) {
      const int64_t at = v * n * a.count + first;
      image_channels_backward<count>(s, s.pixel_groups[i % parts], c.image, {a.cross_sections + at, a.count}, image_cut(p),
                                     scratch[v].dS + first * size, first == 0, scratch[v].pixel_moments, d_amplitudes + at);
    });
  });
  over_chunks(p, [&](int v, int64_t first, int64_t end) {
    for (int64_t i = first; i < end; i += kWidth) {
      const int real = smaller(kWidth, (int)(end - i));
      F sums[kFields];
      gather(real, [&](int k) { return pixel_row(scratch[v], i + k); }, [](int) { return (Eight)(0.0f); }, sums);
      Moments<F> m = moments_of(sums);
      if (!p.peak) {                    // d ln norm = da / a + dc / c
        m.muu -= m.m0 * (0.5f / kLn2);
        m.mvv -= m.m0 * (0.5f / kLn2);
      }
      write_footprint_gradients(read_whitening(c.views[v].on_pixels + i, real), p.pixel, m, real, v * (int64_t)n + i, out.pixel_centers,
                                out.pixel_roots);
    }
  });
  arena.release(c.kept);
  return SG_OK;
}

int32_t splat_step(sg_context* c, const sg_problem* p, const sg_projection* in, const sg_channels* a, float* images, int64_t* culprit) {
  int32_t status = SG_OK;
  together(worth_waking(*p), [&] { status = splat_stages(*c, *p, *in, *a, images, culprit); });
  return status;
}
int32_t splat_step_backward(sg_context* c, const sg_problem* p, const sg_channels* a, const float* d_images, const sg_projection* out,
                            float* d_amplitudes) {
  int32_t status = SG_OK;
  together(worth_waking(*p), [&] { status = splat_backward_stages(*c, *p, *a, d_images, *out, d_amplitudes); });
  return status;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
