// lobe_math.h: gamma0 in a lobe around the surface normal, and its adjoint, of one Gaussian.
//
// Of a Gaussian whose shortest axis is n: P(u) = p_min + b_0 + b_1 |n . u|^e, b = softplus of its first two parameters and
// ln e its third.
#pragma once
#include "gaussian_math.h"

namespace sarsplat {
namespace SG_ISA {

template <class F> struct Facing {
  typedef decltype(F{} <= F{}) Mask;
  Body<F> body;
  F unit[4], norm;             // q / |q|, |q|
  Mask first, second;          // which axis is the shortest, the first of equals: that one, or else that one
  F normal[3];
};
template <class F> SG_FN Facing<F> facing_of(const F* scale, const F* q) {
  Facing<F> f;
  for (int k = 0; k < 3; k++) f.body.scale[k] = scale[k];
  rotation(q[0], q[1], q[2], q[3], f.body.rot, f.unit, f.norm);
  f.first = (scale[0] <= scale[1]) & (scale[0] <= scale[2]);
  f.second = scale[1] <= scale[2];
  for (int j = 0; j < 3; j++)
    f.normal[j] = choose(f.first, f.body.rot[3 * j], choose(f.second, f.body.rot[3 * j + 1], f.body.rot[3 * j + 2]));
  return f;
}

// A cosine this small, squared, and an exponent this far from 1 on a logarithmic scale stand for those beyond.
constexpr float kGrazing = 1e-12f, kMostLog = 5.0f;

template <class F> struct Law {
  Softplus<F> b[2];
  F exponent, in_range;  // e, and whether it moves with its parameter
};
template <class F> SG_FN Law<F> law_of(const F* p) {
  const F log = choose(p[2] < -kMostLog, splat(-kMostLog), choose(p[2] > kMostLog, splat(kMostLog), p[2]));  // NaN stays NaN
  return {{softplus(p[0]), softplus(p[1])}, power2(log * kLog2e), choose(log == p[2], splat(1.0f), splat(0.0f))};
}

// The logarithm of |cosine|, and its power.
template <class F> struct Lobe { F log, height; };
template <class F> SG_FN Lobe<F> lobe(const Law<F>& law, F cosine) {
  const F log = natural_log(larger(cosine * cosine, splat(kGrazing))) * 0.5f;
  const F power = law.exponent * log * kLog2e;
  return {log, power2(choose(power < -120.0f, splat(-120.0f), power))};
}

template <class F> SG_FN F cosine_of(const Facing<F>& f, const float* u) {
  return f.normal[0] * u[0] + f.normal[1] * u[1] + f.normal[2] * u[2];
}
template <class F> SG_FN F seen_from(const Facing<F>& f, const Law<F>& law, const float* u, float p_min) {
  return law.b[0].value + p_min + law.b[1].value * lobe(law, cosine_of(f, u)).height;
}

// ---- adjoint ---------------------------------------------------------------------------------------------------------
// Sums over views, to which `spread_lobe` adds one.
template <class F> struct LobeGradient { F parameters[3], normal[3]; };
template <class F> SG_FN void spread_lobe(const Facing<F>& f, const Law<F>& law, const float* u, F seed, LobeGradient<F>& sum) {
  const F cosine = cosine_of(f, u);
  const Lobe<F> at = lobe(law, cosine);
  const F lit = seed * at.height;
  sum.parameters[0] += seed;
  sum.parameters[1] += lit;
  sum.parameters[2] += lit * at.log;
  const F slope = choose(cosine * cosine > kGrazing, lit / cosine, splat(0.0f));
  for (int j = 0; j < 3; j++) sum.normal[j] += slope * u[j];
}

// From the sums to dL/dparameters, in place, and dL/dq.
template <class F> SG_FN void finish_lobe(const Facing<F>& f, const Law<F>& law, LobeGradient<F>& sum, F* d_quaternion) {
  const F steepness = law.b[1].value * law.exponent;
  sum.parameters[0] *= law.b[0].slope;
  sum.parameters[1] *= law.b[1].slope;
  sum.parameters[2] *= steepness * law.in_range;
  BodyGradient<F> of_body{};
  for (int j = 0; j < 3; j++) {
    const F d_normal = sum.normal[j] * steepness;
    of_body.rot[3 * j] = choose(f.first, d_normal, splat(0.0f));
    const F others = d_normal - of_body.rot[3 * j];
    of_body.rot[3 * j + 1] = choose(f.second, others, splat(0.0f));
    of_body.rot[3 * j + 2] = others - of_body.rot[3 * j + 1];
  }
  F d_scale[3];
  finish(f.body, f.unit, f.norm, of_body, d_scale, d_quaternion);
}

}  // namespace SG_ISA
}  // namespace sarsplat
