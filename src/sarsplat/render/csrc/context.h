// context.h: what one forward pass keeps for its backward pass, and the constants of its division into tasks.
#pragma once
#include <cstring>

#include "simd.h"

#include "api.h"
#include "gaussian_math.h"
#include "memory.h"
#include "passes.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kChunk = 1024;      // Gaussians per task; a multiple of every kWidth
constexpr int kTasks = 16;        // pair-loop tasks wanted over all views, at most kMostBands of them per view
constexpr int kRowsPerBand = 12;   // at least: a Gaussian on a border is visited twice
constexpr float kFarthest = 1 << 24;  // ray cells or pixels from the origin: whole numbers in float32
constexpr int64_t kMostRays = int64_t(1) << 28;

int least(int a, int b) { return a < b ? a : b; }
int most(int a, int b) { return a > b ? a : b; }
int bands_of(int rows, int bands) { return most(1, least(bands, rows / kRowsPerBand)); }
int64_t padded(int64_t n) { return (n + kWidth - 1) / kWidth * kWidth; }

// ---- what a view keeps -----------------------------------------------------------------------------------------------
struct Bounds { float low[2], high[2]; };

struct Lists {                    // of each band, the Gaussians that reach it, in order
  int32_t* ids;
  int first[kMostBands + 1];
};

struct ViewState {
  ViewFrame frame;
  Entry *on_rays, *on_pixels;     // by id; depth: kappa' on rays, the amplitude on pixels
  float *range, *phase, *norm;    // z_r, infinite for Gaussians that touch no ray; P(u); of the imaging weight
  Bounds* bounds;                 // per chunk, of the footprints on the computation plane
  uint64_t *order, *order_spare;  // front to back: depth key << 32 | id
  int touching;                   // how many are in it
  Strips rays, pixels;
  Lists ray_lists, pixel_lists;
  float* T;                       // strips of rays
  int32_t* stop;
  float* partial;                 // sums of w by slot
  float* weight;                  // sum of w over all rays, by id
};

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat

using namespace sarsplat::SG_ISA;

struct sg_context {
  Arena arena;
  Arena::Mark kept;
  float *mean[3], *unit[4], *norm, *rot[9], *scale[3], *kappa;
  ViewState* views;
  int bands;
};

namespace sarsplat {
namespace SG_ISA {
namespace {

Body<F> body(const sg_context& c, int64_t i) {
  Body<F> b;
  for (int k = 0; k < 3; k++) { b.mean[k] = load(c.mean[k] + i); b.scale[k] = load(c.scale[k] + i); }
  for (int k = 0; k < 9; k++) b.rot[k] = load(c.rot[k] + i);
  return b;
}

PlaneUnits units(const sg_problem& p) {
  return {{p.ray[0], p.ray[1]}, {p.pixel[0], p.pixel[1]}, p.cell_widening, {p.response_var[0], p.response_var[1]}};
}

// strips of a band to rows of an image
void copy_rows(const Strips& s, int b, const float* strips, float* image) {
  for (int y = s.band[b].first; y < s.band[b].end; y++)
    for (int x = 0; x < s.columns; x += kBlockX)
      std::memcpy(image + (int64_t)(y - s.y0) * s.columns + x, strips + s.at(b, s.x0 + x, y), sizeof(float) * least(kBlockX, s.columns - x));
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
