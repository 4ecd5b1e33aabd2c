// context.h: what one forward pass keeps for its backward pass, and the constants of its division into tasks.
#pragma once
#include <cstring>

#include "api.h"
#include "columns.h"
#include "gaussian_math.h"
#include "memory.h"
#include "parallel.h"
#include "passes.h"

namespace sarsplat {
namespace SG_ISA {
namespace {

constexpr int kChunk = 1024;      // Gaussians per task; a multiple of every kWidth
constexpr int kTasks = 16;        // pair-loop tasks wanted over all views, at most kMaxParts of them per view
constexpr int kMaxParts = 8;
constexpr int kRowsPerTask = 16, kStripsPerTask = 8;  // of images
constexpr int kShapes = 8;        // of footprints that are told apart in either direction: so many blocks at most
constexpr int kMaxBlocks[kShapes] = {1, 2, 3, 4, 8, 16, 64, 1 << 15};
constexpr int kRowsPerBand = 12;  // at least, on average: a Gaussian on a border is visited twice
constexpr float kFarthest = 1 << 24;  // ray cells or pixels from the origin: whole numbers in float32
constexpr int32_t kNoDepth = -1;      // as an unsigned key it comes last
constexpr int64_t kMaxRays = int64_t(1) << 28;

int64_t padded(int64_t n) { return (n + kWidth - 1) / kWidth * kWidth; }

// Tasks of a pass; Gaussians go by the chunk.
int64_t chunk_end(int64_t chunk, int64_t limit) { return (chunk + 1) * kChunk < limit ? (chunk + 1) * kChunk : limit; }
int chunks_of(int64_t n) { return larger(1, (int)((n + kChunk - 1) / kChunk)); }
// visit(i, real) for kWidth of n Gaussians at a time
template <class Visit> void by_width(int64_t n, Visit visit) {
  parallel(chunks_of(n), [&](int chunk) {
    const int64_t end = chunk_end(chunk, n);
    for (int64_t i = (int64_t)chunk * kChunk; i < end; i += kWidth) visit(i, smaller(kWidth, (int)(end - i)));
  });
}
int tasks_of(int count, int each) { return (count + each - 1) / each; }
int parts_of(const sg_problem& p) { return larger(1, smaller(kMaxParts, kTasks / larger(p.views, 1))); }

// Below, one thread is done before another has come: about 1.3 times as fast with 300 to 1,800 Gaussians.
bool worth_waking(const sg_problem& p) { return (int64_t)p.views * (p.gaussians + (int64_t)p.rows * p.columns / 16) > 2048; }
// A projection alone is a tenth of the work.
bool worth_waking_to_project(const sg_problem& p) { return (int64_t)p.views * p.gaussians > 20480; }

// ---- input ----------------------------------------------------------------------------------------------------------
struct Fault { int32_t status; int64_t index; };

// ---- what a view keeps -----------------------------------------------------------------------------------------------
struct Bounds { F low[2], high[2]; };

// What one task of a pair loop works on: some Gaussians of a list, and a rectangle with memory of its own.
struct Part {
  int first, end;                 // in the list
  Strips strips;
  int64_t start;                  // a band's rays in T and stop
  float* memory;                  // a group's pixels
  int count() const { return end - first; }
};

struct Reached { uint8_t first, end; };  // bands

// Memory of all bands of a lattice.
int64_t size_in_bands(const Strips& s, int bands) { return s.size() + (int64_t)(bands - 1) * (kBlockY - 1) * s.count() * kBlockX; }

struct ViewState {
  // by id
  RayEntry* on_rays;
  PixelEntry* on_pixels;
  int32_t* depth_keys;            // z_r as an ordered number, kNoDepth for Gaussians that touch no ray
  int32_t* pixel_keys;            // the first row, then the shape
  Reached* reached;
  // computation plane
  Bounds* bounds;                 // by chunk, of the footprints
  Strips rays;                    // the lattice
  int ray_parts;
  Part ray_bands[kMaxParts];     // of rows
  int touching;                   // how many Gaussians touch a ray
  int64_t ray_blocks;             // of all of them, about
  // which loops are faster (batches.h): a few blocks are not worth a batch
  bool in_batches() const { return kWidth < 16 && ray_blocks > 4 * (int64_t)touching; }
  int32_t *front_to_back, *ray_list;  // their ids; those of every band
  float* T;                       // by band
  int32_t* stop;
  float* partial;                 // sums of w by slot
  // imaging plane
  int pixel_parts;
  Part pixel_groups[kMaxParts];  // every Gaussian is in one of them
  int32_t* pixel_list;            // ids
  // scratch
  uint64_t* sorting[2];
  int64_t* row_work;
  int32_t* key_counts;

  void take_on_rays(Arena& arena, int64_t n, int chunks, int parts) {
    on_rays = arena.take<RayEntry>(n);
    depth_keys = arena.take<int32_t>(padded(n));
    reached = arena.take<Reached>(n);
    bounds = arena.take<Bounds>(chunks);
    front_to_back = arena.take<int32_t>(n);
    ray_list = arena.take<int32_t>(n * parts);
    partial = arena.take<float>(n * parts);
    for (uint64_t*& scratch : sorting) scratch = arena.take<uint64_t>(n);
  }
  void take_per_ray(Arena& arena, int parts) {  // once the lattice is placed
    float* ruler = arena.take<float>(rays.ruler());
    T = arena.take<float>(size_in_bands(rays, parts));
    stop = arena.take<int32_t>(size_in_bands(rays, parts));
    row_work = arena.take<int64_t>(rays.rows + 1);
    if (!arena.failed()) rays.mark(ruler);
  }
  void take_on_pixels(Arena& arena, int64_t n, int image_rows) {
    on_pixels = arena.take<PixelEntry>(n);
    pixel_keys = arena.take<int32_t>(padded(n));
    pixel_list = arena.take<int32_t>(n);
    key_counts = arena.take<int32_t>((int64_t)image_rows * kShapes * kShapes + 1);
  }
  void take_images(Arena& arena, int channels) {  // once the parts are cut
    for (int b = 0; b < pixel_parts; b++) pixel_groups[b].memory = arena.take<float>(channels * pixel_groups[b].strips.size());
  }
};

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat

using namespace sarsplat::SG_ISA;

struct sg_context {
  Arena arena;
  Arena::Mark kept;
  ViewState* views;
  Fault* faults;                  // of chunks
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
Bodies read_bodies(const float* means, const float* quaternions, const float* scales, int64_t i, int real) {  // without kappa
  Bodies b;
  F q[4];
  read_few<3>(means + 3 * i, real, b.body.mean);
  read_few<3>(scales + 3 * i, real, b.body.scale);
  read_few<4>(quaternions + 4 * i, real, q);
  for (int k = real; k < kWidth; k++) {  // the rest are harmless
    for (F& scale : b.body.scale) scale[k] = 1.0f;
    q[0][k] = 1.0f;
  }
  rotation(q[0], q[1], q[2], q[3], b.body.rot, b.unit, b.norm);
  return b;
}
Bodies read_bodies(const sg_problem& p, int64_t i, int real) {
  Bodies b = read_bodies(p.means, p.quaternions, p.scales, i, real);
  read_few<1>(p.kappa + i, real, &b.kappa);
  return b;
}

// log2 of the optical depth at which a footprint ends, and q at which an imaging weight ends; base 2
float min_log_tau(const sg_problem& p) { return __builtin_log2f(p.min_ray_depth * kLog2e); }
float image_cut(const sg_problem& p) { return 0.5f * kLog2e * p.image_cut; }

ViewFrame frame_of(const sg_problem& p, int v) {
  ViewFrame f;
  for (int k = 0; k < 9; k++) f.r[k] = p.frames[9 * v + k];
  return f;
}

PlaneUnits units(const sg_problem& p) {
  return {{p.ray[0], p.ray[1]}, {p.pixel[0], p.pixel[1]}, p.cell_widening, {p.response_var[0], p.response_var[1]}};
}

}  // namespace
}  // namespace SG_ISA
}  // namespace sarsplat
