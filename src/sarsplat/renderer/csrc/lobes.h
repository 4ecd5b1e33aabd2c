// lobes.h: gamma0 in a lobe around the surface normal, and its adjoint.
//
// Of a Gaussian whose shortest axis is n: P(u) = p_min + b_0 + b_1 |n . u|^e, b = softplus of its first two parameters and
// ln e its third.
#pragma once
#include "context.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

struct Facing {
  Body<F> body;
  F unit[4], norm;             // q / |q|, |q|
  I axis;                      // the shortest, the first of equals
  F normal[3];
};
SG_FN F on_axis(I axis, F x, F y, F z) { return choose(axis == 0, x, choose(axis == 1, y, z)); }

SG_FN Facing facing_of(const sg_lobes& l, int64_t i, int real) {
  Facing f;
  F q[4];
  F (&s)[3] = f.body.scale;
  read_few<3>(l.scales + 3 * i, real, s);
  read_few<4>(l.quaternions + 4 * i, real, q);
  for (int k = real; k < kWidth; k++) s[0][k] = s[1][k] = s[2][k] = q[0][k] = 1.0f;  // the rest are harmless
  rotation(q[0], q[1], q[2], q[3], f.body.rot, f.unit, f.norm);
  f.axis = choose((s[0] <= s[1]) & (s[0] <= s[2]), (I)(0), choose(s[1] <= s[2], (I)(1), (I)(2)));
  for (int j = 0; j < 3; j++) f.normal[j] = on_axis(f.axis, f.body.rot[3 * j], f.body.rot[3 * j + 1], f.body.rot[3 * j + 2]);
  return f;
}

// A cosine this small, squared, and an exponent this far from 1 on a logarithmic scale stand for those beyond.
constexpr float kGrazing = 1e-12f, kMostLog = 5.0f;

struct Law {
  Softplus<F> b[2];
  F exponent, in_range;  // e, and whether it moves with its parameter
};
SG_FN Law law_of(const sg_lobes& l, int64_t i, int real) {
  F p[3];
  read_few<3>(l.parameters + 3 * i, real, p);
  for (F& x : p)
    for (int k = real; k < kWidth; k++) x[k] = 0.0f;  // the rest are harmless
  const F log = smaller(larger(p[2], splat(-kMostLog)), splat(kMostLog));
  return {{softplus(p[0]), softplus(p[1])}, power2(log * kLog2e), choose(log == p[2], splat(1.0f), splat(0.0f))};
}

// The logarithm of |cosine|, and its power.
struct Lobe { F log, height; };
SG_FN Lobe lobe(const Law& law, F cosine) {
  const F log = natural_log(larger(cosine * cosine, splat(kGrazing))) * 0.5f;
  return {log, power2(larger(law.exponent * log * kLog2e, splat(-120.0f)))};
}

// visit(i, real, the Gaussians, their law) for kWidth Gaussians at a time
template <class Visit> static void over_lobes(const sg_lobes& l, Visit visit) {
  together((int64_t)l.views * l.gaussians > (1 << 17), [&] {
    by_width(l.gaussians, [&](int64_t i, int real) { visit(i, real, facing_of(l, i, real), law_of(l, i, real)); });
  });
}

void normal_lobes(const sg_lobes* lobes) {
  const sg_lobes& l = *lobes;
  over_lobes(l, [&](int64_t i, int real, const Facing& f, const Law& law) {
    for (int64_t v = 0; v < l.views; v++) {
      const float* u = l.directions + 3 * v;
      const F cosine = f.normal[0] * u[0] + f.normal[1] * u[1] + f.normal[2] * u[2];
      const F sum = law.b[0].value + l.p_min + law.b[1].value * lobe(law, cosine).height;
      store_some(l.amplitudes + v * l.gaussians + i, sum, real);
    }
  });
}

void normal_lobes_backward(const sg_lobes* lobes) {
  const sg_lobes& l = *lobes;
  over_lobes(l, [&](int64_t i, int real, const Facing& f, const Law& law) {
    const F zero = splat(0.0f);
    F d_parameters[3] = {zero, zero, zero}, d_normal[3] = {zero, zero, zero};
    for (int64_t v = 0; v < l.views; v++) {
      const float* u = l.directions + 3 * v;
      const F cosine = f.normal[0] * u[0] + f.normal[1] * u[1] + f.normal[2] * u[2];
      const F seed = load_some(l.d_amplitudes + v * l.gaussians + i, real);
      const Lobe at = lobe(law, cosine);
      const F lit = seed * at.height;
      d_parameters[0] += seed;
      d_parameters[1] += lit;
      d_parameters[2] += lit * at.log;
      const F slope = choose(cosine * cosine > kGrazing, lit / cosine, zero);
      for (int j = 0; j < 3; j++) d_normal[j] += slope * u[j];
    }
    const F steepness = law.b[1].value * law.exponent;
    for (F& x : d_normal) x *= steepness;
    d_parameters[0] *= law.b[0].slope;
    d_parameters[1] *= law.b[1].slope;
    d_parameters[2] *= steepness * law.in_range;
    write_few<3>(d_parameters, real, l.d_parameters + 3 * i);
    BodyGradient<F> sum;
    for (F& x : sum.g) x = zero;
    for (F& x : sum.scale) x = zero;
    for (int j = 0; j < 3; j++)
      for (int k = 0; k < 3; k++) sum.rot[3 * j + k] = choose(f.axis == k, d_normal[j], zero);
    F d_scale[3], d_quaternion[4];
    finish(f.body, f.unit, f.norm, sum, d_scale, d_quaternion);
    write_few<4>(d_quaternion, real, l.d_quaternions + 4 * i);
  });
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
