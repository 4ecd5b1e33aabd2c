// context.h: what one forward pass keeps for its backward pass, and the constants of its division into tasks.
#pragma once
#include "simd.h"

#include "api.h"
#include "gaussian_math.h"
#include "memory.h"
#include "passes.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kChunk = 1024;      // Gaussians per task; a multiple of every kWidth
constexpr int kTasks = 16;        // pair-loop tasks wanted over all views
constexpr int kMostBands = 8;     // of them at most this many per view: a Gaussian on a border is visited twice
constexpr int kMostBlocks = 32767;
constexpr int64_t kMostLanes = int64_t(1) << 28;

int least(int a, int b) { return a < b ? a : b; }
int most(int a, int b) { return a > b ? a : b; }
int64_t padded(int64_t n) { return (n + kWidth - 1) / kWidth * kWidth; }
int blocks(int n, int per) { return (n + per - 1) / per; }

// ---- what a view keeps -----------------------------------------------------------------------------------------------
struct Plane { float *x, *y, *a, *b, *c, *limit, *depth, *rx, *ry; };  // footprints, one array a field

struct Bounds { float low[2], high[2]; };

struct ViewState {
  ViewFrame frame;
  Plane rays, pixels;             // depth: kappa' on rays, the norm on pixels
  float *range, *phase;           // z_r, P(u)
  Bounds* bounds;                 // per chunk, of the footprints on the computation plane
  uint64_t *order, *order_spare;  // radix sort: depth key << 32 | id
  int64_t k0x, k0y;
  int ray_rows, ray_columns, ray_bx, ray_by;
  int touching;                   // Gaussians that can touch a ray, front to back:
  Entry* on_rays;
  int32_t* rank;                  // id -> position in on_rays, or -1
  Entry* on_pixels;               // by id
  Band ray_bands[kMostBands], pixel_bands[kMostBands];
  float* T;
  int32_t* last;
  float* weight;                  // sum of w over rays, by id
  float* partial;                 // [bands, touching]
};

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat

using namespace sarsplat::SG_ISA;

struct sg_context {
  Arena arena;
  Arena::Mark kept;
  float *mean[3], *unit[4], *norm, *rot[9], *scale[3], *kappa, *harmonics[16];
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

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
