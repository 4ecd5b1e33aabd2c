// cuda_project.cuh: from a problem's arrays to footprints on both planes, and to the slots of their tiles.
#pragma once
#include "cuda_state.cuh"

namespace sarsplat {
namespace SG_ISA {

// ---- input -----------------------------------------------------------------------------------------------------------
// The first fault wins whatever the order of threads: an integer minimum.
SG_FN void report(const State& s, int status, int64_t index) {
  atomicMin(s.minima, (unsigned long long)status << 56 | (unsigned long long)index);
}
SG_FN void check(const State& s, const float* values, int count, float low, float high, int status, int64_t index) {
  bool good = true;
  for (int k = 0; k < count; k++) good = good && values[k] >= low && values[k] <= high;  // false for NaN
  if (!good) report(s, status, index);
}
SG_FN void check_gaussian(const sg_problem& p, const State& s, int64_t i) {
  const float* q = p.quaternions + 4 * i;
  check(s, p.means + 3 * i, 3, -p.farthest, p.farthest, SG_MEANS, i);
  check(s, q, 4, -p.strongest, p.strongest, SG_QUATERNIONS, i);
  if (!(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] >= 1.0f / (p.strongest * p.strongest))) report(s, SG_QUATERNIONS, i);
  check(s, p.scales + 3 * i, 3, p.min_scale, p.max_scale, SG_SCALES, i);
  check(s, p.kappa + i, 1, 0.0f, p.max_depth, SG_KAPPA, i);
  check(s, p.harmonics + p.coefficients * i, p.coefficients, -p.strongest, p.strongest, SG_SCATTERING, i);
}

// ---- projection ------------------------------------------------------------------------------------------------------
SG_FN uint32_t ordered(float x) {  // floats to unsigned, order kept; -0 equals 0
  const uint32_t bits = __float_as_uint(x + 0.0f);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

// at: in cells or pixels; reach: in standard deviations
SG_FN void write_splat(const Plane& plane, int64_t j, const Placed<float>& at, float reach, float height, float extra) {
  plane.splats[j] = {{at.x, at.y, at.w.ux, at.w.uy, at.w.vy, height}, extra};
  plane.reach[2 * j] = reach < 0.0f ? -1.0f : reach * at.deviation_x;
  plane.reach[2 * j + 1] = reach < 0.0f ? -1.0f : reach * at.deviation_y;
}
SG_FN Placed<float> placed_at(float x, float y, const Sym2<float>& cov, float det) {
  return {x, y, whitening(cov, det), root(cov.xx), root(cov.yy)};
}
SG_FN float pixel_x(const sg_problem& p, float x_m) { return (x_m - p.center[0]) * (1.0f / p.pixel[0]) + 0.5f * (float)(p.columns - 1); }
SG_FN float pixel_y(const sg_problem& p, float r_m) { return (r_m - p.center[1]) * (1.0f / p.pixel[1]) + 0.5f * (float)(p.rows - 1); }
SG_FN float lost_to_cut(const sg_problem& p) { return 1.0f / (1.0f - expf(-0.5f * p.image_cut)); }

SG_FN void place_on_rays(const sg_problem& p, const State& s, int64_t j, const Placed<float>& at, float kappa, float range) {
  const bool touching = kappa >= p.min_ray_depth;
  const float height = natural_log((touching ? kappa : p.min_ray_depth) * kLog2e) * kLog2e;
  const float reach = touching ? root(larger(height - min_log_tau(p), 0.0f) * (2.0f * kLn2)) : -1.0f;
  write_splat(s.rays, j, at, reach, height, range);
}

SG_FN float gamma0_of(const sg_problem& p, const State& s, int view, int64_t i, int64_t j) {
  if (p.amplitudes) {
    check(s, p.amplitudes + j, 1, -p.strongest, p.strongest, SG_AMPLITUDES, j);
    return p.amplitudes[j];
  }
  return softplus(sum_of_harmonics(p, view, i)).value + p.p_min;
}

SG_FN void project_pair(const sg_problem& p, const State& s, int view, int64_t i, int64_t j) {
  const PlaneUnits u = units(p);
  float unit[4], norm;
  const Projection<float> g = project(body(p, i, unit, norm), frame(p, view), u);
  const Placed<float> on_rays = placed_at(g.mean[0] * (1.0f / u.ray[0]), g.mean[1] * (1.0f / u.ray[1]), g.cov_c, g.det_cw);
  place_on_rays(p, s, j, on_rays, p.kappa[i] * widening_ratio(g, u), g.mean[2]);
  densest(g, u, s.slope + 2 * j);
  s.gamma0[j] = gamma0_of(p, s, view, i, j);
  const float* shift = p.shift + 2 * view;
  const float lost = lost_to_cut(p);
  write_splat(s.pixels, j, placed_at(pixel_x(p, g.mean[0] + shift[0]), pixel_y(p, g.mean[2] + shift[1]), g.cov_i, g.det_iw),
              root(p.image_cut), 0.0f,
              p.peak ? lost : lost / (6.2831853f * p.pixel[0] * p.pixel[1] * root(g.det_iw)));
}

constexpr float kNever = 3e38f;  // the bound of what touches no ray

// All threads of a block, which serves one view: the lattice has to hold this thread's footprint, if j >= 0.
SG_FN void bound_rays(const State& s, int view, int64_t j) {
  float lowest[4] = {kNever, kNever, kNever, kNever};
  if (j >= 0) {
    const Footprint g = s.rays.splats[j].g;
    const float *reach = s.rays.reach + 2 * j;
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

extern "C" __global__ void __launch_bounds__(kThreads) project_gaussians(sg_problem p, State s) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j >= 0) {
    if (view == 0) check_gaussian(p, s, i);
    if (i == 0) check(s, p.shift + 2 * view, 2, -1e9f, 1e9f, SG_SHIFT, view);
    project_pair(p, s, view, i, j);
  }
  bound_rays(s, view, j);
}

// ---- tiles -----------------------------------------------------------------------------------------------------------
SG_FN Box tiles(const Plane& plane, const Lattice& lattice, int64_t j) {
  const Footprint g = placed(plane.splats[j].g, lattice);
  const Box b = points(g, plane.reach + 2 * j, lattice);
  if (empty(b)) return {{0, -1}, {0, -1}};
  return {{b.x.first / kTile, b.x.last / kTile}, {b.y.first / kTile, b.y.last / kTile}};
}

extern "C" __global__ void __launch_bounds__(kThreads) count_tiles(sg_problem p, Plane plane) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j < 0) return;
  const Box t = tiles(plane, plane.lattices[view], j);
  plane.counts[j] = (int64_t)(t.x.last - t.x.first + 1) * (t.y.last - t.y.first + 1);
}

// by_depth: front to back inside a tile; otherwise, and for ties, by index, since the sort is stable. A footprint whose
// count was clipped (cuda.py) has no more slots than that.
extern "C" __global__ void __launch_bounds__(kThreads) list_tiles(sg_problem p, Plane plane, int32_t by_depth) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j < 0) return;
  const Lattice lattice = plane.lattices[view];
  const Box t = tiles(plane, lattice, j);
  const int64_t depth = by_depth ? (int64_t)ordered(plane.splats[j].extra) : 0;
  const int64_t end = plane.ends[j];
  int64_t slot = end - plane.counts[j];
  for (int y = t.y.first; y <= t.y.last; y++)
    for (int x = t.x.first; x <= t.x.last && slot < end; x++, slot++) {
      plane.keys[slot] = (int64_t)(lattice.first_tile + y * lattice.tiles_x + x) << 32 | depth;
      plane.owners[slot] = (int32_t)j;
    }
}

}  // namespace SG_ISA
}  // namespace sarsplat
