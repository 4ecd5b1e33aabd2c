// cuda_training.cuh: what a training does to every Gaussian before a rendering and after it: its usual law of scattering
// (lobe_math.h), and a step of Adam (adam_math.h). One thread a Gaussian, or a number.
#pragma once
#include "adam_math.h"
#include "cuda_state.cuh"
#include "lobe_math.h"

namespace sarsplat {
namespace SG_ISA {

SG_FN int64_t this_number() { return (int64_t)blockIdx.x * kThreads + thread(); }

extern "C" __global__ void __launch_bounds__(kThreads) normal_lobes(sg_lobes l) {
  const int64_t i = this_number();
  if (i >= l.gaussians) return;
  const Facing<float> f = facing_of(l.scales + 3 * i, l.quaternions + 4 * i);
  const Law<float> law = law_of(l.parameters + 3 * i);
  for (int64_t v = 0; v < l.views; v++) l.amplitudes[v * l.gaussians + i] = seen_from(f, law, l.directions + 3 * v, l.p_min);
}

extern "C" __global__ void __launch_bounds__(kThreads) normal_lobes_backward(sg_lobes l) {
  const int64_t i = this_number();
  if (i >= l.gaussians) return;
  const Facing<float> f = facing_of(l.scales + 3 * i, l.quaternions + 4 * i);
  const Law<float> law = law_of(l.parameters + 3 * i);
  LobeGradient<float> sum{};
  for (int64_t v = 0; v < l.views; v++) spread_lobe(f, law, l.directions + 3 * v, l.d_amplitudes[v * l.gaussians + i], sum);
  finish_lobe(f, law, sum, l.d_quaternions + 4 * i);
  for (int k = 0; k < 3; k++) l.d_parameters[3 * i + k] = sum.parameters[k];
}

extern "C" __global__ void __launch_bounds__(kThreads) step_adam(sg_adam_group g, sg_adam_step step) {
  const int64_t i = this_number();
  if (i >= g.rows * g.columns) return;
  const int column = (int)(i % g.columns);
  g.value[i] = stepped(g.value[i], g.gradient[i], g.mean[i], g.square[i], rate_of(step, g, column), g.low[column],
                       g.high[column], g.logarithmic, shares_of(step));
}

}  // namespace SG_ISA
}  // namespace sarsplat
