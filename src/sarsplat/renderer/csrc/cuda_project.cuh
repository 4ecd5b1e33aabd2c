// cuda_project.cuh: the step `project` and its adjoint: Gaussians to footprints on both planes. In a whole rendering a
// footprint stays in registers and is placed at once (cuda_place.cuh); alone, the step writes it out.
#pragma once
#include "cuda_place.cuh"

namespace sarsplat {
namespace SG_ISA {

SG_FN void check_gaussian(const sg_problem& p, const State& s, int64_t i) {
  const float* q = p.quaternions + 4 * i;
  check(s, p.means + 3 * i, 3, -p.farthest, p.farthest, SG_MEANS, i);
  check(s, q, 4, -p.strongest, p.strongest, SG_QUATERNIONS, i);
  if (!(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] >= 1.0f / (p.strongest * p.strongest))) report(s, SG_QUATERNIONS, i);
  check(s, p.scales + 3 * i, 3, p.min_scale, p.max_scale, SG_SCALES, i);
  check(s, p.kappa + i, 1, 0.0f, p.max_depth, SG_KAPPA, i);
  check(s, p.harmonics + p.coefficients * i, p.coefficients, -p.strongest, p.strongest, SG_SCATTERING, i);
}

SG_FN Projected project_pair(const sg_problem& p, int view, int64_t i) {
  const PlaneUnits u = units(p);
  float unit[4], norm;
  const Projection<float> g = project(body(p, i, unit, norm), frame(p, view), u);
  const float* shift = p.shift + 2 * view;
  Projected out{{{g.mean[0], g.mean[1]}, {}}, {{g.mean[0] + shift[0], g.mean[2] + shift[1]}, {}}, p.kappa[i] * widening_ratio(g, u), g.mean[2], {}};
  roots_in_metres(whitening(g.cov_c, g.det_cw), u.ray, out.rays.roots);
  roots_in_metres(whitening(g.cov_i, g.det_iw), u.pixel, out.pixels.roots);
  densest(g, u, out.tilt);
  for (int k = 0; k < 2; k++) out.tilt[k] /= u.ray[k];
  return out;
}

// out: of a whole rendering, gamma0 alone
extern "C" __global__ void __launch_bounds__(kThreads) project_gaussians(sg_problem p, State s, sg_projection out) {
  const auto [view, i, j] = this_pair(p);
  if (j >= 0) {
    if (view == 0) check_gaussian(p, s, i);
    if (i == 0) check(s, p.shift + 2 * view, 2, -p.farthest, p.farthest, SG_SHIFT, view);
    if (p.amplitudes) check(s, p.amplitudes + j * p.channels, p.channels, -p.strongest, p.strongest, SG_AMPLITUDES, j);
    if (p.coefficients) out.gamma0[j] = softplus(sum_of_harmonics(p, view, i)).value + p.p_min;
    Projected g = project_pair(p, view, i);
    if (out.ray_centers) {
      write(g.rays, out.ray_centers, out.ray_roots, j);
      write(g.pixels, out.pixel_centers, out.pixel_roots, j);
      out.optical_depth[j] = g.depth;
      out.range[j] = g.range;
      copy(g.tilt, 2, out.tilt + 2 * j);
    } else {
      if (p.in_sight) g.depth *= p.in_sight[j];
      place_on_rays(p, s, j, g);
      place_on_pixels(p, s, j, g.pixels);
    }
  }
  if (!out.ray_centers) bound_rays(s, view, j);
}

// A pair's share of what its Gaussian's gradient is made of: BodyGradient, dL/dkappa, and dL/d(sum of harmonics).
struct PairGradient { BodyGradient<float> body; float kappa, sum; };
static_assert(sizeof(PairGradient) == 23 * sizeof(float), "cuda.py makes room for so many");

// seeds: of a whole rendering, gamma0 alone; the rest follows from the moments of both planes.
extern "C" __global__ void __launch_bounds__(kThreads)
project_pairs_backward(sg_problem p, State s, sg_projection seeds, PairGradient* shares) {
  const auto [v, i, j] = this_pair(p);
  if (j < 0) return;
  PairGradient share{};
  float planes[4] = {};
  if (!s.lit_area || s.lit_area[j] != 0.0f) {  // what no ray sees has no gradient
    const PlaneUnits u = units(p);
    const bool alone = seeds.ray_centers;
    float d_depth = alone ? seeds.optical_depth[j] : 0.0f, unit[4], norm;
    const OnPlane rays = alone ? on_plane(seeds.ray_centers, seeds.ray_roots, j) : ray_gradient(p, s, j, d_depth);
    const OnPlane pixels = alone ? on_plane(seeds.pixel_centers, seeds.pixel_roots, j) : pixel_gradient(p, s, j);
    const ViewFrame f = frame(p, v);
    const Projection<float> proj = project(body(p, i, unit, norm), f, u);
    const float ratio = widening_ratio(proj, u), m0 = p.kappa[i] * ratio * d_depth;
    copy(rays.center, 2, planes);
    copy(pixels.center, 2, planes + 2);
    const Sym2<float> gc = from_root_gradient(whitening(proj.cov_c, proj.det_cw), u.ray, rays.roots, m0);
    const Sym2<float> gi = from_root_gradient(whitening(proj.cov_i, proj.det_iw), u.pixel, pixels.roots, 0.0f);
    spread(proj, f, u, planes, gc, gi, m0, share.body);
    share.kappa = ratio * d_depth;
    if (p.coefficients) share.sum = seeds.gamma0[j] * softplus(sum_of_harmonics(p, v, i)).slope;
  }
  copy(planes, 4, s.planes + 4 * j);
  shares[j] = share;
}

// One thread a Gaussian; views are summed in order.
extern "C" __global__ void __launch_bounds__(kThreads) project_gaussians_backward(sg_problem p, const PairGradient* shares, sg_gradients g) {
  constexpr int kNumbers = sizeof(PairGradient) / sizeof(float);
  const int64_t n = p.gaussians, i = (int64_t)blockIdx.x * kThreads + thread();
  if (i >= n) return;
  union { PairGradient total; float numbers[kNumbers]; } sum{};
  for (int v = 0; v < p.views; v++) {
    const float* share = (const float*)(shares + v * n + i);
    for (int k = 0; k < kNumbers; k++) sum.numbers[k] += share[k];
  }
  float unit[4], norm, d_scale[3], d_quaternion[4];
  const Body<float> b = body(p, i, unit, norm);
  finish(b, unit, norm, sum.total.body, d_scale, d_quaternion);
  copy(sum.total.body.mean, 3, g.means + 3 * i);
  copy(d_scale, 3, g.scales + 3 * i);
  copy(d_quaternion, 4, g.quaternions + 4 * i);
  g.kappa[i] = sum.total.kappa;
  for (int k = 0; k < p.coefficients; k++) {
    float d = 0.0f;
    for (int v = 0; v < p.views; v++) d += shares[v * n + i].sum * p.basis[v * p.coefficients + k];
    g.harmonics[p.coefficients * i + k] = d;
  }
}

// A block is a view: dL/dshift, the sum of dL/dmu_I.
extern "C" __global__ void __launch_bounds__(kThreads) sum_shift(sg_problem p, State s, float* d_shift) {
  __shared__ float sums[kWarps][2];
  float x = 0.0f, r = 0.0f;
  for (int64_t i = thread(); i < p.gaussians; i += kThreads) {
    const float* planes = s.planes + 4 * (blockIdx.x * (int64_t)p.gaussians + i);
    x += planes[2];
    r += planes[3];
  }
  x = warp_sum(x);
  r = warp_sum(r);
  if (lane() == 0) { sums[warp()][0] = x; sums[warp()][1] = r; }
  __syncthreads();
  if (thread() >= 2) return;
  float total = 0.0f;
  for (int k = 0; k < kWarps; k++) total += sums[k][thread()];
  d_shift[2 * blockIdx.x + thread()] = total;
}

}  // namespace SG_ISA
}  // namespace sarsplat
