// cuda_ground.cuh: how much of the ground each pixel sees, and the gradient of that, as in ground.h: lit = 1 - R (1 - T) X^T,
// where R and X are bands. A thread is an entry of a table, and adds up what its band holds in the order of the patches, or
// back, of the pixels; how a table is cut into blocks does not depend on what else is in memory.
#pragma once
#include "cuda_loss.cuh"
#include "cuda_training.cuh"

namespace sarsplat {
namespace SG_ISA {

constexpr double kGroundEnd = 6.0;  // standard deviations of the response: beyond, it is nothing in float32

// Pixels are the rows of an image and then its columns: each sees some rows, or columns, of the patches.
struct GroundState {
  int32_t width;          // patches that a pixel sees at most
  int32_t columns;        // of patches at most
  int32_t *first, *end;   // [V, rows + columns] which ones a pixel sees
  float *weight, *slope;  // [V, rows + columns, width] how much; slope: by the shift, or null
  float* between;         // [V, rows, columns of patches] R (1 - T); or dL/dlit X
  float* shares;          // [2, V, blocks] of the gradient of the shift
};

SG_FN int pixels_of(const sg_ground& g) { return g.rows.count + g.columns.count; }
SG_FN sg_patches patches_of(const sg_ground& g, int view) {
  sg_patches patches = g.patches[g.chosen ? g.chosen[view] : view];
  patches.first += view * g.pitch;
  return patches;
}
SG_FN int place_within(double place, int count) { return place < 0.0 ? 0 : place > count ? count : (int)place; }

// A number of the arrays is a thread: what a pixel sees of one patch.
extern "C" __global__ void __launch_bounds__(kThreads) weigh_ground(sg_ground g, GroundState s) {
  const int64_t pixel = this_number() / s.width;
  if (pixel >= (int64_t)g.views * pixels_of(g)) return;
  const int view = (int)(pixel / pixels_of(g)), i = (int)(pixel % pixels_of(g)), k = (int)(this_number() % s.width);
  const bool is_row = i < g.rows.count;
  const sg_patches patches = patches_of(g, view);
  const double begin = is_row ? patches.rows.first : patches.columns.first, step = is_row ? patches.rows.step : patches.columns.step;
  const int count = is_row ? patches.rows.count : patches.columns.count;
  const double std = is_row ? g.std[1] : g.std[0], shift = g.shift ? (double)g.shift[2 * view + is_row] : 0.0;
  const double centre = is_row ? g.rows.first + i * g.rows.step : g.columns.first + (i - g.rows.count) * g.columns.step;
  const double apart = centre - shift - begin;
  const int first = place_within(floor((apart - kGroundEnd * std) / step), count);
  const int end = place_within(ceil((apart + kGroundEnd * std) / step), count);
  if (k == 0) {
    s.first[pixel] = first;
    s.end[pixel] = end < first + s.width ? end : first + s.width;
  }
  const double root = 1.0 / (std * 1.4142135623730951), height = 1.0 / (std * 2.5066282746310002);
  const double u = (apart - (first + k) * step) * root, next = (apart - (first + k + 1) * step) * root;
  const int64_t at = pixel * s.width + k;
  s.weight[at] = (float)(0.5 * (erf(u) - erf(next)));
  if (s.slope) s.slope[at] = (float)(height * (exp(-next * next) - exp(-u * u)));
}

// This thread's entry of a table of its view, `blocks` of which there is room for. A warp is along a row.
struct Entry { int view, y, x; bool inside; };
SG_FN int warps_across(int columns) { return (columns + kWarp - 1) / kWarp; }
SG_FN int64_t blocks_of(int rows, int columns) { return (int64_t)((rows + kWarps - 1) / kWarps) * warps_across(columns); }
SG_FN Entry this_entry(int view, int blocks, int rows, int columns) {
  const int across = columns ? warps_across(columns) : 1, block = blockIdx.x % blocks;
  Entry e{view, block / across * kWarps + warp(), block % across * kWarp + lane(), false};
  e.inside = e.y < rows && e.x < columns;
  return e;
}

// Part of a table that a pixel sees, whose entries are `apart`.
template <class Hidden> SG_FN float seen_by(const GroundState& s, const float* weights, int64_t pixel, Hidden hidden) {
  const int first = s.first[pixel], end = s.end[pixel];
  const float* weight = weights + pixel * s.width;
  float sum = 0.0f;
  for (int k = first; k < end; k++) sum += weight[k - first] * hidden(k);
  return sum;
}

// The first of so many pixels that sees a patch or one behind it: bands begin and end in the order of the pixels.
SG_FN int first_to_see(const GroundState& s, int64_t pixel, int count, int patch) {
  int low = 0, high = count;
  while (low < high) {
    const int middle = (low + high) / 2;
    if (s.end[pixel + middle] > patch) high = middle;
    else low = middle + 1;
  }
  return low;
}
// What the pixels that see a patch tell it, given what each says: the adjoint of seen_by.
template <class Seed> SG_FN float told_by(const GroundState& s, const float* weights, int64_t pixel, int count, int patch, Seed seed) {
  float sum = 0.0f;
  for (int i = first_to_see(s, pixel, count, patch); i < count && s.first[pixel + i] <= patch; i++)
    sum += weights[(pixel + i) * s.width + patch - s.first[pixel + i]] * seed(i);
  return sum;
}

SG_FN float& between(const sg_ground& g, const GroundState& s, int view, int row, int column) {
  return s.between[((int64_t)view * g.rows.count + row) * s.columns + column];
}
// Of a column of rays, what the pixels of a row do not see.
SG_FN float hidden_in(const sg_ground& g, const GroundState& s, const sg_patches& patches, const Entry& e, const float* weights) {
  const float* ray = g.transmittance + patches.first + e.x;
  return seen_by(s, weights, (int64_t)e.view * pixels_of(g) + e.y, [&](int k) { return 1.0f - ray[(int64_t)k * patches.columns.count]; });
}

extern "C" __global__ void __launch_bounds__(kThreads) see_ground(sg_ground g, GroundState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_patches patches = patches_of(g, view);
  const Entry e = this_entry(view, blocks, g.rows.count, patches.columns.count);
  if (e.inside) between(g, s, view, e.y, e.x) = hidden_in(g, s, patches, e, s.weight);
}

extern "C" __global__ void __launch_bounds__(kThreads) light_ground(sg_ground g, GroundState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const Entry e = this_entry(view, blocks, g.rows.count, g.columns.count);
  if (!e.inside) return;
  const int64_t pixel = (int64_t)view * pixels_of(g) + g.rows.count + e.x;
  const float hidden = seen_by(s, s.weight, pixel, [&](int k) { return between(g, s, view, e.y, k); });
  g.lit[((int64_t)view * g.rows.count + e.y) * g.columns.count + e.x] = 1.0f - hidden;
}

// dL/dlit X, and every block's shares of the gradient of the shift: a pixel's azimuth moves X, its slant range R.
extern "C" __global__ void __launch_bounds__(kThreads) light_ground_backward(sg_ground g, GroundState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_patches patches = patches_of(g, view);
  const Entry e = this_entry(view, blocks, g.rows.count, patches.columns.count);
  float azimuth = 0.0f, range = 0.0f;
  if (e.inside) {
    const int64_t pixel = (int64_t)view * pixels_of(g) + g.rows.count;
    const float* d_lit = g.d_lit + ((int64_t)view * g.rows.count + e.y) * g.columns.count;
    auto seed = [&](int j) { return d_lit[j]; };
    const float told = told_by(s, s.weight, pixel, g.columns.count, e.x, seed);
    between(g, s, view, e.y, e.x) = told;
    if (s.slope) {
      azimuth = told_by(s, s.slope, pixel, g.columns.count, e.x, seed) * hidden_in(g, s, patches, e, s.weight);
      range = told * hidden_in(g, s, patches, e, s.slope);
    }
  }
  if (!s.slope) return;
  azimuth = block_sum(azimuth);
  range = block_sum(range);
  if (thread() > 0) return;
  s.shares[blockIdx.x] = azimuth;
  s.shares[(int64_t)g.views * blocks + blockIdx.x] = range;
}

extern "C" __global__ void __launch_bounds__(kThreads) see_ground_backward(sg_ground g, GroundState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_patches patches = patches_of(g, view);
  const Entry e = this_entry(view, blocks, patches.rows.count, patches.columns.count);
  if (!e.inside) return;
  const int64_t pixel = (int64_t)view * pixels_of(g);
  g.d_transmittance[patches.first + (int64_t)e.y * patches.columns.count + e.x] =
      told_by(s, s.weight, pixel, g.rows.count, e.y, [&](int i) { return between(g, s, view, i, e.x); });
}

// A block each for the azimuths and the slant ranges of the views; `blocks` as in light_ground_backward.
extern "C" __global__ void __launch_bounds__(kThreads) sum_ground_shift(sg_ground g, GroundState s, int32_t blocks) {
  const int axis = blockIdx.x / g.views, view = blockIdx.x % g.views;
  const int64_t own = blocks_of(g.rows.count, patches_of(g, view).columns.count);
  const float total = total_of(s.shares + (int64_t)blockIdx.x * blocks, own);
  if (thread() == 0) g.d_shift[2 * view + axis] = -total;
}

}  // namespace SG_ISA
}  // namespace sarsplat
