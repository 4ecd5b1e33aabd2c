// differentiate.h: from six sums per Gaussian, view and plane to the gradients of a problem's arrays: everything after
// the pair loops.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

// six sums of up to kWidth Gaussians, transposed to vectors
Moments<F> gather(float lanes[6][kWidth]) {
  return {load(lanes[0]), load(lanes[1]), load(lanes[2]), load(lanes[3]), load(lanes[4]), load(lanes[5])};
}

struct Backward {                 // scratch of one backward pass, per view; h = dL/dsigma P A_c = dL/d(sum of w)
  float *d_sigma, *h, *ray_moments, *pixel_moments, *T, *B, *dS;
};

void differentiate(const sg_context& c, const sg_problem& p, const sg_gradients& g, const Backward* scratch, int64_t first,
                   int64_t end, float* shift_sums) {
  const PlaneUnits u = units(p);
  const float cell = p.ray[0] * p.ray[1];
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
      alignas(64) float ray[6][kWidth] = {}, pixel[6][kWidth] = {}, d_sigma[kWidth] = {}, weight[kWidth] = {};
      for (int k = 0; k < real; k++) {
        const int64_t j = i + k;
        if (s.weight[j] == 0.0f) continue;
        const Entry& e = s.on_rays[j];
        for (int slot = e.slot; slot <= e.slot + e.last_band - e.first_band; slot++)
          for (int q = 0; q < 6; q++) ray[q][k] += scratch[v].ray_moments[6 * (int64_t)slot + q];
        for (int q = 0; q < 6; q++) { ray[q][k] *= kLn2; pixel[q][k] = scratch[v].pixel_moments[6 * j + q]; }  // tau is in units of log2(e)
        weight[k] = s.weight[j];
        d_sigma[k] = scratch[v].d_sigma[j];
      }
      const Projection<F> proj = project(b, s.frame, u);
      const F lit = load(weight) * cell, phase = load(s.phase + i), amplitude = phase * lit * load(s.norm + i);
      Moments<F> mr = gather(ray), mp = gather(pixel);
      mp = {mp.m0 * amplitude, mp.mx * amplitude, mp.my * amplitude, mp.mxx * amplitude, mp.mxy * amplitude, mp.myy * amplitude};
      F planes[4];
      accumulate(proj, s.frame, u, mr, mp, p.peak != 0, total, planes);
      total.kappa += mr.m0;
      shift_sums[2 * v] += sum(planes[2]);
      shift_sums[2 * v + 1] += sum(planes[3]);
      if (g.planes)
        for (int k = 0; k < real; k++)
          for (int q = 0; q < 4; q++) g.planes[((int64_t)v * n + i + k) * 4 + q] = planes[q][k];
      const F d_phase = load(d_sigma) * lit;
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
    for (int k = 0; k < real; k++) {
      for (int a = 0; a < 3; a++) { g.means[3 * (i + k) + a] = total.mean[a][k]; g.scales[3 * (i + k) + a] = d_scale[a][k]; }
      for (int a = 0; a < 4; a++) g.quaternions[4 * (i + k) + a] = d_quaternion[a][k];
      g.kappa[i + k] = d_kappa[k];
    }
    write_columns(d_harmonics, p.coefficients, i, n, g.harmonics);
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
