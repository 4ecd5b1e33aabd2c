// cuda_loss.cuh: L1 and SSIM of amplitudes, and their gradient (loss_math.h). A block is a tile of windows, and then one of
// pixels; sums over blocks have a fixed order.
#pragma once
#include "cuda_state.cuh"
#include "loss_math.h"

namespace sarsplat {
namespace SG_ISA {

constexpr int kAround = kTile + kReach;  // points a side that a tile of windows looks at, or of windows that a tile of pixels is in

// The sum of a number of every thread, the same in all runs.
SG_FN float block_sum(float x) {
  __shared__ float of_warps[kWarps];
  x = warp_sum(x);
  __syncthreads();  // the warps' numbers of another sum were read
  if (lane() == 0) of_warps[warp()] = x;
  __syncthreads();
  float total = 0.0f;
  for (int k = 0; k < kWarps; k++) total += of_warps[k];
  return total;
}

// Where this thread's pixel or window is among rows x columns of every view, in whole tiles.
struct Place { int view, top, left, y, x; bool inside; };
SG_FN int tiles_along(int points) { return (points + kTile - 1) / kTile; }
SG_FN Place this_place(int rows, int columns) {
  const int across = tiles_along(columns), of_view = across * tiles_along(rows), tile = blockIdx.x % of_view;
  Place p{(int)blockIdx.x / of_view, tile / across * kTile, tile % across * kTile, 0, 0, false};
  p.y = p.top + thread() / kTile;
  p.x = p.left + thread() % kTile;
  p.inside = p.y < rows && p.x < columns;
  return p;
}

// Every window: slopes [3, V, rows, columns], and every block's sum of SSIM.
extern "C" __global__ void __launch_bounds__(kThreads) similarity_slopes(sg_loss l, float* slopes, float* sums) {
  __shared__ float a[kAround][kAround], t[kAround][kAround];
  __shared__ float along[5][kAround][kTile];  // means along the row of a, t, a^2, t^2, a t
  const int rows = l.rows - kReach, columns = l.columns - kReach;
  const Place p = this_place(rows, columns);
  for (int k = thread(); k < kAround * kAround; k += kThreads) {
    const int y = p.top + k / kAround, x = p.left + k % kAround;
    const int64_t i = ((int64_t)p.view * l.rows + y) * l.columns + x;
    const bool inside = y < l.rows && x < l.columns;
    a[k / kAround][k % kAround] = inside ? rendered_amplitude(l.power[i], l) : 0.0f;
    t[k / kAround][k % kAround] = inside ? true_amplitude(l.truth[i], l) : 0.0f;
  }
  __syncthreads();
  for (int k = thread(); k < kAround * kTile; k += kThreads) {
    const int y = k / kTile, x = k % kTile;
    float m[5] = {};
    for (int n = 0; n < kTaps; n++) {
      const float w = l.window[n], one = a[y][x + n], other = t[y][x + n];
      m[0] += w * one; m[1] += w * other; m[2] += w * one * one; m[3] += w * other * other; m[4] += w * one * other;
    }
    for (int q = 0; q < 5; q++) along[q][y][x] = m[q];
  }
  __syncthreads();
  float m[5] = {};
  for (int n = 0; n < kTaps; n++)
    for (int q = 0; q < 5; q++) m[q] += l.window[n] * along[q][thread() / kTile + n][thread() % kTile];
  const Similarity<float> found = similarity(m, l.c1, l.c2);
  const int64_t size = (int64_t)rows * columns, i = p.view * size + (int64_t)p.y * columns + p.x;
  for (int q = 0; q < 3 && p.inside; q++) slopes[q * (l.views * size) + i] = found.slopes[q];
  const float sum = block_sum(p.inside ? found.value : 0.0f);
  if (thread() == 0) sums[blockIdx.x] = sum;
}

// Every pixel: the gradient, and every block's sum of |a - t|. slopes: those of the windows, or null without SSIM.
extern "C" __global__ void __launch_bounds__(kThreads) amplitude_loss(sg_loss l, const float* slopes, float* sums) {
  __shared__ float windows[3][kAround][kAround];
  __shared__ float along[3][kAround][kTile];
  const Place p = this_place(l.rows, l.columns);
  float of_windows[3] = {};
  if (slopes) {
    const int rows = l.rows - kReach, columns = l.columns - kReach;
    for (int k = thread(); k < 3 * kAround * kAround; k += kThreads) {
      const int q = k / (kAround * kAround), row = k / kAround % kAround, column = k % kAround;
      const int y = p.top - kReach + row, x = p.left - kReach + column;
      const bool inside = y >= 0 && y < rows && x >= 0 && x < columns;
      windows[q][row][column] = inside ? slopes[((int64_t)(q * l.views + p.view) * rows + y) * columns + x] : 0.0f;
    }
    __syncthreads();
    for (int k = thread(); k < 3 * kAround * kTile; k += kThreads) {
      const int q = k / (kAround * kTile), y = k / kTile % kAround, x = k % kTile;
      float sum = 0.0f;  // the window is symmetric
      for (int n = 0; n < kTaps; n++) sum += l.window[n] * windows[q][y][x + n];
      along[q][y][x] = sum;
    }
    __syncthreads();
    for (int n = 0; n < kTaps; n++)
      for (int q = 0; q < 3; q++) of_windows[q] += l.window[n] * along[q][thread() / kTile + n][thread() % kTile];
  }
  float difference = 0.0f;
  if (p.inside) {
    const int64_t i = ((int64_t)p.view * l.rows + p.y) * l.columns + p.x;
    const float a = rendered_amplitude(l.power[i], l), t = true_amplitude(l.truth[i], l);
    float slope = absolute_slope(a, t, absolute_share(l));
    if (slopes) slope += similarity_slope(of_windows, a, t) * similarity_share(l);
    l.d_power[i] = power_slope(slope, a, l);
    difference = absolute(a - t);
  }
  const float sum = block_sum(difference);
  if (thread() == 0) sums[blockIdx.x] = sum;
}

SG_FN float total_of(const float* sums, int64_t count) {
  float mine = 0.0f;
  for (int64_t k = thread(); k < count; k += kThreads) mine += sums[k];
  return block_sum(mine);
}

// One block: the loss, from the sums of |a - t| and, unless null, of SSIM.
extern "C" __global__ void __launch_bounds__(kThreads) sum_loss(sg_loss l, const float* absolutes, int64_t tiles, const float* similar, int64_t window_tiles) {
  float loss = total_of(absolutes, tiles) * absolute_share(l);
  if (similar) loss += l.ssim_weight + total_of(similar, window_tiles) * similarity_share(l);
  if (thread() == 0) *l.loss = loss;
}

}  // namespace SG_ISA
}  // namespace sarsplat
