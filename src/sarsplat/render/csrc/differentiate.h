// differentiate.h: from six sums per Gaussian, view and plane to the gradients of a problem's arrays: everything after
// the pair loops.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

struct Backward {                 // scratch of one backward pass, per view
  float *ray_moments, *pixel_moments;  // rows of kSums by slot and by id; of pixels, the seventh is dL/dsigma
  float *T, *B, *dS;
};

// One row of 16 numbers for each of kWidth Gaussians: sums over rays, sums over pixels, phase and A_lit.
void gather(const ViewState& s, const Backward& scratch, int64_t i, int64_t n, F* sums) {
  alignas(64) float rows[kWidth][16] = {};
  for (int k = 0; k < least(kWidth, (int)(n - i)); k++) {
    const RayEntry& ray = s.on_rays[i + k];
    const PixelEntry& pixel = s.on_pixels[i + k];
    if (pixel.lit == 0.0f) continue;  // no ray sees it
    float* row = rows[k];
    for (int slot = ray.slot; slot <= ray.slot + ray.last_band - ray.first_band; slot++)
      for (int q = 0; q < 6; q++) row[q] += scratch.ray_moments[kSums * (int64_t)slot + q];
    std::memcpy(row + 6, scratch.pixel_moments + kSums * (i + k), 7 * sizeof(float));
    row[13] = pixel.phase * pixel.lit * pixel.norm;
    row[14] = pixel.lit;
    row[15] = pixel.phase;
  }
  for_columns(rows[0], 16, 0, kWidth, [&](int q, F x) { sums[q] = x; });
}

// Rows of 16 numbers written to arrays of `count` numbers a row.
template <int Count> SG_FN void write_rows(const float* rows, int first, int64_t i, int real, float* out) {
  for (int k = 0; k < real; k++) std::memcpy(out + Count * (i + k), rows + 16 * k + first, Count * sizeof(float));
}

void differentiate(const sg_context& c, const sg_problem& p, const sg_gradients& g, const Backward* scratch, int64_t first,
                   int64_t end, float* shift_sums) {
  const PlaneUnits u = units(p);
  const int64_t n = p.gaussians;
  for (int64_t i = first; i < end; i += kWidth) {
    const int real = (int)(n - i < kWidth ? n - i : kWidth);
    const Body<F> b = body(c, i);
    const F zero = splat(0.0f), kappa = load(c.kappa + i);
    BodyGradient<F> total;
    for (F& x : total.mean) x = zero;
    for (F& x : total.g) x = zero;
    for (F& x : total.scale) x = zero;
    for (F& x : total.rot) x = zero;
    total.kappa = zero;
    F d_harmonics[16];
    for (int k = 0; k < p.coefficients; k++) d_harmonics[k] = zero;
    for (int v = 0; v < p.views; v++) {
      const ViewState& s = c.views[v];
      F sums[16];
      gather(s, scratch[v], i, n, sums);
      const F amplitude = sums[13], lit = sums[14], phase = sums[15], d_sigma = sums[12];
      const Moments<F> mr{sums[0] * kLn2, sums[1] * kLn2, sums[2] * kLn2, sums[3] * kLn2, sums[4] * kLn2, sums[5] * kLn2};  // tau is in units of log2(e)
      const Moments<F> mp{sums[6] * amplitude, sums[7] * amplitude, sums[8] * amplitude, sums[9] * amplitude, sums[10] * amplitude, sums[11] * amplitude};
      const Projection<F> proj = project(b, s.frame, u);
      F planes[4];
      accumulate(proj, s.frame, u, mr, mp, p.peak != 0, total, planes);
      total.kappa += mr.m0;
      shift_sums[2 * v] += sum(planes[2]);
      shift_sums[2 * v + 1] += sum(planes[3]);
      if (g.planes)
        for (int k = 0; k < real; k++)
          for (int q = 0; q < 4; q++) g.planes[((int64_t)v * n + i + k) * 4 + q] = planes[q][k];
      const F d_phase = d_sigma * lit;
      if (g.scattering)
        for (int k = 0; k < real; k++) g.scattering[(int64_t)v * n + i + k] = d_phase[k];
      if (p.coefficients) {
        const F soft = phase - p.p_min;                                       // d softplus = 1 - e^-softplus
        const F d_sum = d_phase * -power2_minus_one(power2_parts(larger(soft * -kLog2e, splat(-120.0f))));
        for (int k = 0; k < p.coefficients; k++) d_harmonics[k] += d_sum * p.basis[v * p.coefficients + k];
      }
    }
    F q[4], d_scale[3], d_quaternion[4];
    for (int k = 0; k < 4; k++) q[k] = load(c.unit[k] + i);
    finish(b, q, load(c.norm + i), total, d_scale, d_quaternion);
    const F d_kappa = choose(kappa > 0.0f, total.kappa / choose(kappa > 0.0f, kappa, splat(1.0f)), zero);
    F columns[16] = {total.mean[0], total.mean[1], total.mean[2], d_scale[0], d_scale[1], d_scale[2],
                     d_quaternion[0], d_quaternion[1], d_quaternion[2], d_quaternion[3], d_kappa};
    for (int k = 11; k < 16; k++) columns[k] = zero;
    alignas(64) float rows[kWidth * 16];
    write_columns(columns, 16, 0, kWidth, rows);
    write_rows<3>(rows, 0, i, real, g.means);
    write_rows<3>(rows, 3, i, real, g.scales);
    write_rows<4>(rows, 6, i, real, g.quaternions);
    write_rows<1>(rows, 10, i, real, g.kappa);
    write_columns(d_harmonics, p.coefficients, i, n, g.harmonics);
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
