// cuda_rays.cuh: the step `attenuate`. A block is a tile of rays; what a ray carries (T, the last Gaussian, the suffix sum) lives in
// registers, and what the block's warps add up per Gaussian is summed in the order of the warps into the slot.
#pragma once
#include "cuda_state.cuh"

namespace sarsplat {
namespace SG_ISA {

extern "C" __global__ void __launch_bounds__(kThreads, kResident) attenuate_tiles(sg_problem p, State s) {
  __shared__ Splat splats[kBatch];
  __shared__ int64_t slots[kBatch];
  __shared__ float sums[kBatch][kWarps];
  const auto [lattice, ray, first, count] = tile(s.rays, p.views, blockIdx.x);
  const float faintest = min_log_tau(p);
  float T = ray.inside ? 1.0f : 0.0f;
  int last = -1;
  for (int begin = 0; begin < count; begin += kBatch) {
    if (!__syncthreads_or(T >= p.min_transmittance)) break;
    const int size = count - begin < kBatch ? count - begin : kBatch;
    if (thread() < size) {
      const int64_t slot = slots[thread()] = s.rays.order[first + begin + thread()];
      Splat splat = s.rays.splats[s.rays.owners[slot]];
      splat.g = placed(splat.g, lattice);
      splats[thread()] = splat;
    }
    __syncthreads();
    for (int k = 0; k < size; k++) {
      const Footprint& g = splats[k].g;
      const Offset<float> d = offset(g, (float)ray.x, (float)ray.y);
      const float log_tau = log_depth(g, d);
      const bool live = log_tau >= faintest && T >= p.min_transmittance;
      float w = 0.0f;
      if (__any_sync(kWholeWarp, live)) {
        w = warp_sum(attenuate(log_tau, live, T));
        if (live) last = begin + k;
      }
      if (lane() == 0) sums[k][warp()] = w;
    }
    __syncthreads();
    if (thread() < size) {
      float w = 0.0f;
      for (int k = 0; k < kWarps; k++) w += sums[thread()][k];
      s.slot_weights[slots[thread()]] = w;
    }
  }
  if (!ray.inside) return;
  s.transmittance[ray.index] = T;
  s.last[ray.index] = last;
}

// From the sums of w to lit areas; in a whole rendering (a.count > 0) also to cross-sections, a being per lit area.
extern "C" __global__ void __launch_bounds__(kThreads) light_gaussians(sg_problem p, State s, sg_channels a, sg_outputs out) {
  const auto [view, i, j] = this_pair(p);
  if (j < 0) return;
  float w = 0.0f;
  for (int64_t slot = s.rays.ends[j] - s.rays.counts[j]; slot < s.rays.ends[j]; slot++) w += s.slot_weights[slot];
  const float lit = out.lit_area[j] = w * (p.ray[0] * p.ray[1]);
  if (a.count) s.lit_area[j] = lit;
  for (int64_t k = j * a.count; k < (j + 1) * a.count; k++) out.cross_sections[k] = a.cross_sections[k] * lit;
}

// The adjoint, to dL/dw and dL/da. Either d_lit_area, or null, is given, or dL/dsigma through the images and, or null, on its own.
extern "C" __global__ void __launch_bounds__(kThreads)
light_gaussians_backward(sg_problem p, State s, sg_channels a, const float* d_lit_area, const float* through_images,
                         const float* d_cross_sections, float* d_amplitudes) {
  const auto [view, i, j] = this_pair(p);
  if (j < 0) return;
  float d_lit = d_lit_area ? d_lit_area[j] : 0.0f;
  for (int64_t k = j * a.count; k < (j + 1) * a.count; k++) {
    const float d_sigma = through_images[k] + (d_cross_sections ? d_cross_sections[k] : 0.0f);
    d_lit += d_sigma * a.cross_sections[k];
    if (d_amplitudes) d_amplitudes[k] = d_sigma * s.lit_area[j];
  }
  s.h[j] = d_lit * (p.ray[0] * p.ray[1]);
}

// Back to front. `from`: dL/dT_end, or null.
extern "C" __global__ void __launch_bounds__(kThreads) attenuate_tiles_backward(sg_problem p, State s, const float* from) {
  __shared__ Splat splats[kBatch];
  __shared__ float h[kBatch];
  __shared__ int64_t slots[kBatch];
  __shared__ float sums[kBatch][kWarps][6];
  const auto [lattice, ray, first, count] = tile(s.rays, p.views, blockIdx.x);
  const float faintest = min_log_tau(p);
  float T = ray.inside ? s.transmittance[ray.index] : 0.0f;
  float B = ray.inside && from ? T * from[ray.index] : 0.0f;
  const int last = ray.inside ? s.last[ray.index] : -1;
  for (int begin = (count - 1) / kBatch * kBatch; begin >= 0; begin -= kBatch) {
    if (!__syncthreads_or(last >= begin)) continue;
    const int size = count - begin < kBatch ? count - begin : kBatch;
    if (thread() < size) {
      const int64_t slot = slots[thread()] = s.rays.order[first + begin + thread()];
      const int32_t j = s.rays.owners[slot];
      Splat splat = s.rays.splats[j];
      splat.g = placed(splat.g, lattice);
      splats[thread()] = splat;
      h[thread()] = s.h[j];
    }
    __syncthreads();
    const int sixth = sixth_of(lane());
    for (int k = size - 1; k >= 0; k--) {
      const Footprint& g = splats[k].g;
      const Offset<float> d = offset(g, (float)ray.x, (float)ray.y);
      const float log_tau = log_depth(g, d);
      const bool live = log_tau >= faintest && last >= begin + k;
      float sum = 0.0f;
      if (__any_sync(kWholeWarp, live)) {
        Moments<float> m{};
        m.add(d, attenuate_backward(log_tau, live, h[k], T, B));
        sum = sum6(m.m0, m.mu, m.mv, m.muu, m.muv, m.mvv, lane());
      }
      if (sixth >= 0) sums[k][warp()][sixth] = sum;
    }
    __syncthreads();
    for (int i = thread(); i < 6 * size; i += kThreads) {
      float sum = 0.0f;
      for (int k = 0; k < kWarps; k++) sum += sums[i / 6][k][i % 6];
      s.slot_moments[6 * slots[i / 6] + i % 6] = sum;
    }
  }
}

// T_end and, unless null, the range at which the two-way optical depth reaches `depth`, ray by ray, of the view that begins
// at first_tile; NaN where it never does
extern "C" __global__ void __launch_bounds__(kThreads)
trace_tiles(sg_problem p, State s, int32_t first_tile, float depth, float* transmittance, float* first_return) {
  const auto [lattice, ray, first, count] = tile(s.rays, p.views, first_tile + blockIdx.x);
  if (!ray.inside) return;
  const int64_t at = ray.index - lattice.first_point;
  transmittance[at] = s.transmittance[ray.index];
  if (!first_return) return;
  const float stop = -logf(p.min_transmittance);
  float sum_tau = 0.0f, found = __int_as_float(0x7fc00000);
  for (int64_t k = first; k < first + count && sum_tau <= stop; k++) {
    const int32_t j = s.rays.owners[s.rays.order[k]];
    const Splat& splat = s.rays.splats[j];
    const Footprint g = placed(splat.g, lattice);
    const float log_tau = log_depth(g, offset(g, (float)ray.x, (float)ray.y));
    if (!(log_tau >= min_log_tau(p))) continue;
    const float before = sum_tau;
    sum_tau += kLn2 * power2(log_tau);
    if (before < depth && sum_tau >= depth)
      found = splat.extra + s.slope[2 * j] * ((float)ray.x - g.x) + s.slope[2 * j + 1] * ((float)ray.y - g.y);
  }
  first_return[at] = found;
}

}  // namespace SG_ISA
}  // namespace sarsplat
