// cuda_rays.cuh: the step `attenuate`. A block is a chunk of a tile's list on the tile's rays. What a ray carries (T, the suffix
// sum) is known where a chunk begins from sums over the other chunks; what a warp adds up per Gaussian is transposed through
// shared memory, and summed in the order of the warps into the slot.
#pragma once
#include "cuda_state.cuh"

namespace sarsplat {
namespace SG_ISA {

typedef float Transposed[kWarp][kWarp + 1];  // a number of each lane for each of kWarp entries

// Optical depth of the chunks before c on this thread's ray, and including it: T is 2 to the power of minus that.
SG_FN float depth_before(const Plane& rays, const Chunk& c, int index) {
  float depth = 0.0f;
  for (int k = 0; k < index; k++) depth += rays.sums[sum_of(c.base + k)];
  return depth;
}
// Transmittance behind a chunk that is not its tile's last: where it is high enough, all of the chunk is live.
SG_FN float behind(const Plane& rays, const Chunk& c) { return power2(-depth_before(rays, c, c.index + 1)); }

// The optical depth on every ray, of all chunks that others are behind.
extern "C" __global__ void __launch_bounds__(kThreads) sum_depths(sg_problem p, State s) {
  __shared__ Staged staged[kChunk];
  const Chunk c = chunk(s.rays, p.views, blockIdx.x);
  if (c.index + 1 >= c.chunks) return;
  const float faintest = min_log_tau(p);
  const Point& ray = c.of.point;
  if (thread() < c.size) stage(s.rays, c, staged + thread());
  __syncthreads();
  float depth = 0.0f;
  for (int begin = 0; begin < c.size; begin += kWarp)
    for (unsigned those = near_warp(staged, begin, c.size, corner_of_warp(ray)); those; those &= those - 1) {
      const Footprint& g = staged[begin + __ffs(those) - 1].g;
      const float log_tau = log_depth(g, offset(g, (float)ray.x, (float)ray.y));
      if (log_tau >= faintest) depth += power2(log_tau);
    }
  s.rays.sums[sum_of(blockIdx.x)] = depth;
}

extern "C" __global__ void __launch_bounds__(kThreads) attenuate_chunks(sg_problem p, State s) {
  __shared__ Staged staged[kChunk];
  __shared__ Transposed weights[kWarps];
  __shared__ float sums[kChunk][kWarps];
  const Chunk c = chunk(s.rays, p.views, blockIdx.x);
  if (c.size == 0 && c.index > 0) return;
  const float faintest = min_log_tau(p);
  const Point& ray = c.of.point;
  if (thread() < c.size) stage(s.rays, c, staged + thread());
  const float start = ray.inside ? power2(-depth_before(s.rays, c, c.index)) : 0.0f;
  const bool passed = ray.inside && c.index + 1 < c.chunks && behind(s.rays, c) >= p.min_transmittance;
  float T = start;
  int last = c.begin - 1;  // a chunk before this one was passed to its end
  __syncthreads();
  Transposed& own = weights[warp()];
  for (int begin = 0; begin < c.size; begin += kWarp) {
    const unsigned all = near_warp(staged, begin, c.size, corner_of_warp(ray));
    for (unsigned those = all; those; those &= those - 1) {
      const int k = __ffs(those) - 1;
      const Footprint& g = staged[begin + k].g;
      const float log_tau = log_depth(g, offset(g, (float)ray.x, (float)ray.y));
      const bool live = log_tau >= faintest && (passed || T >= p.min_transmittance);
      own[k][lane()] = attenuate(optical_depth(log_tau, live), T);
      if (live) last = c.begin + begin + k;
    }
    __syncwarp();
    float w = 0.0f;
    if (all >> lane() & 1)
      for (int k = 0; k < kWarp; k++) w += own[lane()][k];
    if (begin + lane() < c.size) sums[begin + lane()][warp()] = w;
    __syncwarp();
  }
  __syncthreads();
  if (thread() < c.size) {
    float w = 0.0f;
    for (int k = 0; k < kWarps; k++) w += sums[thread()][k];
    s.slot_weights[s.rays.order[c.of.first + c.begin + thread()]] = w;
  }
  if (passed || !(start >= p.min_transmittance)) return;  // another chunk is the ray's last
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

// The adjoint, to dL/dw and dL/da, of d_lit_area, or null, and in a whole rendering of dL/dsigma through the images and, or null,
// on its own.
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

// Sum of h w on every ray, of all chunks that others are in front of.
extern "C" __global__ void __launch_bounds__(kThreads) sum_returns(sg_problem p, State s) {
  __shared__ Staged staged[kChunk];
  __shared__ float h[kChunk];
  const Chunk c = chunk(s.rays, p.views, blockIdx.x);
  if (c.size == 0 || c.index == 0) return;
  const float faintest = min_log_tau(p);
  const Point& ray = c.of.point;
  if (thread() < c.size) h[thread()] = s.h[stage(s.rays, c, staged + thread())];
  float T = ray.inside ? power2(-depth_before(s.rays, c, c.index)) : 0.0f, sum = 0.0f;
  const int last = ray.inside ? s.last[ray.index] : -1;
  __syncthreads();
  for (int begin = 0; begin < c.size; begin += kWarp)
    for (unsigned those = near_warp(staged, begin, c.size, corner_of_warp(ray)); those; those &= those - 1) {
      const int k = begin + __ffs(those) - 1;
      const Footprint& g = staged[k].g;
      const float log_tau = log_depth(g, offset(g, (float)ray.x, (float)ray.y));
      sum += h[k] * attenuate(optical_depth(log_tau, log_tau >= faintest && last >= c.begin + k), T);
    }
  s.rays.returns[sum_of(blockIdx.x)] = sum;
}

// Back to front. `from`: dL/dT_end, or null.
extern "C" __global__ void __launch_bounds__(kThreads, kResident - 1) attenuate_chunks_backward(sg_problem p, State s, const float* from) {
  __shared__ Staged staged[kChunk];
  __shared__ float h[kChunk];
  __shared__ Transposed slopes[kWarps];
  __shared__ float sums[kWarp][kWarps][6];
  const Chunk c = chunk(s.rays, p.views, blockIdx.x);
  if (c.size == 0) return;
  const float faintest = min_log_tau(p);
  const Point& ray = c.of.point;
  const Corner corner = corner_of_warp(ray);
  if (thread() < c.size) h[thread()] = s.h[stage(s.rays, c, staged + thread())];
  const int last = ray.inside ? s.last[ray.index] : -1;
  float T = 0.0f, B = 0.0f;
  if (ray.inside) {
    const float end = s.transmittance[ray.index];
    T = last >= c.begin + c.size ? behind(s.rays, c) : end;
    for (int k = c.index + 1; k < c.chunks; k++) B += s.rays.returns[sum_of(c.base + k)];
    if (from) B += end * from[ray.index];
  }
  __syncthreads();
  Transposed& own = slopes[warp()];
  for (int begin = (c.size - 1) / kWarp * kWarp; begin >= 0; begin -= kWarp) {
    const unsigned all = near_warp(staged, begin, c.size, corner);
    for (unsigned those = all; those;) {
      const int k = 31 - __clz(those);
      those ^= 1u << k;
      const Footprint& g = staged[begin + k].g;
      const float log_tau = log_depth(g, offset(g, (float)ray.x, (float)ray.y));
      own[k][lane()] = attenuate_backward(optical_depth(log_tau, log_tau >= faintest && last >= c.begin + begin + k), h[begin + k], T, B);
    }
    __syncwarp();
    Moments<float> m{};
    if (all >> lane() & 1)
      for (int k = 0; k < kWarp; k++) {
        const Footprint& g = staged[begin + lane()].g;
        m.add(offset(g, corner.x + (float)(k % 8), corner.y + (float)(k / 8)), own[lane()][k]);
      }
    const float of_warp[6] = {m.m0, m.mu, m.mv, m.muu, m.muv, m.mvv};
    copy(of_warp, 6, sums[lane()][warp()]);
    __syncthreads();
    const int size = c.size - begin < kWarp ? c.size - begin : kWarp;
    if (thread() < 6 * size) {
      float sum = 0.0f;
      for (int k = 0; k < kWarps; k++) sum += sums[thread() / 6][k][thread() % 6];
      s.slot_moments[6 * s.rays.order[c.of.first + c.begin + begin + thread() / 6] + thread() % 6] = sum;
    }
    __syncthreads();
  }
}

// T_end and, unless null, the range at which the two-way optical depth reaches `depth`, ray by ray of all views; NaN where it
// never does
extern "C" __global__ void __launch_bounds__(kThreads) trace_tiles(sg_problem p, State s, float depth, float* transmittance, float* first_return) {
  const auto [lattice, ray, first, count] = tile(s.rays, p.views, blockIdx.x);
  if (!ray.inside) return;
  transmittance[ray.index] = s.transmittance[ray.index];
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
  first_return[ray.index] = found;
}

}  // namespace SG_ISA
}  // namespace sarsplat
