// lobes.h: gamma0 in lobes around the surface normals of Gaussians, and its adjoint; lobe_math.h says of which form.
#pragma once
#include "context.h"
#include "lobe_math.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

SG_FN Facing<F> facing_at(const sg_lobes& l, int64_t i, int real) {
  F s[3], q[4];
  read_few<3>(l.scales + 3 * i, real, s);
  read_few<4>(l.quaternions + 4 * i, real, q);
  for (int k = real; k < kWidth; k++) s[0][k] = s[1][k] = s[2][k] = q[0][k] = 1.0f;  // the rest are harmless
  return facing_of(s, q);
}
SG_FN Law<F> law_at(const sg_lobes& l, int64_t i, int real) {
  F p[3];
  read_few<3>(l.parameters + 3 * i, real, p);
  for (F& x : p)
    for (int k = real; k < kWidth; k++) x[k] = 0.0f;  // the rest are harmless
  return law_of(p);
}

// visit(i, real, the Gaussians, their law) for kWidth Gaussians at a time
template <class Visit> static void over_lobes(const sg_lobes& l, Visit visit) {
  together((int64_t)l.views * l.gaussians > (1 << 17), [&] {
    by_width(l.gaussians, [&](int64_t i, int real) { visit(i, real, facing_at(l, i, real), law_at(l, i, real)); });
  });
}

void lobes_forward(const sg_lobes& l) {
  over_lobes(l, [&](int64_t i, int real, const Facing<F>& f, const Law<F>& law) {
    for (int64_t v = 0; v < l.views; v++)
      store_some(l.amplitudes + v * l.gaussians + i, seen_from(f, law, l.directions + 3 * v, l.p_min), real);
  });
}

void lobes_backward(const sg_lobes& l) {
  over_lobes(l, [&](int64_t i, int real, const Facing<F>& f, const Law<F>& law) {
    LobeGradient<F> sum{};
    for (int64_t v = 0; v < l.views; v++)
      spread_lobe(f, law, l.directions + 3 * v, load_some(l.d_amplitudes + v * l.gaussians + i, real), sum);
    F d_quaternion[4];
    finish_lobe(f, law, sum, d_quaternion);
    write_few<3>(sum.parameters, real, l.d_parameters + 3 * i);
    write_few<4>(d_quaternion, real, l.d_quaternions + 4 * i);
  });
}

int32_t normal_lobes(sg_context*, const sg_lobes* lobes) {
  (lobes->d_amplitudes ? lobes_backward : lobes_forward)(*lobes);
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
