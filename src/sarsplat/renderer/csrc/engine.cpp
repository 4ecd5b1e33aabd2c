// engine.cpp: a batch of views, forward and backward. Compiled once per instruction set.
//
// forward:  check, projection, scattering -> lattice -> depth order, parts -> pass A -> cross-sections -> pass B -> sum of parts
// backward: pass B (gather per Gaussian) -> pass A (back to front) -> adjoint of the projection, views summed in order
//
// Every stage is a set of independent tasks whose number and order of summation depend on the problem alone, never on
// the number of threads: results are bit-identical for any.

#include "adam.h"
#include "differentiate.h"
#include "inspect.h"
#include "loss.h"
#include "parallel.h"
#include "project.h"
#include "steps.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

int32_t forward_stages(sg_context& c, const sg_problem& p, const sg_outputs& out, int64_t* culprit) {
  Arena& arena = c.arena;
  arena.reset();
  auto out_of_memory = [&] { arena.give_back(); return SG_MEMORY; };
  const int V = p.views, n = p.gaussians, chunks = chunks_of(n);
  const int parts = c.parts = parts_of(p);
  c.image = {0, 0, p.columns, p.rows, nullptr, nullptr};
  c.views = arena.take<ViewState>(V);
  float* ruler = arena.take<float>(c.image.ruler());
  Fault* faults = arena.take<Fault>(chunks);
  if (arena.failed()) return out_of_memory();
  c.image.mark(ruler);
  for (int v = 0; v < V; v++) {
    ViewState& s = c.views[v];
    s.frame = frame_of(p, v);
    s.take_on_rays(arena, n, chunks, parts);
    s.take_on_pixels(arena, n, p.rows);
  }
  if (arena.failed()) return out_of_memory();

  parallel(chunks, [&](int i) {
    const int64_t first = (int64_t)i * kChunk, end = chunk_end(i, n);
    faults[i] = check(p, first, end);
    if (faults[i].status == SG_OK) project_chunk(c, p, i, first, end);
  });
  if (const Fault fault = worst(faults, chunks); fault.status) { *culprit = fault.index; return fault.status; }
  if (const int32_t status = place_lattices(c, p, culprit)) return status == SG_MEMORY ? out_of_memory() : status;
  parallel(3 * V, [&](int i) {
    ViewState& s = c.views[i % V];
    if (i / V == 0) sort_by_depth(s, n);
    else if (i / V == 1) cut_rays(s, n, parts);
    else cut_pixels(s, c.image, n, parts);
  });
  c.kept = arena.mark();
  for (int v = 0; v < V; v++) c.views[v].take_images(arena, 1);
  if (arena.failed()) return out_of_memory();

  parallel(V * parts, [&](int i) {
    ViewState& s = c.views[i / parts];
    if (i % parts < s.ray_parts) attenuate_rays(s, p, i % parts);
  });
  parallel(V * chunks, [&](int i) {
    const int64_t v = i / chunks, first = (int64_t)(i % chunks) * kChunk;
    illuminate(c.views[v], p.ray[0] * p.ray[1], first, chunk_end(i % chunks, n), out.lit_area + v * n, out.cross_sections + v * n);
  });
  parallel(V * parts, [&](int i) {
    const ViewState& s = c.views[i / parts];
    if (i % parts >= s.pixel_parts) return;
    const Part& part = s.pixel_groups[i % parts];
    image_part(s.on_pixels, s.pixel_list + part.first, part.count(), part.strips, image_cut(p), part.memory);
  });
  const int groups = tasks_of(p.rows, kRowsPerTask);
  parallel(V * groups, [&](int i) {
    const int v = i / groups, first = i % groups * kRowsPerTask;
    add_parts(c.views[v], 0, first, smaller(p.rows, first + kRowsPerTask), p.columns, out.images + (int64_t)v * p.rows * p.columns);
  });
  arena.release(c.kept);
  return SG_OK;
}

int32_t backward_stages(sg_context& c, const sg_problem& p, const sg_gradients& g) {
  Arena& arena = c.arena;
  auto out_of_memory = [&] { arena.release(c.kept); return SG_MEMORY; };
  const int V = p.views, n = p.gaussians, chunks = chunks_of(n), parts = c.parts;
  Backward* scratch = arena.take<Backward>(V);
  float* shift_sums = arena.take<float>((int64_t)chunks * 2 * V);
  if (arena.failed()) return out_of_memory();
  take_backward_rays(c, p, g.transmittance, scratch);
  for (int v = 0; v < V; v++) scratch[v].take_on_pixels(arena, n, c.image, 1);
  if (arena.failed()) return out_of_memory();

  const int groups = tasks_of(c.image.count(), kStripsPerTask);
  parallel(V * groups, [&](int i) {
    const int64_t v = i / groups, first = i % groups * kStripsPerTask;
    write_strips(c.image, first, smaller(c.image.count(), first + kStripsPerTask), g.images + v * p.rows * p.columns, scratch[v].dS);
  });
  parallel(V * parts, [&](int i) {
    const int64_t v = i / parts;
    if (i % parts >= c.views[v].pixel_parts) return;
    image_part_backward(c.views[v], p, c.image, i % parts, g.cross_sections ? g.cross_sections + v * n : nullptr, scratch[v]);
  });
  parallel(V * parts, [&](int i) {
    const ViewState& s = c.views[i / parts];
    if (i % parts < s.ray_parts) attenuate_rays_backward(s, p, i % parts, scratch[i / parts]);
  });
  parallel(chunks, [&](int i) {
    differentiate(c, p, g, scratch, (int64_t)i * kChunk, chunk_end(i, n), shift_sums + (int64_t)i * 2 * V);
  });
  add_shifts(V, chunks, shift_sums, g.shift);
  arena.release(c.kept);
  return SG_OK;
}

int32_t forward(sg_context* context, const sg_problem* problem, const sg_outputs* out, int64_t* culprit) {
  int32_t status = SG_OK;
  together(worth_waking(*problem), [&] { status = forward_stages(*context, *problem, *out, culprit); });
  return status;
}

int32_t backward(sg_context* context, const sg_problem* problem, const sg_gradients* gradients) {
  int32_t status = SG_OK;
  together(worth_waking(*problem), [&] { status = backward_stages(*context, *problem, *gradients); });
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
const sg_engine SG_JOIN(sg_engine_, SG_ISA) = {SG_TEXT(SG_ISA), create, destroy, forward, backward, lattice, trace, amplitude_loss, adam, statistics,
                                             project_step, project_step_backward, attenuate_step, attenuate_step_backward,
                                             trace_step, splat_step, splat_step_backward};
