// context.h: what one forward pass keeps for its backward pass, and the constants of its division into tasks.
#pragma once
#include <cstring>

#include "api.h"
#include "columns.h"
#include "gaussian_math.h"
#include "memory.h"
#include "passes.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kChunk = 1024;      // Gaussians per task; a multiple of every kWidth
constexpr int kTasks = 16;        // pair-loop tasks wanted over all views, at most kMostParts of them per view
constexpr int kMostParts = 8;
constexpr int kRowsPerTask = 16, kStripsPerTask = 8;  // of images
constexpr int kShapes = 8;        // told apart, in either direction
constexpr int kRowsPerBand = 12;  // at least, on average: a Gaussian on a border is visited twice
constexpr float kFarthest = 1 << 24;  // ray cells or pixels from the origin: whole numbers in float32
constexpr int32_t kNoDepth = -1;      // as an unsigned key it comes last
constexpr int64_t kMostRays = int64_t(1) << 28;

int least(int a, int b) { return a < b ? a : b; }
int most(int a, int b) { return a > b ? a : b; }
I least(I a, I b) { return __builtin_elementwise_min(a, b); }
I most(I a, I b) { return __builtin_elementwise_max(a, b); }
int64_t padded(int64_t n) { return (n + kWidth - 1) / kWidth * kWidth; }

// ---- what a view keeps -----------------------------------------------------------------------------------------------
struct Bounds { F low[2], high[2]; };

// What one task of a pair loop works on: some Gaussians of a list, and a rectangle with memory of its own.
struct Part {
  int first, end;                 // in the list
  Strips strips;
  int64_t start;                  // in the memory of all parts
  float* memory;
  int count() const { return end - first; }
};

struct Reached { uint8_t first, end; };  // bands

struct ViewState {
  ViewFrame frame;
  RayEntry* on_rays;              // by id
  PixelEntry* on_pixels;
  int32_t* depth_keys;            // by id: z_r as an ordered number, kNoDepth for Gaussians that touch no ray
  int32_t* pixel_keys;            // by id: the first row, then the shape
  Bounds* bounds;                 // by chunk, of the footprints on the computation plane
  uint64_t *order, *order_spare;  // front to back: depth key << 32 | id
  int touching;                   // how many are in it
  Strips rays;                    // the lattice
  int ray_parts, pixel_parts;
  Part ray_bands[kMostParts];     // of rows; who reaches them, front to back
  Part pixel_groups[kMostParts];  // every Gaussian is in one of them
  int32_t *ray_list, *pixel_list; // ids
  Reached* reached;               // by id
  int64_t* rows;                  // scratch
  int32_t* counts;
  float* T;                       // by band
  int32_t* stop;
  float* partial;                 // sums of w by slot
};

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat

using namespace sarsplat::SG_ISA;

struct sg_context {
  Arena arena;
  Arena::Mark kept;
  ViewState* views;
  Strips image;
  int parts;                      // of a view, at most
};

namespace sarsplat {
namespace SG_ISA {
namespace {

struct Bodies {                   // kWidth Gaussians
  Body<F> body;
  F unit[4], norm, kappa;         // q / |q|, |q|
};
Bodies read_bodies(const sg_problem& p, int64_t i, int real) {
  Bodies b;
  F q[4];
  read_few<3>(p.means + 3 * i, real, b.body.mean);
  read_few<3>(p.scales + 3 * i, real, b.body.scale);
  read_few<4>(p.quaternions + 4 * i, real, q);
  read_few<1>(p.kappa + i, real, &b.kappa);
  for (int k = real; k < kWidth; k++) {  // the rest are harmless
    for (F& scale : b.body.scale) scale[k] = 1.0f;
    q[0][k] = 1.0f;
  }
  rotation(q[0], q[1], q[2], q[3], b.body.rot, b.unit, b.norm);
  return b;
}

// log2 of the optical depth at which a footprint ends, and q at which an imaging weight ends; base 2
float least_log_tau(const sg_problem& p) { return __builtin_log2f(p.min_ray_depth * kLog2e); }
float image_cut(const sg_problem& p) { return 0.5f * kLog2e * p.image_cut; }

PlaneUnits units(const sg_problem& p) {
  return {{p.ray[0], p.ray[1]}, {p.pixel[0], p.pixel[1]}, p.cell_widening, {p.response_var[0], p.response_var[1]}};
}

int64_t size_with_spare_rows(const Strips& s, int parts) { return s.size() + (int64_t)(parts - 1) * (kBlockY - 1) * s.count() * kBlockX; }

// One row of strips to a row of numbers.
void read_row(const Strips& s, int y, const float* strips, float* row) {
  for (int x = 0; x < s.columns; x += kBlockX)
    std::memcpy(row + x, strips + s.at(s.x0 + x, y), sizeof(float) * least(kBlockX, s.columns - x));
}

// An image to strips, whose spare rows are zero.
void write_strips(const Strips& s, int first, int end, const float* image, float* strips) {
  for (int i = first; i < end; i++) {
    float* strip = strips + (int64_t)i * s.height() * kBlockX;
    const int x = i * kBlockX, some = least(kBlockX, s.columns - x);
    std::memset(strip, 0, sizeof(float) * s.height() * kBlockX);
    for (int y = 0; y < s.rows; y++) std::memcpy(strip + y * kBlockX, image + (int64_t)y * s.columns + x, sizeof(float) * some);
  }
}

// Rows of an image: what its parts hold, in their order.
void add_parts(const ViewState& s, int first, int end, int columns, float* image) {
  for (int y = first; y < end; y++) {
    float* row = image + (int64_t)y * columns;
    for (int x = 0; x < columns; x++) row[x] = 0.0f;
    for (int b = 0; b < s.pixel_parts; b++) {
      const Part& part = s.pixel_groups[b];
      const Strips& r = part.strips;
      if (y < r.y0 || y >= r.y0 + r.rows) continue;
      for (int x = 0; x < columns; x += kBlockX) {
        const float* from = part.memory + r.at(x, y);
        for (int k = 0; k < least(kBlockX, columns - x); k++) row[x + k] += from[k];
      }
    }
  }
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
