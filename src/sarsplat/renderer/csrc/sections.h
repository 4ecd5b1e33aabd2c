// sections.h: complex cross-sections of pairs of channels, with the phase and the decorrelation of their elevations, and how
// the phase changes across footprints; and its adjoint.
//
// Of a Gaussian (mu, Sigma) in the radar frame, what is imaged at the displacement d from the centre of its footprint lies at
// the elevation mu_y + s d, with the variance Sigma_yy - s (Sigma_yx, Sigma_yz), s = (Sigma_yx, Sigma_yz) L^T L.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

struct Elevation {
  F at, yx, yy, yz;          // mu_y and Sigma_r
  F a, b, c;                 // L = (a b; 0 c)
  F slope[2], variance;      // s, and the variance if it is positive
};

SG_FN Elevation elevation_of(const Body<F>& body, const float* frame, const F (&roots)[3]) {
  F axis[3][3], var[3];
  for (int k = 0; k < 3; k++) {
    var[k] = body.scale[k] * body.scale[k];
    for (int i = 0; i < 3; i++)
      axis[i][k] = body.rot[k] * frame[3 * i] + body.rot[3 + k] * frame[3 * i + 1] + body.rot[6 + k] * frame[3 * i + 2];
  }
  auto dot = [&](int i, int j) { return axis[i][0] * axis[j][0] * var[0] + axis[i][1] * axis[j][1] * var[1] + axis[i][2] * axis[j][2] * var[2]; };
  Elevation e;
  e.at = body.mean[0] * frame[3] + body.mean[1] * frame[4] + body.mean[2] * frame[5];
  e.yx = dot(1, 0); e.yy = dot(1, 1); e.yz = dot(1, 2);
  e.a = roots[0]; e.b = roots[1]; e.c = roots[2];
  const F mixed = e.a * e.b;
  e.slope[0] = e.a * e.a * e.yx + mixed * e.yz;
  e.slope[1] = mixed * e.yx + (e.b * e.b + e.c * e.c) * e.yz;
  e.variance = larger(e.yy - e.slope[0] * e.yx - e.slope[1] * e.yz, splat(0.0f));
  return e;
}

SG_FN Phase<F> turned(const Elevation& e, float number) {  // what is left, with its phase
  const Phase<F> p = phase(e.at * (number * 0.15915494f));
  const F left = power2(larger(e.variance * (-0.5f * kLog2e * number * number), splat(-120.0f)));
  return {p.c * left, p.s * left};
}

// lane k of the result: p[stride k]
SG_FN F gathered(const float* p, int64_t stride, int real) {
  F x = splat(0.0f);
  for (int k = 0; k < real; k++) x[k] = p[stride * k];
  return x;
}
SG_FN void scattered(float* p, int64_t stride, int real, F x) {
  for (int k = 0; k < real; k++) p[stride * k] = x[k];
}

template <class Visit> static void over_sections(const sg_sections& s, Visit visit) {
  by_width(s.gaussians, [&](int64_t i, int real) { visit(i, real, read_bodies(s.means, s.quaternions, s.scales, i, real)); });
}

void sections_forward(const sg_sections& s) {
  const int64_t n = s.gaussians, D = s.pairs, S = s.shared ? 1 : D;
  over_sections(s, [&](int64_t i, int real, const Bodies& bodies) {
    for (int64_t v = 0; v < s.views; v++) {
      const int64_t at = v * n + i;
      F roots[3];
      read_few<3>(s.roots + 3 * at, real, roots);
      const Elevation e = elevation_of(bodies.body, s.frames + 9 * v, roots);
      write_few<2>(e.slope, real, s.slopes + 2 * at);
      for (int64_t d = 0; d < D; d++) {
        const Phase<F> t = turned(e, s.numbers[v * D + d]);
        const F re = gathered(s.real + S * at + (s.shared ? 0 : d), S, real);
        const F im = s.imaginary ? gathered(s.imaginary + D * at + d, D, real) : splat(0.0f);
        scattered(s.parts + 2 * (D * at + d), 2 * D, real, re * t.c - im * t.s);
        scattered(s.parts + 2 * (D * at + d) + 1, 2 * D, real, re * t.s + im * t.c);
      }
    }
  });
}

void sections_backward(const sg_sections& s) {
  const int64_t n = s.gaussians, D = s.pairs, S = s.shared ? 1 : D;
  over_sections(s, [&](int64_t i, int real, const Bodies& bodies) {
    const F zero = splat(0.0f);
    BodyGradient<F> sum;
    for (F& x : sum.mean) x = zero;
    for (F& x : sum.g) x = zero;
    for (F& x : sum.scale) x = zero;
    for (F& x : sum.rot) x = zero;
    for (int64_t v = 0; v < s.views; v++) {
      const int64_t at = v * n + i;
      const float* frame = s.frames + 9 * v;
      F roots[3], d_slope[2];
      read_few<3>(s.roots + 3 * at, real, roots);
      read_few<2>(s.d_slopes + 2 * at, real, d_slope);
      const Elevation e = elevation_of(bodies.body, frame, roots);
      F d_at = zero, d_variance = zero, d_shared = zero;
      for (int64_t d = 0; d < D; d++) {
        const float number = s.numbers[v * D + d];
        const Phase<F> t = turned(e, number);
        const F re = gathered(s.real + S * at + (s.shared ? 0 : d), S, real);
        const F im = s.imaginary ? gathered(s.imaginary + D * at + d, D, real) : zero;
        const F g_re = gathered(s.d_parts + 2 * (D * at + d), 2 * D, real), g_im = gathered(s.d_parts + 2 * (D * at + d) + 1, 2 * D, real);
        const F out_re = re * t.c - im * t.s, out_im = re * t.s + im * t.c, d_real = g_re * t.c + g_im * t.s;
        d_at += (g_im * out_re - g_re * out_im) * number;
        d_variance += (g_re * out_re + g_im * out_im) * (-0.5f * number * number);
        if (s.shared) d_shared += d_real;
        else scattered(s.d_real + D * at + d, D, real, d_real);
        if (s.imaginary) scattered(s.d_imaginary + D * at + d, D, real, g_im * t.c - g_re * t.s);
      }
      if (s.shared) store_some(s.d_real + at, d_shared, real);
      d_variance = choose(e.variance > 0.0f, d_variance, zero);
      const F d0 = d_slope[0] - d_variance * e.yx, d1 = d_slope[1] - d_variance * e.yz, mixed = e.a * e.b;
      const F d_roots[3] = {d0 * (e.a * e.yx * 2.0f + e.b * e.yz) + d1 * e.b * e.yx,
                            d0 * e.a * e.yz + d1 * (e.a * e.yx + e.b * e.yz * 2.0f), d1 * e.c * e.yz * 2.0f};
      write_few<3>(d_roots, real, s.d_roots + 3 * at);
      // the symmetric gradient of Sigma_r: beside its diagonal two entries share
      const F gxy = (d0 * e.a * e.a + d1 * mixed - d_variance * e.slope[0]) * 0.5f;
      const F gyz = (d0 * mixed + d1 * (e.b * e.b + e.c * e.c) - d_variance * e.slope[1]) * 0.5f;
      for (int j = 0; j < 3; j++) sum.mean[j] += d_at * frame[3 + j];
      for (int j = 0, m = 0; j < 3; j++) {  // G += R_r^T g R_r
        const F x = gxy * frame[3 + j], y = gxy * frame[j] + d_variance * frame[3 + j] + gyz * frame[6 + j], z = gyz * frame[3 + j];
        for (int k = j; k < 3; k++, m++) sum.g[m] += x * frame[k] + y * frame[3 + k] + z * frame[6 + k];
      }
    }
    F d_scale[3], d_quaternion[4];
    finish(bodies.body, bodies.unit, bodies.norm, sum, d_scale, d_quaternion);
    write_few<3>(sum.mean, real, s.d_means + 3 * i);
    write_few<4>(d_quaternion, real, s.d_quaternions + 4 * i);
    write_few<3>(d_scale, real, s.d_scales + 3 * i);
  });
}

int32_t pair_sections(sg_context*, const sg_sections* sections) {
  (sections->d_parts ? sections_backward : sections_forward)(*sections);
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
