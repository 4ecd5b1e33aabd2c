// cuda_terrain.cuh: what terrain returns where rays end on it, and the gradient of that, as in terrain.h: lit = R(gamma0 T) X^T.
// X is the band of cuda_ground.cuh. Of R nothing is written down: a pixel looks for the cells of its column that it may see,
// and a cell for its pixels. Places are added to as whole numbers, so that the order does not matter.
#pragma once
#include "cuda_ground.cuh"

namespace sarsplat {
namespace SG_ISA {

constexpr float kShortCell = 0.25f;      // standard deviations: over less, differences of integrals have too few digits
constexpr float kPointsApart = 0.28867513f;  // 1/2 -+ 1/sqrt 12: two points whose mean is the integral's

constexpr int kInfinite = 0x7f800000, kNoNumber = 0x7fc00000;  // bits

struct TerrainState {
  int64_t cells;          // of a view at most
  int32_t columns;        // of cells at most
  float *reached, *ahead;  // [V, cells] the farthest slant range of a cell and all lower ones, the nearest of it and all higher ones
  float* returned;        // [V, cells] gamma0 T, and the height of a cell
  float* told;            // [V, cells] dL/d returned
  float* seen;            // [V, rows, columns of cells] R(gamma0 T)
  float* between;         // [V, rows, columns of cells] dL/dlit X
  float *azimuth, *range;  // [V, blocks] of the gradient of the shift
  unsigned* largest;      // [V] bits of the largest |dL/d returned|, infinite if any is no number
  int64_t* sums;          // [V, places]
};

SG_FN sg_terrain_patches cells_of(const sg_terrain& t, int view) {
  sg_terrain_patches patches = t.patches[t.chosen ? t.chosen[view] : view];
  patches.first += view * t.pitch;
  return patches;
}
SG_FN int places_of(const sg_terrain& t) { return t.places[0] * t.places[1]; }

// The response of a pixel, over a cell; and how that changes with the shift.
struct Response { float at, std, reach; };
SG_FN Response response_of(const sg_terrain& t, int view, int row) {
  const double shift = t.shift ? (double)t.shift[2 * view + 1] : 0.0;
  return {(float)(t.rows.first + row * t.rows.step - shift), (float)t.std[1], (float)(kGroundEnd * t.std[1])};
}
SG_FN bool sees(const Response& r, float low, float high) { return fmaxf(low, high) >= r.at - r.reach && fminf(low, high) <= r.at + r.reach; }
SG_FN float over_cell(const Response& r, float low, float high) {
  const float length = high - low;
  if (fabsf(length) < kShortCell * r.std) {
    float sum = 0.0f;
    for (int k = 0; k < 2; k++) {
      const float x = (r.at - (low + (k ? 0.5f + kPointsApart : 0.5f - kPointsApart) * length)) / r.std;
      sum += expf(-0.5f * x * x);
    }
    return sum / (2.0f * 2.50662827f * r.std);
  }
  const float root = 0.70710678f / r.std;
  return (erff((r.at - low) * root) - erff((r.at - high) * root)) / (2.0f * length);
}
SG_FN float slope_over_cell(const Response& r, float low, float high) {
  const float length = high - low;
  if (fabsf(length) < kShortCell * r.std) {
    float sum = 0.0f;
    for (int k = 0; k < 2; k++) {
      const float x = (r.at - (low + (k ? 0.5f + kPointsApart : 0.5f - kPointsApart) * length)) / r.std;
      sum += x * expf(-0.5f * x * x);
    }
    return sum / (2.0f * 2.50662827f * r.std * r.std);
  }
  const float x = (r.at - low) / r.std, y = (r.at - high) / r.std;
  return (expf(-0.5f * y * y) - expf(-0.5f * x * x)) / (2.50662827f * r.std * length);
}

// The places whose mean a cell's gamma0 is.
struct CellPlaces { int at[4]; float share[4]; };
SG_FN float clamped_place(float x, int count) { return fminf(fmaxf(x, 0.0f), (float)(count - 1)); }
SG_FN CellPlaces places_of_cell(const sg_terrain& t, const sg_terrain_patches& p, int row, int column) {
  const int64_t cell = (int64_t)row * p.across.count + column;
  const float range = 0.5f * (p.low[cell] + p.high[cell]);
  const int nx = t.places[1], ny = t.places[0];
  const float x = clamped_place(p.x[0] + p.x[1] * column + p.x[2] * row + p.x[3] * range, nx);
  const float y = clamped_place(p.y[0] + p.y[1] * column + p.y[2] * row + p.y[3] * range, ny);
  const int i = nx > 1 && (int)x > nx - 2 ? nx - 2 : (int)x, j = ny > 1 && (int)y > ny - 2 ? ny - 2 : (int)y;
  const int right = nx > 1, down = ny > 1 ? nx : 0, at = j * nx + i;
  const float u = x - i, v = y - j;
  return {{at, at + right, at + down, at + down + right}, {(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v}};
}
SG_FN float gamma0_of_cell(const sg_terrain& t, int view, const CellPlaces& c) {
  const float* table = t.gamma0 + (int64_t)view * places_of(t);
  float sum = 0.0f;
  for (int k = 0; k < 4; k++) sum += c.share[k] * table[c.at[k]];
  return sum;
}
// T_end of a cell's ray: 1 where none was traced
SG_FN float left_of_cell(const sg_terrain& t, const sg_terrain_patches& p, int row, int column) {
  const int y = row - p.traced_first[0], x = column - p.traced_first[1];
  const bool traced = y >= 0 && y < p.traced[0] && x >= 0 && x < p.traced[1];
  return traced ? t.transmittance[p.first + (int64_t)y * p.traced[1] + x] : 1.0f;
}

// A block for kWarp columns, of which every warp has some rows.
extern "C" __global__ void __launch_bounds__(kThreads) reach_cells(sg_terrain t, TerrainState s, int32_t blocks) {
  __shared__ float farthest[kWarps][kWarp], nearest[kWarps][kWarp];
  const int view = blockIdx.x / blocks, column = (int)(blockIdx.x % blocks) * kWarp + lane();
  const sg_terrain_patches p = cells_of(t, view);
  const int step = p.across.count, each = (p.rows + kWarps - 1) / kWarps, first = warp() * each;
  const int end = column < step ? (first + each < p.rows ? first + each : p.rows) : 0;
  float far = -kNever, near = kNever;
  for (int row = first; row < end; row++) {
    const float low = p.low[(int64_t)row * step + column], high = p.high[(int64_t)row * step + column];
    far = fmaxf(far, fmaxf(low, high));
    near = fminf(near, fminf(low, high));
  }
  farthest[warp()][lane()] = far;
  nearest[warp()][lane()] = near;
  __syncthreads();
  far = -kNever;
  near = kNever;
  for (int k = 0; k < warp(); k++) far = fmaxf(far, farthest[k][lane()]);
  for (int k = warp() + 1; k < kWarps; k++) near = fminf(near, nearest[k][lane()]);
  for (int row = first; row < end; row++) {
    const int64_t cell = (int64_t)row * step + column;
    s.reached[view * s.cells + cell] = far = fmaxf(far, fmaxf(p.low[cell], p.high[cell]));
  }
  for (int row = end - 1; row >= first; row--) {
    const int64_t cell = (int64_t)row * step + column;
    s.ahead[view * s.cells + cell] = near = fminf(near, fminf(p.low[cell], p.high[cell]));
  }
}

extern "C" __global__ void __launch_bounds__(kThreads) return_cells(sg_terrain t, TerrainState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_terrain_patches p = cells_of(t, view);
  const Entry e = this_entry(view, blocks, p.rows, p.across.count);
  if (!e.inside) return;
  const float gamma0 = gamma0_of_cell(t, view, places_of_cell(t, p, e.y, e.x));
  s.returned[view * s.cells + (int64_t)e.y * p.across.count + e.x] = gamma0 * left_of_cell(t, p, e.y, e.x) * (float)t.cell;
}

SG_FN int64_t in_columns(const sg_terrain& t, const TerrainState& s, int view, int row, int column) {
  return ((int64_t)view * t.rows.count + row) * s.columns + column;
}

extern "C" __global__ void __launch_bounds__(kThreads) see_cells(sg_terrain t, TerrainState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_terrain_patches p = cells_of(t, view);
  const Entry e = this_entry(view, blocks, t.rows.count, p.across.count);
  if (!e.inside) return;
  const Response r = response_of(t, view, e.y);
  const int64_t step = p.across.count;
  int row = 0, high = p.rows;  // the first that reaches so far, or is behind one that does
  while (row < high) {
    const int middle = (row + high) / 2;
    if (s.reached[view * s.cells + middle * step + e.x] >= r.at - r.reach) high = middle;
    else row = middle + 1;
  }
  float sum = 0.0f;
  for (; row < p.rows && s.ahead[view * s.cells + row * step + e.x] <= r.at + r.reach; row++) {
    const int64_t cell = row * step + e.x;
    if (sees(r, p.low[cell], p.high[cell])) sum += s.returned[view * s.cells + cell] * over_cell(r, p.low[cell], p.high[cell]);
  }
  s.seen[in_columns(t, s, view, e.y, e.x)] = sum;
}

extern "C" __global__ void __launch_bounds__(kThreads) light_terrain(sg_terrain t, GroundState g, TerrainState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const Entry e = this_entry(view, blocks, t.rows.count, t.columns.count);
  if (!e.inside) return;
  const int64_t pixel = (int64_t)view * t.columns.count + e.x;
  t.lit[((int64_t)view * t.rows.count + e.y) * t.columns.count + e.x] =
      seen_by(g, g.weight, pixel, [&](int k) { return s.seen[in_columns(t, s, view, e.y, k)]; });
}

extern "C" __global__ void __launch_bounds__(kThreads) light_terrain_backward(sg_terrain t, GroundState g, TerrainState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_terrain_patches p = cells_of(t, view);
  const Entry e = this_entry(view, blocks, t.rows.count, p.across.count);
  float azimuth = 0.0f;
  if (e.inside) {
    const int64_t pixel = (int64_t)view * t.columns.count, at = in_columns(t, s, view, e.y, e.x);
    const float* d_lit = t.d_lit + ((int64_t)view * t.rows.count + e.y) * t.columns.count;
    auto seed = [&](int j) { return d_lit[j]; };
    s.between[at] = told_by(g, g.weight, pixel, t.columns.count, e.x, seed);
    if (g.slope) azimuth = told_by(g, g.slope, pixel, t.columns.count, e.x, seed) * s.seen[at];
  }
  if (!g.slope) return;
  azimuth = block_sum(azimuth);
  if (thread() == 0) s.azimuth[blockIdx.x] = azimuth;
}

extern "C" __global__ void __launch_bounds__(kThreads) see_cells_backward(sg_terrain t, TerrainState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_terrain_patches p = cells_of(t, view);
  const Entry e = this_entry(view, blocks, p.rows, p.across.count);
  float moved = 0.0f, largest = 0.0f;
  if (e.inside) {
    const int64_t cell = (int64_t)e.y * p.across.count + e.x;
    const float low = p.low[cell], high = p.high[cell];
    const double origin = t.rows.first - (t.shift ? (double)t.shift[2 * view + 1] : 0.0), reach = kGroundEnd * t.std[1];
    // one more on either side, for `sees` decides
    const int first = place_within(floor((fminf(low, high) - reach - origin) / t.rows.step) - 1.0, t.rows.count);
    const int end = place_within(ceil((fmaxf(low, high) + reach - origin) / t.rows.step) + 2.0, t.rows.count);
    float told = 0.0f;
    for (int i = first; i < end; i++) {
      const Response r = response_of(t, view, i);
      if (!sees(r, low, high)) continue;
      const float seed = s.between[in_columns(t, s, view, i, e.x)];
      told += over_cell(r, low, high) * seed;
      if (s.range) moved += slope_over_cell(r, low, high) * seed;
    }
    s.told[view * s.cells + cell] = told;
    moved *= s.returned[view * s.cells + cell];
    largest = told == told ? fabsf(told) : __int_as_float(kInfinite);
  }
  largest = -warp_min(-largest);
  if (lane() == 0 && largest > 0.0f) atomicMax(s.largest + view, __float_as_uint(largest));
  if (!s.range) return;
  moved = block_sum(moved);
  if (thread() == 0) s.range[blockIdx.x] = moved;
}

// dL/dT_end of the traced rays: 0 of those that end elsewhere
extern "C" __global__ void __launch_bounds__(kThreads) tell_rays(sg_terrain t, TerrainState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_terrain_patches p = cells_of(t, view);
  const Entry e = this_entry(view, blocks, p.traced[0], p.traced[1]);
  if (!e.inside) return;
  const int row = e.y + p.traced_first[0], column = e.x + p.traced_first[1];
  float d_left = 0.0f;
  if (row >= 0 && row < p.rows && column >= 0 && column < p.across.count)
    d_left = s.told[view * s.cells + (int64_t)row * p.across.count + column] * gamma0_of_cell(t, view, places_of_cell(t, p, row, column)) * (float)t.cell;
  t.d_transmittance[p.first + (int64_t)e.y * p.traced[1] + e.x] = d_left;
}

// What one is in whole numbers, so that not even the sum of all cells of a view is too large.
SG_FN double unit_of(const sg_terrain& t, const TerrainState& s, int view, const sg_terrain_patches& p) {
  const double most = (double)__int_as_float((int)s.largest[view]) * t.cell * ((double)p.rows * p.across.count + 1.0);
  return most > 0.0 ? exp2(floor(60.0 - log2(most))) : 1.0;
}

extern "C" __global__ void __launch_bounds__(kThreads) tell_places(sg_terrain t, TerrainState s, int32_t blocks) {
  const int view = blockIdx.x / blocks;
  const sg_terrain_patches p = cells_of(t, view);
  const Entry e = this_entry(view, blocks, p.rows, p.across.count);
  if (!e.inside) return;
  const float told = s.told[view * s.cells + (int64_t)e.y * p.across.count + e.x];
  if (told == 0.0f || s.largest[view] == kInfinite) return;
  const CellPlaces c = places_of_cell(t, p, e.y, e.x);
  const double unit = unit_of(t, s, view, p), seed = (double)told * left_of_cell(t, p, e.y, e.x) * t.cell;
  for (int k = 0; k < 4; k++)
    if (c.share[k] != 0.0f) atomicAdd((unsigned long long*)s.sums + (int64_t)view * places_of(t) + c.at[k], (unsigned long long)llrint(c.share[k] * seed * unit));
}
extern "C" __global__ void __launch_bounds__(kThreads) write_places(sg_terrain t, TerrainState s) {
  const int64_t n = this_number();
  if (n >= (int64_t)t.views * places_of(t)) return;
  const int view = (int)(n / places_of(t));
  const bool all_are_numbers = s.largest[view] < kInfinite;
  t.d_gamma0[n] = all_are_numbers ? (float)((double)s.sums[n] / unit_of(t, s, view, cells_of(t, view))) : __int_as_float(kNoNumber);
}

extern "C" __global__ void __launch_bounds__(kThreads) sum_terrain_shift(sg_terrain t, TerrainState s, int32_t of_columns, int32_t of_cells) {
  const int view = blockIdx.x;
  const sg_terrain_patches p = cells_of(t, view);
  const float azimuth = total_of(s.azimuth + (int64_t)view * of_columns, blocks_of(t.rows.count, p.across.count));
  const float range = total_of(s.range + (int64_t)view * of_cells, blocks_of(p.rows, p.across.count));
  if (thread() > 0) return;
  t.d_shift[2 * view] = azimuth;
  t.d_shift[2 * view + 1] = range;
}

}  // namespace SG_ISA
}  // namespace sarsplat
