// loss_math.h: what L1 and SSIM of amplitudes are in one pixel and in one window. F is as for pair_math.h.
#pragma once
#include "api.h"
#include "pair_math.h"

namespace sarsplat {
namespace SG_ISA {

constexpr int kTaps = 11, kReach = kTaps - 1;  // of the window of SSIM

// Of linear power: the rendered amplitude, softened, and the true one; 1 is the reference.
template <class F> SG_FN F rendered_amplitude(F power, const sg_loss& l) {
  return root(power * (1.0f / (l.reference * l.reference)) + l.floor * l.floor) - l.floor;
}
template <class F> SG_FN F true_amplitude(F power, const sg_loss& l) { return root(power * (1.0f / (l.reference * l.reference))); }

// The slope of |a - t|, and from dL/da to dL/d(power).
template <class F> SG_FN F absolute_slope(F a, F t, float share) { return choose(a > t, splat(share), choose(a < t, splat(-share), splat(0.0f))); }
template <class F> SG_FN F power_slope(F slope, F a, const sg_loss& l) {
  return slope * (0.5f * (1.0f / (l.reference * l.reference))) / (a + l.floor);
}

// SSIM from the window's means of a, t, a^2, t^2 and a t; slopes: its derivatives by the means of a, a^2 and a t.
template <class F> struct Similarity { F value, slopes[3]; };
template <class F> SG_FN Similarity<F> similarity(const F (&mean)[5], float c1, float c2) {
  const F ma = mean[0], mb = mean[1], aa = mean[2] - ma * ma, bb = mean[3] - mb * mb, ab = mean[4] - ma * mb;
  const F a1 = ma * mb * 2.0f + c1, a2 = ab * 2.0f + c2, b1 = ma * ma + mb * mb + c1, b2 = aa + bb + c2;
  const F inverse = 1.0f / (b1 * b2), S = a1 * a2 * inverse;
  return {S, {(mb * (a2 - a1) * inverse - ma * S * (1.0f / b1 - 1.0f / b2)) * 2.0f, -S / b2, a1 * inverse * 2.0f}};
}
// dSSIM/da of a pixel from the slopes of the windows that contain it, summed with their weights.
template <class F> SG_FN F similarity_slope(const F (&slopes)[3], F a, F t) { return slopes[0] + a * slopes[1] * 2.0f + t * slopes[2]; }

// Shares of a pixel and of a window in the means of L1 and of SSIM, with their weights.
SG_FN float absolute_share(const sg_loss& l) { return (1.0f - l.ssim_weight) / ((float)l.views * l.rows * l.columns); }
SG_FN float similarity_share(const sg_loss& l) {
  return -l.ssim_weight / ((float)l.views * (l.rows - kReach) * (l.columns - kReach));
}

}  // namespace SG_ISA
}  // namespace sarsplat
