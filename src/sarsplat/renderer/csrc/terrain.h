// terrain.h: what terrain returns where rays end on it, and the gradient of that. The twin in torch, with the formula, is
// `LitTerrain.plain` in lit_terrain.py; the GPU's kernels are in cuda_terrain.cuh.
//
// lit = R(gamma0 T) X^T: X is the band of ground.h; R means the response of a pixel over what each cell covers of the slant
// range, and is never written down. Forward, the tasks are stripes of columns, backward whole views, whose places are
// added to in the order of their cells.
#pragma once
#include "ground.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kAbreast = 16;           // columns of cells, so that what lies beside each other is read together
constexpr int kPhases = 512;           // of a place between two pixels, at which the response is written down; between them it is linear
constexpr float kShort = 0.25f;        // standard deviations: over less, differences of integrals have too few digits
constexpr float kThird = 0.28867513f;  // of the two points whose mean is the integral's: 1/2 -+ 1/sqrt 12

SG_FN F exponential(F x) { return power2(larger(x * kLog2e, splat(-120.0f))); }

// The response in pixels around a place, by the place's phase: its integral from there, itself, and its slope.
struct Table {
  enum { kIntegral, kDensity, kSlope, kCount };
  int lead, width;  // numbers before the place's own pixel, and in all: kWidth and more before and after all that is not constant
  float* values[kCount];
};
Table table_of(Arena& arena, float std) {
  Table t;
  t.lead = (int)__builtin_ceilf((float)kResponseEnd * std) + kWidth + 1;
  t.width = (2 * t.lead + 2 * kWidth) / kWidth * kWidth;
  for (float*& values : t.values) values = arena.take<float>((int64_t)(kPhases + 1) * t.width);
  return t;
}
void fill(const Table& t, int phase, float std) {
  const float root = 0.70710678f / std;
  F lane;
  for (int k = 0; k < kWidth; k++) lane[k] = (float)k;
  for (int k = 0; k < t.width; k += kWidth) {
    const F x = (lane + (float)(k - t.lead) - (float)phase / kPhases) * root, dense = exponential(-x * x);
    // erfc, absolute error 2e-7 (Abramowitz and Stegun, 7.1.26)
    const F u = 1.0f / (1.0f + 0.3275911f * absolute(x));
    const F tail = ((((1.061405429f * u - 1.453152027f) * u + 1.421413741f) * u - 0.284496736f) * u + 0.254829592f) * u * dense;
    const F density = dense * (root * 0.56418958f);
    const int64_t at = (int64_t)phase * t.width + k;
    store_anywhere(t.values[Table::kIntegral] + at, choose(x < 0.0f, 0.5f * tail, 1.0f - 0.5f * tail));
    store_anywhere(t.values[Table::kDensity] + at, density);
    store_anywhere(t.values[Table::kSlope] + at, density * x * (-2.0f * root));
  }
}

// A place among pixels, to look up.
struct Place { int64_t row; int pixel; float share; };
SG_FN Place place_of(const Table& t, float x) {
  const float whole = __builtin_floorf(x), phase = (x - whole) * kPhases;
  const int row = smaller((int)phase, kPhases - 1);
  return {(int64_t)row * t.width, (int)whole, phase - (float)row};
}
// for the pixels n, n + 1, ...
SG_FN F look_up(const Table& t, int which, const Place& place, int n) {
  const int k = smaller(larger(n - place.pixel + t.lead, 0), t.width - kWidth);
  const float* at = t.values[which] + place.row + k;
  const F before = load_anywhere(at);
  return before + place.share * (load_anywhere(at + t.width) - before);
}

// Pixels as places, and the response in them.
struct RangeAxis {
  float per_m, offset, reach, brief, scale;  // place = (r + shift) per_m + offset; 6 and 1/4 standard deviations; of a weight
  int pixels;
};
RangeAxis range_axis(const sg_terrain& t, int v) {
  const double step = t.rows.step, std = t.std[1] / step, shift = t.shift ? t.shift[2 * v + 1] : 0.0;
  return {(float)(1.0 / step), (float)((shift - t.rows.first) / step), (float)(kResponseEnd * std), (float)(kShort * std),
          (float)(t.cell / step), t.rows.count};
}

// visit(first pixel, weights, their slopes by the shift in metres) of a cell, kWidth pixels at a time; there may be some beyond
// the last one.
template <bool slopes, class Visit> SG_FN void weigh_cell(const Table& t, const RangeAxis& r, float low_m, float high_m, Visit visit) {
  const float low = low_m * r.per_m + r.offset, high = high_m * r.per_m + r.offset, length = high - low;
  const float begin = __builtin_ceilf((low < high ? low : high) - r.reach), end = (low < high ? high : low) + r.reach;
  if (!(end >= 0.0f && begin < (float)r.pixels)) return;
  const int first = begin > 0.0f ? (int)begin : 0, last = end < (float)r.pixels ? (int)end : r.pixels - 1;
  const bool brief = __builtin_fabsf(length) < r.brief;
  const float inset = brief ? (0.5f - kThird) * length : 0.0f, scale = r.scale * (brief ? 0.5f : 1.0f / length);
  const Place one = place_of(t, low + inset), other = place_of(t, high - inset);
  for (int n = first; n <= last; n += kWidth) {
    F weight, slope = splat(0.0f);
    if (brief) {
      weight = scale * (look_up(t, Table::kDensity, one, n) + look_up(t, Table::kDensity, other, n));
      if (slopes) slope = (-scale * r.per_m) * (look_up(t, Table::kSlope, one, n) + look_up(t, Table::kSlope, other, n));
    } else {
      weight = scale * (look_up(t, Table::kIntegral, one, n) - look_up(t, Table::kIntegral, other, n));
      if (slopes) slope = (scale * r.per_m) * (look_up(t, Table::kDensity, other, n) - look_up(t, Table::kDensity, one, n));
    }
    visit(n, weight, slope);
  }
}

// gamma0 of a cell, and the places whose mean it is.
struct Between { int64_t at[4]; float share[4]; };
SG_FN float within_places(float x, int count) { return x > 0.0f ? x < (float)(count - 1) ? x : (float)(count - 1) : 0.0f; }
SG_FN Between between(const sg_terrain& t, const sg_terrain_patches& p, int row, int column, float range) {
  if (t.places[0] * t.places[1] == 1) return {{0, 0, 0, 0}, {1.0f, 0.0f, 0.0f, 0.0f}};
  const float x = within_places(p.x[0] + p.x[1] * column + p.x[2] * row + p.x[3] * range, t.places[1]);
  const float y = within_places(p.y[0] + p.y[1] * column + p.y[2] * row + p.y[3] * range, t.places[0]);
  const int i = smaller((int)x, larger(t.places[1] - 2, 0)), j = smaller((int)y, larger(t.places[0] - 2, 0));
  const int64_t right = t.places[1] > 1, down = t.places[0] > 1 ? t.places[1] : 0, at = (int64_t)j * t.places[1] + i;
  const float u = x - i, v = y - j;
  return {{at, at + right, at + down, at + down + right}, {(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v}};
}
SG_FN float gamma0_at(const float* table, const Between& b) {
  float sum = 0.0f;
  for (int k = 0; k < 4; k++) sum += b.share[k] * table[b.at[k]];
  return sum;
}

struct TerrainView {
  Band across;           // X
  const float* gamma0;
  const float* transmittance;
  float* turned;         // [cells across, pixels' rows]: of what pixels' rows see, or its gradient
  double* shift;         // [stripes + 1] of the gradient: azimuth, and last range
  double* places;        // of the gradient
};

// Where T_end of a cell is; negative: it is 1
SG_FN int64_t traced_at(const sg_terrain_patches& p, int row, int column) {
  const int y = row - p.traced_first[0], x = column - p.traced_first[1];
  return y >= 0 && y < p.traced[0] && x >= 0 && x < p.traced[1] ? (int64_t)y * p.traced[1] + x : -1;
}

int32_t lit_terrain(sg_context* context, const sg_terrain* terrain) {
  const sg_terrain& t = *terrain;
  const bool backward = t.d_lit != nullptr;
  const int64_t count = (int64_t)t.places[0] * t.places[1];
  const int pixels = t.rows.count;
  Arena& arena = context->arena;
  arena.reset();
  TerrainView* views = arena.take<TerrainView>(t.views);
  const int stripes = (pixels + kStripe - 1) / kStripe;
  const float std = (float)(t.std[1] / t.rows.step);
  const Table table = table_of(arena, std);
  int64_t widest = 0;
  for (int v = 0; v < t.views && !arena.failed(); v++) {
    const sg_terrain_patches& p = t.patches[v];
    views[v] = {band_of(arena, t.columns, p.across, t.std[0], t.d_shift != nullptr), t.gamma0 + v * count, t.transmittance + p.first,
                arena.take<float>((int64_t)p.across.count * pixels + 1), t.d_shift ? arena.take<double>(stripes + 1) : nullptr,
                backward ? arena.take<double>(count) : nullptr};
    widest = widest > p.across.count ? widest : p.across.count;
  }
  if (arena.failed()) { arena.give_back(); return SG_MEMORY; }

  bool failed = false;
  auto with_scratch = [&](int64_t floats, auto task) {
    float* scratch = (float*)std::calloc(floats, sizeof(float));
    if (scratch) task(scratch);
    else __atomic_store_n(&failed, true, __ATOMIC_RELAXED);
    std::free(scratch);
  };
  parallel(kPhases + 1, [&](int phase) { fill(table, phase, std); });
  parallel(t.views, [&](int v) {
    weigh(views[v].across, t.columns, t.patches[v].across, t.std[0], t.shift ? t.shift[2 * v] : 0.0);
    for (int k = 0; t.d_shift && k <= stripes; k++) views[v].shift[k] = 0.0;
  });
  const int padded = pixels + kWidth;
  const int most = (int)((widest + kAbreast - 1) / kAbreast);
  auto image_rows = [&](int) { return pixels; };
  const int64_t image = (int64_t)pixels * t.columns.count;

  if (!backward || t.d_shift)  // turned = R(gamma0 T)^T
    parallel(t.views * most, [&](int task) {
      const int v = task / most, begin = task % most * kAbreast;
      const sg_terrain_patches& p = t.patches[v];
      const int columns = smaller(kAbreast, p.across.count - begin);
      if (columns <= 0) return;
      const RangeAxis range = range_axis(t, v);
      with_scratch((int64_t)kAbreast * padded, [&](float* sums) {
        for (int row = 0; row < p.rows; row++)
          for (int c = 0; c < columns; c++) {
            const int64_t cell = (int64_t)row * p.across.count + begin + c, traced = traced_at(p, row, begin + c);
            const float left = traced < 0 ? 1.0f : views[v].transmittance[traced];
            const float returned = left * gamma0_at(views[v].gamma0, between(t, p, row, begin + c, 0.5f * (p.low[cell] + p.high[cell])));
            float* sum = sums + (int64_t)c * padded;
            weigh_cell<false>(table, range, p.low[cell], p.high[cell],
                              [&](int n, F weight, F) { store_anywhere(sum + n, load_anywhere(sum + n) + returned * weight); });
          }
        for (int c = 0; c < columns; c++)
          std::memcpy(views[v].turned + (int64_t)(begin + c) * pixels, sums + (int64_t)c * padded, sizeof(float) * pixels);
      });
    });
  const int64_t stripe = (widest + t.columns.count) * 2 * kStripe;
  if (!backward)
    over_stripes(t.views, image_rows, [&](int v, int begin) {
      const int across = t.patches[v].across.count;
      with_scratch(stripe, [&](float* cells) {
        float* out = cells + (int64_t)across * kStripe;
        to_stripe(views[v].turned, across, pixels, begin, false, cells);
        seen(views[v].across, views[v].across.weight, cells, out);
        for (int c = 0; c < kStripe && begin + c < pixels; c++)
          for (int x = 0; x < t.columns.count; x++) t.lit[v * image + (int64_t)(begin + c) * t.columns.count + x] = out[(int64_t)x * kStripe + c];
      });
    });
  else {
    over_stripes(t.views, image_rows, [&](int v, int begin) {  // turned = (dL/dlit X)^T
      const int across = t.patches[v].across.count;
      with_scratch(stripe, [&](float* cells) {
        float *out = cells + (int64_t)across * kStripe, *moved = out + (int64_t)t.columns.count * kStripe;
        to_stripe_turned(t.d_lit + v * image, pixels, t.columns.count, begin, out);
        if (t.d_shift) {
          to_stripe(views[v].turned, across, pixels, begin, false, cells);
          seen(views[v].across, views[v].across.slope, cells, moved);
          views[v].shift[begin / kStripe] = product(out, moved, t.columns.count);
        }
        seen_backward(views[v].across, out, cells);
        for (int x = 0; x < across; x++)
          for (int c = 0; c < kStripe && begin + c < pixels; c++) views[v].turned[(int64_t)x * pixels + begin + c] = cells[(int64_t)x * kStripe + c];
      });
    });
    parallel(t.views, [&](int v) {
      const sg_terrain_patches& p = t.patches[v];
      const RangeAxis range = range_axis(t, v);
      float* d_transmittance = t.d_transmittance + (views[v].transmittance - t.transmittance);
      std::memset(d_transmittance, 0, sizeof(float) * p.traced[0] * p.traced[1]);
      for (int64_t k = 0; k < count; k++) views[v].places[k] = 0.0;
      with_scratch((int64_t)kAbreast * padded, [&](float* seeds) {
        for (int begin = 0; begin < p.across.count; begin += kAbreast) {
          const int columns = smaller(kAbreast, p.across.count - begin);
          for (int c = 0; c < columns; c++)
            std::memcpy(seeds + (int64_t)c * padded, views[v].turned + (int64_t)(begin + c) * pixels, sizeof(float) * pixels);
          for (int row = 0; row < p.rows; row++)
            for (int c = 0; c < columns; c++) {
              const int64_t cell = (int64_t)row * p.across.count + begin + c, traced = traced_at(p, row, begin + c);
              const float left = traced < 0 ? 1.0f : views[v].transmittance[traced];
              const Between places = between(t, p, row, begin + c, 0.5f * (p.low[cell] + p.high[cell]));
              const float gamma0 = gamma0_at(views[v].gamma0, places), *seed = seeds + (int64_t)c * padded;
              F lit = splat(0.0f), moved = splat(0.0f);
              if (t.d_shift)
                weigh_cell<true>(table, range, p.low[cell], p.high[cell], [&](int n, F weight, F slope) {
                  lit += weight * load_anywhere(seed + n);
                  moved += slope * load_anywhere(seed + n);
                });
              else
                weigh_cell<false>(table, range, p.low[cell], p.high[cell], [&](int n, F weight, F) { lit += weight * load_anywhere(seed + n); });
              const float d_returned = sum(lit);
              if (traced >= 0) d_transmittance[traced] = gamma0 * d_returned;
              for (int k = 0; k < 4; k++) views[v].places[places.at[k]] += places.share[k] * left * d_returned;
              if (t.d_shift) views[v].shift[stripes] += gamma0 * left * sum(moved);
            }
        }
      });
      for (int64_t k = 0; k < count; k++) t.d_gamma0[v * count + k] = (float)views[v].places[k];
      if (!t.d_shift) return;
      double azimuth = 0.0;
      for (int k = 0; k < stripes; k++) azimuth += views[v].shift[k];
      t.d_shift[2 * v] = (float)azimuth;
      t.d_shift[2 * v + 1] = (float)views[v].shift[stripes];
    });
  }
  if (failed) { arena.give_back(); return SG_MEMORY; }
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
