// cuda_place.cuh: footprints in metres to both planes, in cells and pixels, and to the slots of their tiles; and back, from
// the six moments of each to the gradients of footprints.
#pragma once
#include "cuda_state.cuh"

namespace sarsplat {
namespace SG_ISA {

// One Gaussian of sg_projection in a view, or its gradient (of neither range nor tilt).
struct OnPlane { float center[2], roots[3]; };
struct Projected { OnPlane rays, pixels; float depth, range, tilt[2]; };

SG_FN OnPlane on_plane(const float* centers, const float* roots, int64_t j) {
  return {{centers[2 * j], centers[2 * j + 1]}, {roots[3 * j], roots[3 * j + 1], roots[3 * j + 2]}};
}
SG_FN void write(const OnPlane& f, float* centers, float* roots, int64_t j) {
  copy(f.center, 2, centers + 2 * j);
  copy(f.roots, 3, roots + 3 * j);
}

// ---- values out of range ---------------------------------------------------------------------------------------------
// The first fault wins whatever the order of threads: an integer minimum.
SG_FN void report(const State& s, int status, int64_t index) {
  atomicMin(s.minima, (unsigned long long)status << 56 | (unsigned long long)index);
}
SG_FN void check(const State& s, const float* values, int count, float low, float high, int status, int64_t index) {
  bool good = true;
  for (int k = 0; k < count; k++) good = good && values[k] >= low && values[k] <= high;  // false for NaN
  if (!good) report(s, status, index);
}
SG_FN void check_footprint(const sg_problem& p, const State& s, const OnPlane& f, int64_t j) {
  check(s, f.center, 2, -2.0f * p.farthest, 2.0f * p.farthest, SG_CENTERS, j);
  check(s, f.roots, 3, -p.steepest, p.steepest, SG_ROOTS, j);
  if (!(f.roots[0] >= p.flattest && f.roots[2] >= p.flattest)) report(s, SG_ROOTS, j);
}

// ---- planes ----------------------------------------------------------------------------------------------------------
SG_FN uint32_t ordered(float x) {  // floats to unsigned, order kept; -0 equals 0
  const uint32_t bits = __float_as_uint(x + 0.0f);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

// at: in cells or pixels; reach: in standard deviations, negative: it touches nothing
SG_FN void write_splat(const Plane& plane, int64_t j, const Placed<float>& at, float reach, float height, float extra) {
  plane.splats[j] = {{at.x, at.y, at.w.ux, at.w.uy, at.w.vy, height}, extra};
  plane.reach[2 * j] = reach < 0.0f ? -1.0f : reach * at.deviation_x;
  plane.reach[2 * j + 1] = reach < 0.0f ? -1.0f : reach * at.deviation_y;
}

SG_FN void place_on_rays(const sg_problem& p, const State& s, int64_t j, const Projected& g) {
  Placed<float> at = placed_from(g.rays.center, g.rays.roots, p.ray);
  at.x *= 1.0f / p.ray[0];
  at.y *= 1.0f / p.ray[1];
  const bool touching = g.depth >= p.min_ray_depth;
  const float height = natural_log((touching ? g.depth : p.min_ray_depth) * kLog2e) * kLog2e;
  const float reach = touching ? root(larger(height - min_log_tau(p), 0.0f) * (2.0f * kLn2)) : -1.0f;
  write_splat(s.rays, j, at, reach, height, g.range);
  for (int k = 0; k < 2; k++) s.slope[2 * j + k] = g.tilt[k] * p.ray[k];
}

SG_FN void place_on_pixels(const sg_problem& p, const State& s, int64_t j, const OnPlane& pixels) {
  Placed<float> at = placed_from(pixels.center, pixels.roots, p.pixel);
  at.x = (at.x - p.center[0]) * (1.0f / p.pixel[0]) + 0.5f * (float)(p.columns - 1);
  at.y = (at.y - p.center[1]) * (1.0f / p.pixel[1]) + 0.5f * (float)(p.rows - 1);
  const float lost = 1.0f / (1.0f - expf(-0.5f * p.image_cut));
  // sqrt(det Sigma') = 1 / (a c), m^2
  const float share = lost / (6.2831853f * (p.pixel[0] * kRootUnit) * (p.pixel[1] * kRootUnit));
  write_splat(s.pixels, j, at, root(p.image_cut), p.peak ? lost : at.w.ux * at.w.vy * share, 0.0f);
}


// All threads of a block, which serves one view: the lattice has to hold this thread's footprint, if j >= 0.
SG_FN void bound_rays(const State& s, int view, int64_t j) {
  float lowest[4] = {kNever, kNever, kNever, kNever};
  if (j >= 0) {
    const Footprint g = s.rays.splats[j].g;
    const float* reach = s.rays.reach + 2 * j;
    if (reach[0] >= 0.0f) {
      lowest[0] = g.x - reach[0];
      lowest[1] = g.y - reach[1];
      lowest[2] = -(g.x + reach[0]);
      lowest[3] = -(g.y + reach[1]);
    }
  }
  for (int k = 0; k < 4; k++) {
    const float minimum = warp_min(lowest[k]);
    if (lane() == 0 && minimum < kNever) atomicMin(s.minima + 1 + 4 * view + k, (unsigned long long)ordered(minimum));
  }
}

// The footprints of a step alone: `attenuate` gives those on rays, `splat` those on pixels and their cross-sections.
extern "C" __global__ void __launch_bounds__(kThreads) place_footprints(sg_problem p, State s, sg_projection in, sg_channels a) {
  const auto [view, i, j] = this_pair(p);
  if (j >= 0 && in.ray_centers) {
    Projected g{on_plane(in.ray_centers, in.ray_roots, j), {}, in.optical_depth[j], in.range[j], {in.tilt[2 * j], in.tilt[2 * j + 1]}};
    check_footprint(p, s, g.rays, j);
    check(s, &g.depth, 1, 0.0f, p.max_depth, SG_DEPTH, j);
    check(s, &g.range, 1, -2.0f * p.farthest, 2.0f * p.farthest, SG_RANGE, j);
    check(s, g.tilt, 2, -p.strongest, p.strongest, SG_TILT, j);
    place_on_rays(p, s, j, g);
  }
  if (j >= 0 && in.pixel_centers) {
    const OnPlane pixels = on_plane(in.pixel_centers, in.pixel_roots, j);
    check_footprint(p, s, pixels, j);
    check(s, a.cross_sections + j * a.count, a.count, -p.strongest, p.strongest, SG_CROSS_SECTIONS, j);
    if (a.wavenumbers) check(s, a.slopes + 2 * j, 2, -p.strongest, p.strongest, SG_SLOPES, j);
    place_on_pixels(p, s, j, pixels);
  }
  if (in.ray_centers) bound_rays(s, view, j);
}

// ---- tiles -----------------------------------------------------------------------------------------------------------
SG_FN Box tiles(const Plane& plane, const Lattice& lattice, int64_t j) {
  const Footprint g = placed(plane.splats[j].g, lattice);
  const Box b = points(g, plane.reach + 2 * j, lattice);
  if (empty(b)) return {{0, -1}, {0, -1}};
  return {{b.x.first / kTile, b.x.last / kTile}, {b.y.first / kTile, b.y.last / kTile}};
}

// most: slots there is room for, of each Gaussian in each view
extern "C" __global__ void __launch_bounds__(kThreads) count_tiles(sg_problem p, State s, Plane plane, int64_t most) {
  const auto [view, i, j] = this_pair(p);
  if (j < 0) return;
  const Lattice& lattice = plane.lattices[view];
  const Box t = tiles(plane, lattice, j);
  const int64_t count = (int64_t)(t.x.last - t.x.first + 1) * (t.y.last - t.y.first + 1);
  if (count > most) atomicMin(s.minima + 1 + 4 * p.views, 0ull);
  int64_t left = plane.counts[j] = count < most ? count : most;
  for (int y = t.y.first; y <= t.y.last; y++)
    for (int x = t.x.first; x <= t.x.last && left > 0; x++, left--) atomicAdd(plane.in_tile + 1 + lattice.first_tile + y * lattice.tiles_x + x, 1u);
}

// Keys by which each tile's list comes front to back (by_depth), and for ties in the order of slots, which is that of
// Gaussians. If they are to be ranked, a tile's are in its part of `keys`, in any order: depth, then slot. Otherwise, for a
// stable sort of all, at their slots: tile, then depth.
extern "C" __global__ void __launch_bounds__(kThreads) list_tiles(sg_problem p, Plane plane, int32_t by_depth, int32_t ranked) {
  const auto [view, i, j] = this_pair(p);
  if (j < 0) return;
  const Lattice lattice = plane.lattices[view];
  const Box t = tiles(plane, lattice, j);
  const Key depth = by_depth ? ordered(plane.splats[j].extra) : 0;
  const int64_t end = plane.ends[j];
  int64_t slot = end - plane.counts[j];  // a footprint whose count was clipped has no more slots than that
  for (int y = t.y.first; y <= t.y.last; y++)
    for (int x = t.x.first; x <= t.x.last && slot < end; x++, slot++) {
      const int tile = lattice.first_tile + y * lattice.tiles_x + x;
      if (ranked) plane.keys[plane.starts[tile] + atomicSub(plane.in_tile + 1 + tile, 1u) - 1] = depth << 32 | (Key)slot;
      else plane.keys[slot] = (Key)tile << 32 | depth;
      plane.owners[slot] = (int32_t)j;
    }
}

// The place of an entry in its tile's list is how many keys there are smaller. A block counts for a chunk; as there are more
// threads than entries, each counts in a part of the list.
extern "C" __global__ void __launch_bounds__(kThreads) rank_chunks(sg_problem p, Plane plane) {
  __shared__ Key others[kThreads];
  __shared__ int counts[kThreads];
  const Chunk c = chunk(plane, p.views, blockIdx.x);
  if (c.size == 0) return;
  const int entry = thread() % kChunk, part = thread() - entry;
  const Key* keys = plane.keys + c.of.first;
  const Key mine = entry < c.size ? keys[c.begin + entry] : 0;
  int count = 0;
  for (int begin = 0; begin < c.of.count; begin += kThreads) {
    __syncthreads();
    others[thread()] = begin + thread() < c.of.count ? keys[begin + thread()] : ~0ull;
    __syncthreads();
    for (int k = part; k < part + kChunk; k++) count += others[k] < mine;
  }
  counts[thread()] = count;
  __syncthreads();
  if (thread() >= c.size) return;
  int64_t place = c.of.first;
  for (int k = thread(); k < kThreads; k += kChunk) place += counts[k];
  plane.order[place] = (int64_t)(mine & 0xffffffff);
}

// One thread: the first fault, or else that there was not room for everything, unless `broken` has an earlier one.
extern "C" __global__ void keep_fault(sg_problem p, State s, int64_t no_room, int64_t* broken) {
  if (thread() > 0 || *broken >= 0) return;
  bool left = s.minima[1 + 4 * p.views] == 0;
  for (int v = 0; v < p.views; v++) {
    const Lattice& l = s.rays.lattices[v];
    const float x = l.x0 - 0.5f, y = l.y0 - 0.5f, edges[4] = {x, y, -(x + (float)l.columns), -(y + (float)l.rows)};
    for (int k = 0; k < 4; k++) left = left || s.minima[1 + 4 * v + k] < ordered(edges[k]);
  }
  if (s.minima[0] != ~0ull) *broken = (int64_t)s.minima[0];
  else if (left) *broken = no_room;
}

// ---- adjoint ---------------------------------------------------------------------------------------------------------
// Slots are summed in order; tau is kept in units of log2(e).
SG_FN OnPlane ray_gradient(const sg_problem& p, const State& s, int64_t j, float& d_depth) {
  float sums[6] = {};
  for (int64_t slot = s.rays.ends[j] - s.rays.counts[j]; slot < s.rays.ends[j]; slot++)
    for (int k = 0; k < 6; k++) sums[k] += s.slot_moments[6 * slot + k] * kLn2;
  const Footprint g = s.rays.splats[j].g;
  OnPlane d;
  d_depth = sums[0] / (power2(g.height) * kLn2);
  footprint_gradient({g.ux, g.uy, g.vy}, p.ray, Moments<float>{sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]}, d.center, d.roots);
  return d;
}
SG_FN OnPlane pixel_gradient(const sg_problem& p, const State& s, int64_t j) {
  const float* sums = s.pixel_moments + 6 * j;
  Moments<float> m{sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]};
  if (!p.peak) {  // d ln norm = da / a + dc / c
    m.muu -= m.m0 * (0.5f / kLn2);
    m.mvv -= m.m0 * (0.5f / kLn2);
  }
  const Footprint g = s.pixels.splats[j].g;
  OnPlane d;
  footprint_gradient({g.ux, g.uy, g.vy}, p.pixel, m, d.center, d.roots);
  return d;
}

// Of a step alone, on its own plane.
extern "C" __global__ void __launch_bounds__(kThreads) write_footprint_gradients(sg_problem p, State s, sg_projection out) {
  const auto [view, i, j] = this_pair(p);
  if (j < 0) return;
  if (out.ray_centers) write(ray_gradient(p, s, j, out.optical_depth[j]), out.ray_centers, out.ray_roots, j);
  if (out.pixel_centers) write(pixel_gradient(p, s, j), out.pixel_centers, out.pixel_roots, j);
}

}  // namespace SG_ISA
}  // namespace sarsplat
