// cuda_training.cuh: what a training does before a rendering and after it: its usual law of scattering (lobe_math.h), L1 of
// amplitudes without SSIM (loss.h), and a step of Adam (adam_math.h). One thread a Gaussian, a pixel or a number.
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

// The sum of a number of every thread, the same in all runs; thread 0 has it.
SG_FN float block_sum(float x) {
  __shared__ float of_warps[kWarps];
  x = warp_sum(x);
  if (lane() == 0) of_warps[warp()] = x;
  __syncthreads();
  float total = 0.0f;
  for (int k = 0; k < kWarps; k++) total += of_warps[k];
  return total;
}

SG_FN int64_t pixels_of(const sg_loss& l) { return (int64_t)l.views * l.rows * l.columns; }

// The gradient, and every block's sum of |a - t|.
extern "C" __global__ void __launch_bounds__(kThreads) amplitude_loss(sg_loss l, float* sums) {
  const int64_t i = this_number();
  float difference = 0.0f;
  if (i < pixels_of(l)) {
    const float scale = 1.0f / (l.reference * l.reference), share = 1.0f / (float)pixels_of(l);
    const float a = root(l.power[i] * scale + l.floor * l.floor) - l.floor, t = root(l.truth[i] * scale);
    const float slope = choose(a > t, share, choose(a < t, -share, 0.0f));
    l.d_power[i] = slope * (0.5f * scale) / (a + l.floor);
    difference = absolute(a - t);
  }
  const float sum = block_sum(difference);
  if (thread() == 0) sums[blockIdx.x] = sum;
}

// One block: the mean, from the sums.
extern "C" __global__ void __launch_bounds__(kThreads) sum_loss(sg_loss l, const float* sums, int64_t blocks) {
  float mine = 0.0f;
  for (int64_t k = thread(); k < blocks; k += kThreads) mine += sums[k];
  const float total = block_sum(mine);
  if (thread() == 0) *l.loss = total / (float)pixels_of(l);
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
