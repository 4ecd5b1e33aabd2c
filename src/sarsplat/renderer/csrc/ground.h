// ground.h: how much of the ground each pixel sees, and the gradient of that. The twin in torch, with the formula, is
// `LitGround.plain` in lit_ground.py; the GPU's kernels are in cuda_ground.cuh.
//
// lit = 1 - R (1 - T) X^T, where row i of R, and row j of X, hold the integrals of the response of pixel i, or j, over the
// patches that the rays' cells make on the ground: bands, because a response sees few patches. Every product is one of a
// band with a stripe of columns, summed in the order of the patches; stripes are the tasks.
#pragma once
#include <cmath>
#include "context.h"
#include "parallel.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kStripe = 64;           // columns of a task
constexpr double kResponseEnd = 6.0;  // standard deviations: beyond, it is nothing in float32

struct Band {
  int pixels, cells, width;
  int32_t *first, *count;  // [pixels] cells that a pixel sees
  float *weight, *slope;   // [pixels, width]; slope: by the shift, or null
};

Band band_of(Arena& arena, const sg_axis& pixel, const sg_axis& cell, double std, bool slopes) {
  const double across = 2.0 * kResponseEnd * std / cell.step;  // at the zenith it is more than an int holds
  const int width = across < cell.count ? smaller(cell.count, (int)across + 3) : cell.count;
  Band b{pixel.count, cell.count, width, nullptr, nullptr, nullptr, nullptr};
  b.first = arena.take<int32_t>(b.pixels);
  b.count = arena.take<int32_t>(b.pixels);
  b.weight = arena.take<float>((int64_t)b.pixels * b.width + 1);
  if (slopes) b.slope = arena.take<float>((int64_t)b.pixels * b.width + 1);
  return b;
}

int within(double place, int count) { return place < 0.0 ? 0 : place > count ? count : (int)place; }

void weigh(const Band& b, const sg_axis& pixel, const sg_axis& cell, double std, double shift) {
  const double root = 1.0 / (std * 1.4142135623730951), height = 1.0 / (std * 2.5066282746310002);
  for (int i = 0; i < b.pixels; i++) {
    const double apart = pixel.first + i * pixel.step - shift - cell.first;
    const int first = within(__builtin_floor((apart - kResponseEnd * std) / cell.step), cell.count);
    const int end = smaller(first + b.width, within(__builtin_ceil((apart + kResponseEnd * std) / cell.step), cell.count));
    b.first[i] = first;
    b.count[i] = larger(0, end - first);
    double u = (apart - first * cell.step) * root, below = std::erf(u), dense = b.slope ? std::exp(-u * u) : 0.0;
    for (int k = 0; k < b.count[i]; k++) {
      const int64_t at = (int64_t)i * b.width + k;
      u = (apart - (first + k + 1) * cell.step) * root;
      const double next = std::erf(u), thin = b.slope ? std::exp(-u * u) : 0.0;
      b.weight[at] = (float)(0.5 * (below - next));
      if (b.slope) b.slope[at] = (float)(height * (thin - dense));
      below = next;
      dense = thin;
    }
  }
}

// Of stripes [cells, kStripe] and [pixels, kStripe].
void seen(const Band& b, const float* weight, const float* cells, float* pixels) {
  for (int i = 0; i < b.pixels; i++) {
    float sum[kStripe] = {};
    for (int k = 0; k < b.count[i]; k++) {
      const float w = weight[(int64_t)i * b.width + k];
      const float* cell = cells + (int64_t)(b.first[i] + k) * kStripe;
      for (int c = 0; c < kStripe; c++) sum[c] += w * cell[c];
    }
    std::memcpy(pixels + (int64_t)i * kStripe, sum, sizeof sum);
  }
}
void seen_backward(const Band& b, const float* pixels, float* cells) {
  std::memset(cells, 0, sizeof(float) * b.cells * kStripe);
  for (int i = 0; i < b.pixels; i++)
    for (int k = 0; k < b.count[i]; k++) {
      const float w = b.weight[(int64_t)i * b.width + k];
      float* cell = cells + (int64_t)(b.first[i] + k) * kStripe;
      const float* pixel = pixels + (int64_t)i * kStripe;
      for (int c = 0; c < kStripe; c++) cell[c] += w * pixel[c];
    }
}

// Part of a table [rows, columns] as a stripe, or of its transpose, and back; what is beyond the table is zero.
void to_stripe(const float* table, int rows, int columns, int begin, bool lit, float* stripe) {
  for (int y = 0; y < rows; y++)
    for (int c = 0; c < kStripe; c++) {
      const float x = begin + c < columns ? table[(int64_t)y * columns + begin + c] : lit ? 1.0f : 0.0f;
      stripe[(int64_t)y * kStripe + c] = lit ? 1.0f - x : x;
    }
}
void to_stripe_turned(const float* table, int rows, int columns, int begin, float* stripe) {
  for (int c = 0; c < kStripe; c++)
    for (int x = 0; x < columns; x++) stripe[(int64_t)x * kStripe + c] = begin + c < rows ? table[(int64_t)(begin + c) * columns + x] : 0.0f;
}

struct GroundView {
  Band along, across;       // R, X
  const float* transmittance;
  float* turned;            // [cells across, rows]: of what pixels' rows see, or its gradient
  double* shift;            // [stripes, 2] of the gradient
};

// f(view, first column) for stripes of tables with `columns(view)` columns
template <class Columns, class Task> void over_stripes(int views, Columns columns, Task f) {
  int most = 0;
  for (int v = 0; v < views; v++) most = larger(most, (columns(v) + kStripe - 1) / kStripe);
  parallel(views * most, [&](int task) {
    const int v = task / most, begin = task % most * kStripe;
    if (begin < columns(v)) f(v, begin);
  });
}

double product(const float* a, const float* b, int rows) {
  double total = 0.0;
  for (int y = 0; y < rows; y++) {
    float sum = 0.0f;
    for (int c = 0; c < kStripe; c++) sum += a[(int64_t)y * kStripe + c] * b[(int64_t)y * kStripe + c];
    total += sum;
  }
  return total;
}

int32_t lit_ground(sg_context* context, const sg_ground* ground) {
  const sg_ground& g = *ground;
  const bool backward = g.d_lit != nullptr;
  Arena& arena = context->arena;
  arena.reset();
  GroundView* views = arena.take<GroundView>(g.views);
  int64_t stripe = 0;
  int stripes = 1;
  for (int v = 0; v < g.views && !arena.failed(); v++) {
    const sg_patches& p = g.patches[v];
    views[v] = {band_of(arena, g.rows, p.rows, g.std[1], g.d_shift != nullptr),
                band_of(arena, g.columns, p.columns, g.std[0], g.d_shift != nullptr),
                g.transmittance + p.first, arena.take<float>((int64_t)p.columns.count * g.rows.count + 1), nullptr};
    stripe = stripe > p.rows.count ? stripe : p.rows.count;
    stripe = stripe > p.columns.count ? stripe : p.columns.count;
    stripes = larger(stripes, (larger(p.columns.count, g.rows.count) + kStripe - 1) / kStripe);
  }
  stripe = (stripe + larger(g.rows.count, g.columns.count)) * 2 * kStripe;
  for (int v = 0; v < g.views && !arena.failed(); v++)
    if (g.d_shift) views[v].shift = arena.take<double>(2 * stripes);
  if (arena.failed()) { arena.give_back(); return SG_MEMORY; }

  bool failed = false;
  auto with_scratch = [&](auto task) {
    float* scratch = (float*)std::malloc(sizeof(float) * stripe);
    if (scratch) task(scratch);
    else __atomic_store_n(&failed, true, __ATOMIC_RELAXED);
    std::free(scratch);
  };
  parallel(g.views, [&](int v) {
    weigh(views[v].along, g.rows, g.patches[v].rows, g.std[1], g.shift ? g.shift[2 * v + 1] : 0.0);
    weigh(views[v].across, g.columns, g.patches[v].columns, g.std[0], g.shift ? g.shift[2 * v] : 0.0);
    for (int k = 0; g.d_shift && k < 2 * stripes; k++) views[v].shift[k] = 0.0;
  });
  auto rays_across = [&](int v) { return g.patches[v].columns.count; };
  auto image_rows = [&](int) { return g.rows.count; };
  const int64_t image = (int64_t)g.rows.count * g.columns.count;

  auto hidden = [&](int v, int begin, const float* weight, float* cells, float* pixels) {
    to_stripe(views[v].transmittance, g.patches[v].rows.count, rays_across(v), begin, true, cells);
    seen(views[v].along, weight, cells, pixels);
  };
  if (!backward || g.d_shift)  // turned = (R (1 - T))^T
    over_stripes(g.views, rays_across, [&](int v, int begin) {
      with_scratch([&](float* cells) {
        float* pixels = cells + (int64_t)g.patches[v].rows.count * kStripe;
        hidden(v, begin, views[v].along.weight, cells, pixels);
        for (int c = 0; c < kStripe && begin + c < rays_across(v); c++)
          for (int y = 0; y < g.rows.count; y++) views[v].turned[(int64_t)(begin + c) * g.rows.count + y] = pixels[(int64_t)y * kStripe + c];
      });
    });
  if (!backward)
    over_stripes(g.views, image_rows, [&](int v, int begin) {
      with_scratch([&](float* cells) {
        float* pixels = cells + (int64_t)rays_across(v) * kStripe;
        to_stripe(views[v].turned, rays_across(v), g.rows.count, begin, false, cells);
        seen(views[v].across, views[v].across.weight, cells, pixels);
        for (int c = 0; c < kStripe && begin + c < g.rows.count; c++)
          for (int x = 0; x < g.columns.count; x++) g.lit[v * image + (int64_t)(begin + c) * g.columns.count + x] = 1.0f - pixels[(int64_t)x * kStripe + c];
      });
    });
  else {
    over_stripes(g.views, image_rows, [&](int v, int begin) {  // turned = (dL/dlit X)^T
      with_scratch([&](float* cells) {
        float *pixels = cells + (int64_t)rays_across(v) * kStripe, *moved = pixels + (int64_t)g.columns.count * kStripe;
        to_stripe_turned(g.d_lit + v * image, g.rows.count, g.columns.count, begin, pixels);
        if (g.d_shift) {
          to_stripe(views[v].turned, rays_across(v), g.rows.count, begin, false, cells);
          seen(views[v].across, views[v].across.slope, cells, moved);
          views[v].shift[begin / kStripe * 2] = product(pixels, moved, g.columns.count);
        }
        seen_backward(views[v].across, pixels, cells);
        for (int x = 0; x < rays_across(v); x++)
          for (int c = 0; c < kStripe && begin + c < g.rows.count; c++) views[v].turned[(int64_t)x * g.rows.count + begin + c] = cells[(int64_t)x * kStripe + c];
      });
    });
    over_stripes(g.views, rays_across, [&](int v, int begin) {
      with_scratch([&](float* cells) {
        const int rows = g.patches[v].rows.count, columns = rays_across(v);
        float *pixels = cells + (int64_t)rows * kStripe, *moved = pixels + (int64_t)g.rows.count * kStripe;
        to_stripe_turned(views[v].turned, columns, g.rows.count, begin, pixels);
        if (g.d_shift) {
          hidden(v, begin, views[v].along.slope, cells, moved);
          views[v].shift[begin / kStripe * 2 + 1] = product(pixels, moved, g.rows.count);
        }
        seen_backward(views[v].along, pixels, cells);
        float* out = g.d_transmittance + (views[v].transmittance - g.transmittance);
        for (int y = 0; y < rows; y++)
          for (int c = 0; c < kStripe && begin + c < columns; c++) out[(int64_t)y * columns + begin + c] = cells[(int64_t)y * kStripe + c];
      });
    });
    for (int v = 0; v < g.views && g.d_shift; v++)
      for (int axis = 0; axis < 2; axis++) {
        double total = 0.0;
        for (int k = 0; k < stripes; k++) total += views[v].shift[2 * k + axis];
        g.d_shift[2 * v + axis] = (float)-total;
      }
  }
  if (failed) { arena.give_back(); return SG_MEMORY; }
  return SG_OK;
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
