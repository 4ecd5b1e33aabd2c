// cuda_gradients.cuh: from six sums per Gaussian, view and plane to the gradients of a problem's arrays: everything after
// the pair loops. One thread a Gaussian; views and slots are summed in order.
#pragma once
#include "cuda_state.cuh"

namespace sarsplat {
namespace SG_ISA {

constexpr int kMaxCoefficients = 16;

SG_FN Moments<float> ray_moments(const State& s, int64_t j) {
  float sums[6] = {};
  for (int64_t slot = s.rays.ends[j] - s.rays.counts[j]; slot < s.rays.ends[j]; slot++)
    for (int k = 0; k < 6; k++) sums[k] += s.slot_moments[6 * slot + k] * kLn2;  // tau is kept in units of log2(e)
  return {sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]};
}
SG_FN Moments<float> pixel_moments(const State& s, int64_t j, float amplitude) {
  const float* m = s.pixel_moments + 6 * j;
  return {m[0] * amplitude, m[1] * amplitude, m[2] * amplitude, m[3] * amplitude, m[4] * amplitude, m[5] * amplitude};
}

SG_FN void write_gradients(const sg_problem& p, int64_t i, const Body<float>& b, const float* unit, float norm,
                           const BodyGradient<float>& total, float d_kappa, const float* d_harmonics, const sg_gradients& g) {
  float d_scale[3], d_quaternion[4];
  finish(b, unit, norm, total, d_scale, d_quaternion);
  for (int k = 0; k < 3; k++) { g.means[3 * i + k] = total.mean[k]; g.scales[3 * i + k] = d_scale[k]; }
  for (int k = 0; k < 4; k++) g.quaternions[4 * i + k] = d_quaternion[k];
  g.kappa[i] = d_kappa;
  for (int k = 0; k < kMaxCoefficients; k++)
    if (k < p.coefficients) g.harmonics[p.coefficients * i + k] = d_harmonics[k];
}

extern "C" __global__ void __launch_bounds__(kThreads) differentiate(sg_problem p, State s, sg_gradients g) {
  const int64_t n = p.gaussians, i = (int64_t)blockIdx.x * kThreads + thread();
  if (i >= n) return;
  const PlaneUnits u = units(p);
  float unit[4], norm;
  const Body<float> b = body(p, i, unit, norm);
  BodyGradient<float> total{};
  float d_harmonics[kMaxCoefficients] = {};
  for (int v = 0; v < p.views; v++) {
    const int64_t j = v * n + i;
    float planes[4] = {}, d_gamma0 = 0.0f;
    if (s.weight[j] != 0.0f) {  // what no ray sees has no gradient
      const ViewFrame f = frame(p, v);
      const float lit = s.weight[j] * (p.ray[0] * p.ray[1]), gamma0 = s.gamma0[j];
      const Moments<float> rays = ray_moments(s, j), pixels = pixel_moments(s, j, gamma0 * lit * s.pixels.splats[j].extra);
      accumulate(project(b, f, u), f, u, rays, pixels, p.peak != 0, total, planes);
      total.kappa += rays.m0;
      d_gamma0 = s.d_sigma[j] * lit;
      const float d_sum = p.amplitudes ? 0.0f : d_gamma0 * softplus(sum_of_harmonics(p, v, i)).slope;
      for (int k = 0; k < kMaxCoefficients; k++)
        if (k < p.coefficients) d_harmonics[k] += d_sum * p.basis[v * p.coefficients + k];
    }
    for (int k = 0; k < 4; k++) s.planes[4 * j + k] = planes[k];
    if (g.amplitudes) g.amplitudes[j] = d_gamma0;
  }
  write_gradients(p, i, b, unit, norm, total, p.kappa[i] > 0.0f ? total.kappa / p.kappa[i] : 0.0f, d_harmonics, g);
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
