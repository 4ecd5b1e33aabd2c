// cuda_training.cuh: what a training does before a rendering, its usual law of scattering (lobe_math.h), and at its end, a step of
// Adam (adam_math.h). One thread a Gaussian or a number.
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

// What changes from step to step comes with the arguments of this launch, so that those of all others can stay as they are.
constexpr int kMostWords = 992;  // of 4 bytes: arguments are 4 KB at the most
struct Words { int32_t of[kMostWords]; };
extern "C" __global__ void __launch_bounds__(kThreads) tell(Words words, int32_t count, int32_t* to) {
  for (int k = thread(); k < count; k += kThreads) to[k] = words.of[k];
}

// Parameters of a training, a block for kThreads numbers of one of them.
constexpr int kMostGroups = 15;  // of a launch: arguments are 4 KB at the most
struct AdamGroups { sg_adam_group of[kMostGroups]; };

extern "C" __global__ void __launch_bounds__(kThreads) step_adam(AdamGroups groups, sg_adam_step step, int32_t first, int32_t count) {
  int n = 0;
  int64_t i = this_number();
  for (; n < count; n++) {
    const int64_t whole = (groups.of[n].rows * groups.of[n].columns + kThreads - 1) / kThreads * kThreads;
    if (i < whole) break;
    i -= whole;
  }
  const sg_adam_group& g = groups.of[n];
  if (i >= g.rows * g.columns) return;
  const AdamShares shares = shares_of(step, g, first + n);
  const int column = (int)(i % g.columns);
  g.value[i] = stepped(g.value[i], g.gradient[i], g.mean[i], g.square[i], rate_of(shares, g, column), g.low[column], g.high[column],
                       g.logarithmic, shares);
}

}  // namespace SG_ISA
}  // namespace sarsplat
