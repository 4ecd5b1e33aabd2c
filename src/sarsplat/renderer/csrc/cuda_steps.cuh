// cuda_steps.cuh: the steps of a pass one by one, with arrays in between: project, attenuate, splat. The pair loops of the
// computation plane are those of the fused pass; those of the imaging plane take several channels at a time.
#pragma once
#include "cuda_gradients.cuh"
#include "cuda_project.cuh"

namespace sarsplat {
namespace SG_ISA {

// ---- project ---------------------------------------------------------------------------------------------------------
extern "C" __global__ void __launch_bounds__(kThreads) write_projections(sg_problem p, State s, sg_projection out) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j < 0) return;
  if (view == 0) check_gaussian(p, s, i);
  if (i == 0) check(s, p.shift + 2 * view, 2, -p.farthest, p.farthest, SG_SHIFT, view);
  const PlaneUnits u = units(p);
  float unit[4], norm, slope[2];
  const Projection<float> g = project(body(p, i, unit, norm), frame(p, view), u);
  densest(g, u, slope);
  out.ray_centers[2 * j] = g.mean[0];
  out.ray_centers[2 * j + 1] = g.mean[1];
  roots_in_metres(whitening(g.cov_c, g.det_cw), u.ray, out.ray_roots + 3 * j);
  out.optical_depth[j] = p.kappa[i] * widening_ratio(g, u);
  out.range[j] = g.mean[2];
  out.tilt[2 * j] = slope[0] / u.ray[0];
  out.tilt[2 * j + 1] = slope[1] / u.ray[1];
  out.pixel_centers[2 * j] = g.mean[0] + p.shift[2 * view];
  out.pixel_centers[2 * j + 1] = g.mean[2] + p.shift[2 * view + 1];
  roots_in_metres(whitening(g.cov_i, g.det_iw), u.pixel, out.pixel_roots + 3 * j);
  if (p.coefficients) out.gamma0[j] = softplus(sum_of_harmonics(p, view, i)).value + p.p_min;
}

extern "C" __global__ void __launch_bounds__(kThreads)
differentiate_projections(sg_problem p, State s, sg_projection seeds, sg_gradients g) {
  const int64_t n = p.gaussians, i = (int64_t)blockIdx.x * kThreads + thread();
  if (i >= n) return;
  const PlaneUnits u = units(p);
  float unit[4], norm;
  const Body<float> b = body(p, i, unit, norm);
  BodyGradient<float> total{};
  float d_harmonics[kMaxCoefficients] = {};
  for (int v = 0; v < p.views; v++) {
    const int64_t j = v * n + i;
    const ViewFrame f = frame(p, v);
    const Projection<float> proj = project(b, f, u);
    const float ratio = widening_ratio(proj, u), d_depth = seeds.optical_depth[j], m0 = p.kappa[i] * ratio * d_depth;
    float* planes = s.planes + 4 * j;
    for (int k = 0; k < 2; k++) { planes[k] = seeds.ray_centers[2 * j + k]; planes[2 + k] = seeds.pixel_centers[2 * j + k]; }
    const Sym2<float> gc = from_root_gradient(whitening(proj.cov_c, proj.det_cw), u.ray, seeds.ray_roots + 3 * j, m0);
    const Sym2<float> gi = from_root_gradient(whitening(proj.cov_i, proj.det_iw), u.pixel, seeds.pixel_roots + 3 * j, 0.0f);
    spread(proj, f, u, planes, gc, gi, m0, total);
    total.kappa += ratio * d_depth;
    const float d_sum = p.coefficients ? seeds.gamma0[j] * softplus(sum_of_harmonics(p, v, i)).slope : 0.0f;
    for (int k = 0; k < kMaxCoefficients; k++)
      if (k < p.coefficients) d_harmonics[k] += d_sum * p.basis[v * p.coefficients + k];
  }
  write_gradients(p, i, b, unit, norm, total, total.kappa, d_harmonics, g);
}

// ---- attenuate -------------------------------------------------------------------------------------------------------
SG_FN void check_footprint(const sg_problem& p, const State& s, const float* center, const float* roots, int64_t j) {
  check(s, center, 2, -2.0f * p.farthest, 2.0f * p.farthest, SG_CENTERS, j);
  check(s, roots, 3, -p.steepest, p.steepest, SG_ROOTS, j);
  if (!(roots[0] >= p.flattest && roots[2] >= p.flattest)) report(s, SG_ROOTS, j);
}

extern "C" __global__ void __launch_bounds__(kThreads) place_rays(sg_problem p, State s, sg_projection in) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j >= 0) {
    check_footprint(p, s, in.ray_centers + 2 * j, in.ray_roots + 3 * j, j);
    check(s, in.optical_depth + j, 1, 0.0f, p.max_depth, SG_DEPTH, j);
    check(s, in.range + j, 1, -2.0f * p.farthest, 2.0f * p.farthest, SG_RANGE, j);
    check(s, in.tilt + 2 * j, 2, -p.strongest, p.strongest, SG_TILT, j);
    Placed<float> at = placed_from(in.ray_centers + 2 * j, in.ray_roots + 3 * j, p.ray);
    at.x *= 1.0f / p.ray[0];
    at.y *= 1.0f / p.ray[1];
    place_on_rays(p, s, j, at, in.optical_depth[j], in.range[j]);
    for (int k = 0; k < 2; k++) s.slope[2 * j + k] = in.tilt[2 * j + k] * p.ray[k];
  }
  bound_rays(s, view, j);
}

extern "C" __global__ void __launch_bounds__(kThreads) write_lit_areas(sg_problem p, State s, float* lit_area) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j >= 0) lit_area[j] = sum_of_weights(s, j) * (p.ray[0] * p.ray[1]);
}

extern "C" __global__ void __launch_bounds__(kThreads) seed_weights(sg_problem p, State s, const float* d_lit_area) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j >= 0) s.h[j] = d_lit_area ? d_lit_area[j] * (p.ray[0] * p.ray[1]) : 0.0f;
}

extern "C" __global__ void __launch_bounds__(kThreads) write_ray_gradients(sg_problem p, State s, sg_projection out) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j < 0) return;
  const Footprint g = s.rays.splats[j].g;
  const Moments<float> m = ray_moments(s, j);
  out.optical_depth[j] = m.m0 / (power2(g.height) * kLn2);
  footprint_gradient({g.ux, g.uy, g.vy}, p.ray, m, out.ray_centers + 2 * j, out.ray_roots + 3 * j);
}

// ---- splat -----------------------------------------------------------------------------------------------------------
constexpr int kTogether = 4;  // channels in one pass over the pixels

extern "C" __global__ void __launch_bounds__(kThreads) place_pixels(sg_problem p, State s, sg_projection in, sg_channels a) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j < 0) return;
  check_footprint(p, s, in.pixel_centers + 2 * j, in.pixel_roots + 3 * j, j);
  check(s, a.cross_sections + j * a.count, a.count, -p.strongest, p.strongest, SG_CROSS_SECTIONS, j);
  Placed<float> at = placed_from(in.pixel_centers + 2 * j, in.pixel_roots + 3 * j, p.pixel);
  at.x = pixel_x(p, at.x);
  at.y = pixel_y(p, at.y);
  const float lost = lost_to_cut(p);
  // sqrt(det Sigma') = 1 / (a c), m^2
  const float share = lost / (6.2831853f * (p.pixel[0] * kRootUnit) * (p.pixel[1] * kRootUnit));
  write_splat(s.pixels, j, at, root(p.image_cut), p.peak ? lost : at.w.ux * at.w.vy * share, 0.0f);
}

extern "C" __global__ void __launch_bounds__(kThreads) image_channels(sg_problem p, State s, sg_channels a, int32_t first_channel, float* images) {
  __shared__ Footprint staged[kThreads];
  __shared__ float heights[kThreads][kTogether];
  const Lattice lattice = lattice_of_tile(s.pixels.lattices, p.views, blockIdx.x);
  const Point pixel = point_of_thread(lattice, blockIdx.x);
  const int64_t first = s.pixels.starts[blockIdx.x];
  const int count = (int)(s.pixels.starts[blockIdx.x + 1] - first);
  const float cut = image_cut(p);
  float S[kTogether] = {};
  for (int begin = 0; begin < count; begin += kThreads) {
    const int size = count - begin < kThreads ? count - begin : kThreads;
    __syncthreads();  // nobody still reads what was staged before
    if (thread() < size) {
      const int32_t j = s.pixels.owners[s.pixels.order[first + begin + thread()]];
      const Footprint g = staged[thread()] = placed(s.pixels.splats[j].g, lattice);
      for (int c = 0; c < kTogether; c++)
        heights[thread()][c] = first_channel + c < a.count ? a.cross_sections[(int64_t)j * a.count + first_channel + c] * g.height : 0.0f;
    }
    __syncthreads();
    for (int k = 0; k < size; k++) {
      const float weight = imaging_weight(distance(offset(staged[k], (float)pixel.x, (float)pixel.y)), cut);
      for (int c = 0; c < kTogether; c++) S[c] += weight * heights[k][c];
    }
  }
  if (!pixel.inside) return;
  const int64_t size = (int64_t)p.rows * p.columns, image = lattice.first_point / size * a.count + first_channel;
  for (int c = 0; c < kTogether; c++)
    if (first_channel + c < a.count) images[(image + c) * size + (pixel.index - lattice.first_point)] = S[c];
}

// A warp is a Gaussian; moments of the first channels are written, those of others added.
extern "C" __global__ void __launch_bounds__(kThreads)
image_channels_backward(sg_problem p, State s, sg_channels a, int32_t first_channel, const float* d_images, float* d_amplitudes) {
  const int64_t j = (int64_t)blockIdx.x * kWarps + warp(), n = p.gaussians;
  if (j >= n * p.views) return;
  const Lattice lattice = s.pixels.lattices[j / n];
  const Footprint g = placed(s.pixels.splats[j].g, lattice);
  const Box box = points(g, s.pixels.reach + 2 * j, lattice);
  const float cut = image_cut(p);
  const int64_t size = (int64_t)p.rows * p.columns;
  const float* dS = d_images + (j / n * a.count + first_channel) * size;
  const float* amplitudes = a.cross_sections + j * a.count + first_channel;
  Moments<float> m{};
  float sums[kTogether] = {};
  if (!empty(box)) {
    const int64_t width = box.x.last - box.x.first + 1, pixels = width * (box.y.last - box.y.first + 1);
    for (int64_t k = lane(); k < pixels; k += kWarp) {
      const int x = box.x.first + (int)(k % width), y = box.y.first + (int)(k / width);
      const Offset<float> d = offset(g, (float)x, (float)y);
      const float weight = imaging_weight(distance(d), cut);
      float along = 0.0f;
      for (int c = 0; c < kTogether; c++) {
        if (first_channel + c >= a.count) break;
        const float seen = weight * dS[c * size + (int64_t)y * lattice.columns + x];
        sums[c] += seen;
        along += seen * amplitudes[c];
      }
      m.add(d, along);
    }
  }
  const float sum = sum6(m.m0, m.mu, m.mv, m.muu, m.muv, m.mvv, lane()) * g.height;
  const int sixth = sixth_of(lane());
  if (sixth >= 0) s.pixel_moments[6 * j + sixth] = first_channel ? s.pixel_moments[6 * j + sixth] + sum : sum;
  for (int c = 0; c < kTogether; c++) {
    const float total = warp_sum(sums[c]) * g.height;
    if (lane() == 0 && first_channel + c < a.count) d_amplitudes[j * a.count + first_channel + c] = total;
  }
}

extern "C" __global__ void __launch_bounds__(kThreads) write_pixel_gradients(sg_problem p, State s, sg_projection out) {
  int view, i;
  const int64_t j = pair_index(p, &view, &i);
  if (j < 0) return;
  const Footprint g = s.pixels.splats[j].g;
  Moments<float> m = pixel_moments(s, j, 1.0f);
  if (!p.peak) {  // d ln norm = da / a + dc / c
    m.muu -= m.m0 * (0.5f / kLn2);
    m.mvv -= m.m0 * (0.5f / kLn2);
  }
  footprint_gradient({g.ux, g.uy, g.vy}, p.pixel, m, out.pixel_centers + 2 * j, out.pixel_roots + 3 * j);
}

}  // namespace SG_ISA
}  // namespace sarsplat
