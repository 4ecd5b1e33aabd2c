// cuda_pixels.cuh: the step `splat`, K channels in one pass over the pixels. Forward a block is a chunk of a
// tile's list on the tile's pixels, and a tile's chunks are summed in order; backward a warp is a Gaussian that reads its pixels.
#pragma once
#include "cuda_state.cuh"

namespace sarsplat {
namespace SG_ISA {

constexpr int kTogether = 4;  // the most channels in one pass; a single one has kernels of its own

// What channels are multiplied by: the lit area where they are given per area.
SG_FN float area(const State& s, int64_t j) { return s.lit_area ? s.lit_area[j] : 1.0f; }

// What a Gaussian shows at a pixel lies so much higher than what it shows at its centre, m.
struct Slopes { float x, y; };
SG_FN Slopes slopes_of(const sg_problem& p, const sg_channels& a, int64_t j) {
  return {a.slopes[2 * j] * p.pixel[0], a.slopes[2 * j + 1] * p.pixel[1]};
}
SG_FN float elevation(const Footprint& g, const Slopes& slopes, float x, float y) { return slopes.x * (x - g.x) + slopes.y * (y - g.y); }
SG_FN const float* turns_of(const sg_channels& a, int64_t view, int first_channel) { return a.wavenumbers + (view * a.count + first_channel) / 2; }

// What a chunk adds to each pixel of its tile, K numbers a thread.
template <int K, bool kWaves>
SG_FN void splat_chunk(const sg_problem& p, const State& s, const sg_channels& a, int first_channel, Staged* staged, float (*heights)[K], Slopes* slopes) {
  const Chunk c = chunk(s.pixels, p.views, blockIdx.x);
  if (c.size == 0) return;
  const Point& pixel = c.of.point;
  const Corner corner = corner_of_warp(pixel);
  const int channels = a.count - first_channel < K ? a.count - first_channel : K;
  const float cut = image_cut(p);
  const int64_t view = c.of.lattice.first_point / ((int64_t)p.rows * p.columns);
  if (thread() < c.size) {
    const int32_t j = stage(s.pixels, c, staged + thread());
    const float norm = staged[thread()].g.height * area(s, j), *amplitudes = a.cross_sections + (int64_t)j * a.count + first_channel;
    if (norm == 0.0f) staged[thread()].reach[0] = -kNever;  // unlit: near to nothing
    if constexpr (kWaves) slopes[thread()] = slopes_of(p, a, j);
    for (int k = 0; k < K; k++) heights[thread()][k] = k < channels ? amplitudes[k] * norm : 0.0f;
  }
  __syncthreads();
  float S[K] = {};
  for (int begin = 0; begin < c.size; begin += kWarp)
    for (unsigned those = near_warp(staged, begin, c.size, corner); those; those &= those - 1) {
      const int i = begin + __ffs(those) - 1;
      const Footprint& g = staged[i].g;
      const float weight = imaging_weight(distance(offset(g, (float)pixel.x, (float)pixel.y)), cut);
      if constexpr (kWaves) {
        const float height = elevation(g, slopes[i], (float)pixel.x, (float)pixel.y), *turns = turns_of(a, view, first_channel);
        for (int k = 0; k < K; k += 2) {
          if (k >= channels) break;
          const Phase<float> turned = phase(height * turns[k / 2]);
          S[k] += weight * (turned.c * heights[i][k] - turned.s * heights[i][k + 1]);
          S[k + 1] += weight * (turned.s * heights[i][k] + turned.c * heights[i][k + 1]);
        }
      } else {
        for (int k = 0; k < K; k++) S[k] += weight * heights[i][k];
      }
    }
  for (int k = 0; k < K; k++) s.pixels.sums[sum_of((int64_t)blockIdx.x * K + k)] = S[k];
}

// A block is a tile: what its chunks add to the images, K channels of a chunk together.
extern "C" __global__ void __launch_bounds__(kThreads) sum_chunks(sg_problem p, State s, sg_channels a, int32_t first_channel, int32_t K, float* images) {
  const auto [lattice, pixel, first, count] = tile(s.pixels, p.views, blockIdx.x);
  if (!pixel.inside) return;
  const int64_t size = (int64_t)p.rows * p.columns, image = lattice.first_point / size * a.count, base = first_chunk(s.pixels, blockIdx.x);
  for (int k = 0; k < K && first_channel + k < a.count; k++) {
    float S = 0.0f;
    for (int64_t n = base; (n - base) * kChunk < count; n++) S += s.pixels.sums[sum_of(n * K + k)];
    images[(image + first_channel + k) * size + (pixel.index - lattice.first_point)] = S;
  }
}

// From dL/dS to dL/dsigma and the moments of every Gaussian: those of the first channels are written, of others added.
// With waves, also to the sums of dL/d(elevation), alone and times the displacement from the centre.
template <int K, bool kWaves>
SG_FN void gather_pixels(const sg_problem& p, const State& s, const sg_channels& a, int first_channel, const float* d_images,
                         float* d_cross_sections, float* d_elevation) {
  const int64_t j = (int64_t)blockIdx.x * kWarps + warp(), n = p.gaussians;
  if (j >= n * p.views) return;
  const Lattice lattice = s.pixels.lattices[j / n];
  const Footprint g = placed(s.pixels.splats[j].g, lattice);
  const Box box = points(g, s.pixels.reach + 2 * j, lattice);
  const int channels = a.count - first_channel < K ? a.count - first_channel : K;
  const float cut = image_cut(p), lit = area(s, j);
  const int64_t size = (int64_t)p.rows * p.columns;
  const float* dS = d_images + (j / n * a.count + first_channel) * size;
  const float* amplitudes = a.cross_sections + j * a.count + first_channel;
  Moments<float> m{};
  float sums[K] = {}, turning[3] = {};
  if (lit != 0.0f && !empty(box)) {  // an unlit Gaussian has no gradient
    const int width = box.x.last - box.x.first + 1, across = kWarp % width, down = kWarp / width;
    for (int x = box.x.first + lane() % width, y = box.y.first + lane() / width; y <= box.y.last; x += across, y += down) {
      if (x > box.x.last && (x -= width, ++y) > box.y.last) break;
      const Offset<float> d = offset(g, (float)x, (float)y);
      const float weight = imaging_weight(distance(d), cut), *seen = dS + (int64_t)y * lattice.columns + x;
      float along = 0.0f;
      if constexpr (kWaves) {
        const Slopes slopes = slopes_of(p, a, j);
        const float height = elevation(g, slopes, (float)x, (float)y), *turns = turns_of(a, j / n, first_channel);
        float turn = 0.0f;
        for (int c = 0; c < K; c += 2) {
          if (c >= channels) break;
          const Phase<float> turned = phase(height * turns[c / 2]);
          const float re = seen[c * size], im = seen[(c + 1) * size];
          const float real = turned.c * re + turned.s * im, imaginary = turned.c * im - turned.s * re;
          sums[c] += weight * real;
          sums[c + 1] += weight * imaginary;
          along += real * amplitudes[c] + imaginary * amplitudes[c + 1];
          turn += (imaginary * amplitudes[c] - real * amplitudes[c + 1]) * (6.2831853f * turns[c / 2]);
        }
        turn *= weight;
        turning[0] += turn;
        turning[1] += turn * ((float)x - g.x);
        turning[2] += turn * ((float)y - g.y);
      } else {
        for (int c = 0; c < K; c++)
          if (c < channels) {
            sums[c] += weight * seen[c * size];
            along += seen[c * size] * amplitudes[c];
          }
      }
      m.add(d, weight * (K == 1 ? *seen : along));
    }
  }
  // of a single channel, the sum is the lowest moment; its amplitude is multiplied in at the end
  const float sum = sum6(m.m0, m.mu, m.mv, m.muu, m.muv, m.mvv, lane());
  const float moment = sum * g.height * lit * (K == 1 ? amplitudes[0] : 1.0f);
  const int sixth = sixth_of(lane());
  if (sixth >= 0) s.pixel_moments[6 * j + sixth] = first_channel ? s.pixel_moments[6 * j + sixth] + moment : moment;
  if constexpr (kWaves) {
    const float unit[3] = {1.0f, p.pixel[0], p.pixel[1]};
    for (int k = 0; k < 3; k++) {
      const float total = warp_sum(turning[k]) * g.height * lit * unit[k];
      if (lane() == 0) d_elevation[3 * j + k] = first_channel ? d_elevation[3 * j + k] + total : total;
    }
  }
  for (int c = 0; c < K; c++) {
    const float total = K == 1 ? sum : warp_sum(sums[c]);
    if (lane() == 0 && c < channels) d_cross_sections[j * a.count + first_channel + c] = total * g.height;
  }
}

extern "C" __global__ void __launch_bounds__(kThreads) splat_chunks_1(sg_problem p, State s, sg_channels a, int32_t first) {
  __shared__ Staged staged[kChunk];
  __shared__ float heights[kChunk][1];
  splat_chunk<1, false>(p, s, a, first, staged, heights, nullptr);
}
extern "C" __global__ void __launch_bounds__(kThreads) splat_chunks_4(sg_problem p, State s, sg_channels a, int32_t first) {
  __shared__ Staged staged[kChunk];
  __shared__ float heights[kChunk][kTogether];
  splat_chunk<kTogether, false>(p, s, a, first, staged, heights, nullptr);
}
extern "C" __global__ void __launch_bounds__(kThreads) splat_waves_4(sg_problem p, State s, sg_channels a, int32_t first) {
  __shared__ Staged staged[kChunk];
  __shared__ float heights[kChunk][kTogether];
  __shared__ Slopes slopes[kChunk];
  splat_chunk<kTogether, true>(p, s, a, first, staged, heights, slopes);
}
extern "C" __global__ void __launch_bounds__(kThreads, kResident)
splat_chunks_1_backward(sg_problem p, State s, sg_channels a, int32_t first, const float* d_images, float* d_cross_sections, float* d_elevation) {
  gather_pixels<1, false>(p, s, a, first, d_images, d_cross_sections, d_elevation);
}
extern "C" __global__ void __launch_bounds__(kThreads)
splat_chunks_4_backward(sg_problem p, State s, sg_channels a, int32_t first, const float* d_images, float* d_cross_sections, float* d_elevation) {
  gather_pixels<kTogether, false>(p, s, a, first, d_images, d_cross_sections, d_elevation);
}
extern "C" __global__ void __launch_bounds__(kThreads)
splat_waves_4_backward(sg_problem p, State s, sg_channels a, int32_t first, const float* d_images, float* d_cross_sections, float* d_elevation) {
  gather_pixels<kTogether, true>(p, s, a, first, d_images, d_cross_sections, d_elevation);
}

}  // namespace SG_ISA
}  // namespace sarsplat
