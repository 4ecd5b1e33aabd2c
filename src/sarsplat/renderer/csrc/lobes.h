// lobes.h: gamma0 in lobes around the surface normal, and its adjoint.
//
// Of a Gaussian whose shortest axis is n: P(u) = p_min + b_0 + sum_j b_j exp(k_j (c - 1)), c = (n . u)^2, b = softplus of its
// parameters; a lobe of sharpness k_j = 0 is c itself.
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

// The height of a lobe at c, and its slope there.
struct Lobe { F height, slope; };
SG_FN Lobe lobe(float sharpness, F c) {
  if (sharpness == 0.0f) return {c, splat(1.0f)};
  const F height = power2(larger((c - 1.0f) * (sharpness * kLog2e), splat(-120.0f)));
  return {height, height * sharpness};
}

// visit(i, real, the Gaussians, b and its slopes) for kWidth Gaussians at a time
template <class Visit> static void over_lobes(const sg_lobes& l, Visit visit) {
  together((int64_t)l.views * l.gaussians > (1 << 17), [&] {
    by_width(l.gaussians, [&](int64_t i, int real) {
      F parameters[kFields];
      Softplus<F> b[kFields];
      read_rows(l.parameters + (l.lobes + 1) * i, l.lobes + 1, real, parameters);
      for (int k = 0; k <= l.lobes; k++) b[k] = softplus(parameters[k]);
      visit(i, real, facing_of(l, i, real), b);
    });
  });
}

void normal_lobes(const sg_lobes* lobes) {
  const sg_lobes& l = *lobes;
  over_lobes(l, [&](int64_t i, int real, const Facing& f, const Softplus<F>* b) {
    for (int64_t v = 0; v < l.views; v++) {
      const float* u = l.directions + 3 * v;
      const F cosine = f.normal[0] * u[0] + f.normal[1] * u[1] + f.normal[2] * u[2];
      F sum = b[0].value + l.p_min;
      for (int j = 0; j < l.lobes; j++) sum += b[j + 1].value * lobe(l.sharpness[j], cosine * cosine).height;
      store_some(l.amplitudes + v * l.gaussians + i, sum, real);
    }
  });
}

void normal_lobes_backward(const sg_lobes* lobes) {
  const sg_lobes& l = *lobes;
  over_lobes(l, [&](int64_t i, int real, const Facing& f, const Softplus<F>* b) {
    const F zero = splat(0.0f);
    F d_parameters[kFields], d_normal[3] = {zero, zero, zero};
    for (F& x : d_parameters) x = zero;
    for (int64_t v = 0; v < l.views; v++) {
      const float* u = l.directions + 3 * v;
      const F cosine = f.normal[0] * u[0] + f.normal[1] * u[1] + f.normal[2] * u[2];
      const F seed = load_some(l.d_amplitudes + v * l.gaussians + i, real);
      F slope = zero;
      d_parameters[0] += seed;
      for (int j = 0; j < l.lobes; j++) {
        const Lobe at = lobe(l.sharpness[j], cosine * cosine);
        d_parameters[j + 1] += seed * at.height;
        slope += b[j + 1].value * at.slope;
      }
      slope *= seed * cosine * 2.0f;
      for (int j = 0; j < 3; j++) d_normal[j] += slope * u[j];
    }
    for (int k = 0; k <= l.lobes; k++) d_parameters[k] *= b[k].slope;
    write_rows(d_parameters, l.lobes + 1, real, l.d_parameters + (l.lobes + 1) * i);
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
