// adam_math.h: one step of Adam of one number of a parameter, and back into its bounds.
#pragma once
#include "api.h"
#include "pair_math.h"

namespace sarsplat {
namespace SG_ISA {

// NaN stays NaN: the next forward pass says so
template <class F> SG_FN F clamp(F x, F low, F high) { return choose(x < low, low, choose(x > high, high, x)); }

// What is the same for all numbers of a group.
struct AdamShares { float mean, square, old_square, spread, epsilon, decay, unbiased; };
SG_FN AdamShares shares_of(const sg_adam_step& a, const sg_adam_group& g, int group) {
  const float decay = a.now ? a.now[group] : g.decay;
  const float power1 = a.now ? a.now[a.count] : a.beta1_power, power2 = a.now ? a.now[a.count + 1] : a.beta2_power;
  return {1.0f - a.beta1, 1.0f - a.beta2, a.beta2, 1.0f / root(1.0f - power2), a.epsilon, decay, 1.0f / (1.0f - power1)};
}
SG_FN float rate_of(const AdamShares& a, const sg_adam_group& g, int column) { return g.rate[column] * a.decay * a.unbiased; }

template <class F>
SG_FN F stepped(F value, F gradient, F& mean, F& square, F rate, F low, F high, bool logarithmic, const AdamShares& a) {
  if (logarithmic) gradient *= value;
  mean += (gradient - mean) * a.mean;
  square = square * a.old_square + gradient * gradient * a.square;
  const F down = mean / (root(square) * a.spread + a.epsilon) * rate;
  const F moved = logarithmic ? value * power2(clamp(down * -kLog2e, splat(-99.0f), splat(99.0f))) : value - down;
  return clamp(moved, low, high);
}

}  // namespace SG_ISA
}  // namespace sarsplat
